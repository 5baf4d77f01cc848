# SPDX-License-Identifier: Apache-2.0
"""Directions of a trail on a drawn frame, of a camera that stands on the ground while its rows are read one by one."""

import json
from dataclasses import replace
from types import SimpleNamespace

import erfa
import numpy as np
import pytest

from starpos.cli import main
from starpos.detection import detect
from starpos.errors import FixError, FrameError
from starpos.frames.exposure import Shutter
from starpos.frames.frame import Frame
from starpos.rotation import about_axis, unit_vector
from starpos.satellites.frames import trails_of
from starpos.units import ARCSEC, DAY_S

WIDTH, HEIGHT, FOCAL, SIGMA = 480, 360, 1500.0, 1.1
MID_S, EXPOSURE_S, READOUT_S = 1_700_000_000.0, 10.0, -4.0
YEAR = 2000 + (MID_S / DAY_S - 10957.5) / 365.25
# of a lens that bends a little, per px2
BENT = 4e-9


def pixel_of(axes, v, from_middle_s):
    """Pixel of a direction at a time from the middle of its row's exposure; axes: of the camera for row 0."""
    y = 0.0
    for _ in range(4):
        seconds = abs(READOUT_S) * (1 - y / (HEIGHT - 1)) + from_middle_s
        turn = float(np.diff(erfa.era00(2_460_000.5, np.array([0.0, seconds / DAY_S])))[0])
        u = axes @ about_axis(2, -turn) @ v
        x, y = FOCAL * u[:2] / u[2] * (1 + BENT * FOCAL**2 * (u[0] ** 2 + u[1] ** 2) / u[2] ** 2)
        x, y = x + (WIDTH - 1) / 2, y + (HEIGHT - 1) / 2
    return x, y


@pytest.fixture(scope="module")
def sky(catalogue):
    """A frame with a trail, its stars, their solution, and the trail's true directions and pixels, opening first."""
    out = unit_vector(*np.radians([200.0, 30.0]))
    right = np.cross([0, 0, 1.0], out) / np.linalg.norm(np.cross([0, 0, 1.0], out))
    axes = about_axis(2, 0.7) @ np.stack([right, np.cross(out, right), out])
    rows = catalogue.cone(out, 0.25, 9.0)
    pixels = np.array([pixel_of(axes, v, 0.0) for v in catalogue.directions(rows, YEAR)])
    truth = unit_vector(*np.radians([[200.4, 199.2], [28.5, 31.2]]))
    ends = np.array(
        [pixel_of(axes, v, t) for v, t in zip(truth, (-EXPOSURE_S / 2, EXPOSURE_S / 2), strict=True)]
    )
    points = np.concatenate([pixels, np.linspace(*ends, 600)])
    light = np.concatenate([5e4 * 10 ** (-0.4 * (catalogue.vmag(rows) - 4)), np.full(600, 60.0)])
    across, down = (
        np.exp(-0.5 * ((np.arange(n) - c[:, None]) / SIGMA) ** 2)
        for n, c in ((WIDTH, points[:, 0]), (HEIGHT, points[:, 1]))
    )
    picture = np.random.default_rng(1).poisson(200 + (down.T * light) @ across / (2 * np.pi * SIGMA**2))
    frame = Frame(
        np.clip(picture, 0, 65535).astype(np.uint16),
        mid_unix_s=MID_S,
        exposure_s=EXPOSURE_S,
        shutter=Shutter(READOUT_S, 0.0),
    )
    stars = detect(frame).stars
    apart = np.hypot(stars.x[:, None] - pixels[:, 0], stars.y[:, None] - pixels[:, 1])
    star = np.flatnonzero(apart.min(1) < 1)
    found = SimpleNamespace(star=star, catalogue=rows[apart.argmin(1)[star]])
    return frame, stars, SimpleNamespace(found=found, pointing=SimpleNamespace(focal_px=FOCAL)), truth, ends


def chi2_of(trail, truth):
    """Chi-squared of the errors of both ends, in the order of their times."""
    order = np.argsort(trail.utc_unix_s)
    off = np.einsum("eki,ei->ek", trail.axes[order], truth)
    return float(np.einsum("ek,ekl,el->", off, np.linalg.inv(trail.covariance[order]), off))


def test_one_way_of_a_trail_has_its_directions_and_the_times_of_its_rows(sky, catalogue):
    frame, stars, solution, truth, ends = sky
    (trail,), _ = trails_of(frame, stars, solution, catalogue)
    ways = sorted(trail.ways, key=lambda way: chi2_of(way, truth))
    # of 4 numbers
    assert len(ways) == 2 and chi2_of(ways[0], truth) < 15
    assert np.sqrt(np.trace(ways[0].covariance, axis1=1, axis2=2) / 2).max() < 20 * ARCSEC
    later_s = abs(READOUT_S) * (1 - ends[:, 1] / (HEIGHT - 1))
    expected = MID_S + later_s + np.array([-1, 1]) * EXPOSURE_S / 2
    assert np.sort(ways[0].utc_unix_s) == pytest.approx(np.sort(expected), abs=5e-3)


@pytest.mark.parametrize(("unstated", "said"), [("exposure_s", "exposure time"), ("mid_unix_s", "no time")])
def test_a_frame_without_time_or_exposure_is_refused(sky, catalogue, unstated, said):
    frame, stars, solution, *_ = sky
    with pytest.raises(FrameError, match=said):
        trails_of(frame, replace(stars, **{unstated: None}), solution, catalogue)


def test_points_of_a_camera_that_follows_the_stars_are_refused(sky, catalogue):
    frame, stars, solution, *_ = sky
    with pytest.raises(FixError, match="tracked"):
        trails_of(frame, replace(stars, exposure_s=300.0), solution, catalogue)


def test_frames_without_a_trail_give_no_place(tmp_path, capsys):
    """Exit status 1, a sentence of the frame and one of the place."""
    frame = tmp_path / "dark.fits"
    frame.write_bytes(b"no picture")
    assert main(["satellites", str(frame), "--elements", str(tmp_path), "--json"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["latitude_geodetic"] is None
    assert "dark.fits" in told.err and "none of 1 frames" in told.err
