# SPDX-License-Identifier: Apache-2.0
"""The catalogue's stars on a frame, which cells and spans of the sky hand out, and the frame's stars as they come."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.fix.solver import as_seen, directions_of
from starpos.frames.frame import Stars
from starpos.identification import Sky
from starpos.identification.evidence import EDGE_PX, OnFrame
from starpos.identification.pose import Pose, stars_at
from starpos.identification.search import field_of
from starpos.instrument.camera import Camera

POLE, ZERO_H = 89.5, 0.02
PLACES = [(10.0, POLE), (200.0, -POLE), (ZERO_H, 0.0), (359.98, -45.0), (120.0, 85.0), (77.0, 20.0)]


def looking_at(ra_deg, dec_deg, rng):
    """An attitude (3, 3) with the axis there and any roll."""
    ra, dec = np.radians([ra_deg, dec_deg])
    axis = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    across = np.cross(axis, rng.normal(size=3))
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis])


@pytest.mark.parametrize("field_deg", [0.4, 3.4, 70.0])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("year", [2000.0, 2026.9])
def test_no_star_on_a_frame_is_left_out_at_the_poles_or_where_right_ascension_begins(
    catalogue, rng, field_deg, place, year
):
    velocity = (0.0, 0.0, 0.0) if year == 2000 else (6e-5, -7e-5, 3e-5)
    sky = Sky(catalogue, None, year, velocity)
    camera = Camera.from_focal(1000, 700, 500 / np.tan(np.radians(field_deg / 2)))
    pose = Pose(looking_at(*place, rng), camera.fx, False)
    field = stars_at(camera, rng.uniform(0, [999, 699], (150, 2)), np.full(150, 0.1))
    found = OnFrame.of(field, sky, pose, 150)
    v = sky.directions(np.arange(len(catalogue)))
    pixel = pose.project(v)
    on = (np.abs(pixel - field.middle) < field.half + EDGE_PX).all(1) & (v @ pose.attitude[2] > 0)
    rows = np.flatnonzero(on)
    brightest = rows[np.argsort(catalogue.vmag_centi[rows], kind="stable")][:500]
    assert set(found.index) <= set(brightest)
    # blends of two are one
    assert len(found.index) >= 0.9 * len(brightest)
    left = np.setdiff1d(brightest, found.index)
    near = np.linalg.norm(pixel[left][:, None] - pixel[found.index], axis=2).min(1, initial=np.inf)
    assert (near < 2.5).all()


@pytest.mark.parametrize("squeeze", [1.0, 1.07])
def test_pixels_and_directions_make_the_same_field(rng, squeeze):
    camera = Camera(width=900, height=600, fx=2000.0, fy=2000.0 / squeeze, cx=441.0, cy=310.0)
    n = 30
    xy = rng.uniform(-1.5, [900.5, 600.5], (n, 2))
    sigma2 = rng.uniform(0.01, 0.1, (n, 2)) ** 2
    stars = Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=np.arange(n, 0.0, -1),
        snr=np.full(n, 9.0),
        covariance=np.stack([np.diag(s) for s in sigma2]),
        flags=np.zeros(n, int),
        width=900,
        height=600,
    )
    quick, slow = as_seen(camera, stars), field_of(directions_of(camera, stars), stars.sigma, camera)
    for name in ("xy", "sigma", "middle", "half", "focal_px", "area_px2", "tested"):
        assert getattr(quick, name) == pytest.approx(getattr(slow, name), abs=1e-9), name
    off = SimpleNamespace(**{**vars(stars), "x": np.append(stars.x[:-1], 903.0)})
    assert as_seen(camera, off) is None


def test_a_field_with_another_number_is_another_field(rng):
    camera = Camera.from_focal(900, 600, 2000.0)
    field = stars_at(camera, rng.uniform(0, [900, 600], (9, 2)), np.full(9, 0.1))
    other = field.of_rows(np.array([0, 3, 4])).but(tested=2, area_px2=7.0)
    assert (len(field), field.tested, field.area_px2) == (9, 50, 900.0 * 600)
    assert (len(other), other.tested, other.area_px2, other.focal_px) == (3, 2, 7.0, 2000.0)
    assert (other.xy == field.xy[:, [0, 3, 4]]).all()
