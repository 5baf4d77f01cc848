# SPDX-License-Identifier: Apache-2.0
"""A frame that one search does not identify: the node tries every way there is, as long as it has time.

Its stars fill less than half of it, and the brightest are missing, as behind a roof and clouds: triangles of the
whole field are too large for them.
"""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.fix.solution import Status
from starpos.instrument.instrument import Calibration
from starpos.recording.topics import CAMERA_INFO, STARS, TILT
from starpos.session.driver import JobsInTurn, Now
from starpos.session.session import SolverSession
from starpos.session.settings import Settings
from starpos_testing.skies.scenes import (
    EXPOSURE,
    FOCAL_PX,
    SIZE,
    START,
    solver_of,
    stars_of,
    tilt_of,
    wide_scene,
)

KNOWN = Calibration.of((0.0, 0.0, 0.0), (5.0, 5.0, 5.0))
BRIGHTEST, LEFT, SHARE = 4, 14, 0.45


def part_of(stars):
    """A few of the stars in a part of the frame."""
    return stars.select(np.flatnonzero(stars.x < SHARE * SIZE[0])[BRIGHTEST : BRIGHTEST + LEFT])


@pytest.fixture(scope="module")
def partly(catalogue):
    rng = np.random.default_rng(1)
    scene = wide_scene(pointing_deg=(184.0, 80.0, 30.0), misalignment_deg=(0.0, 0.0, 0.0))
    scene = replace(scene, instrument=replace(scene.instrument, calibration=KNOWN))
    stars, tilt = part_of(stars_of(scene, catalogue, rng)), tilt_of(scene, rng)
    solver = solver_of(scene, catalogue)
    assert solver.solve(stars, tilt).status is Status.NOT_IDENTIFIED
    return scene, stars, tilt


def is_right(fix, scene):
    """Whether a fix lies where the instrument stood, within what it claims."""
    off = np.degrees([fix.latitude, fix.longitude]) - [scene.site.latitude_deg, scene.site.longitude_deg]
    sigma_m = np.sqrt(np.diag(fix.covariance)[:2].max())
    return np.hypot(off[0], off[1] * np.cos(fix.latitude)) * 111_000 < 4 * sigma_m and sigma_m < 2000


class Quiet:
    """Takes what a session says."""

    def came(self, name):
        """Nothing is said of it."""

    refuse = info = warning = error = lambda self, *_: None


def header(unix_s):
    return SimpleNamespace(
        stamp=SimpleNamespace(sec=int(unix_s), nanosec=round((unix_s % 1) * 1e9)), frame_id="f"
    )


def told(scene, stars, tilt, **parameters):
    """What the node publishes of a frame: the messages' session, live."""
    given = {
        "misalignment": [0.0, 0.0, 0.0],
        "misalignment_stddev": 5.0,
        "inclinometer.model": "sca100t_calibrated",
        "search_time": 20.0,
        "refraction.pressure": scene.site.atmosphere.pressure_pa,
    } | parameters
    quiet, jobs = Quiet(), []

    def new():
        jobs.append(JobsInTurn(lambda text: None))
        return jobs[-1]

    session = SolverSession(Settings.of(None, [f"{k}:={v}" for k, v in given.items()]), new, quiet)
    now = Now(START + EXPOSURE, 0.0)
    camera = scene.instrument.camera_for(*SIZE)
    info = SimpleNamespace(
        header=header(START), width=SIZE[0], height=SIZE[1], distortion_model="plumb_bob", d=[0.0] * 5,
        k=[camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0], binning_x=0, binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0),
    )  # fmt: skip
    session.receive(CAMERA_INFO, info, now)
    for each in jobs:
        each.work()
    message = SimpleNamespace(
        header=header(tilt.utc_unix_s), x=tilt.theta_x, y=tilt.theta_y, z=np.nan, z_variance=np.nan,
        covariance=tilt.covariance.ravel(), temperature=15.0, flags=0,
    )  # fmt: skip
    session.receive(TILT, message, now)
    seen = [
        SimpleNamespace(x=x, y=y, flux=flux, snr=snr, covariance=c.ravel(), flags=flag)
        for x, y, flux, snr, c, flag in zip(
            stars.x, stars.y, stars.flux, stars.snr, stars.covariance, stars.flags, strict=True
        )
    ]
    array = SimpleNamespace(
        header=header(START + EXPOSURE / 2), width=SIZE[0], height=SIZE[1], exposure=EXPOSURE, stamp_stddev=0.0,
        clock_stddev=0.0, shutter_known=True, readout=0.0, readout_stddev=0.0, stars=seen,
    )  # fmt: skip
    answers = session.receive(STARS, array, now) + session.end(Now(START + 2.0, 1.5))
    return answers[0].solution


def test_the_node_solves_it(partly):
    scene, stars, tilt = partly
    answer = told(scene, stars, tilt)
    assert answer.ok and len(answer.names) == len(stars) and is_right(answer.fix, scene)


def test_the_node_does_not_search_where_it_has_no_time(partly):
    assert told(*partly, search_time=0.0).status is Status.NOT_IDENTIFIED


def test_a_focal_length_that_is_wrong_is_named_and_makes_no_fix(partly, catalogue):
    scene, _, tilt = partly
    stars = stars_of(scene, catalogue, np.random.default_rng(1))
    wrong = replace(scene, instrument=replace(scene.instrument, camera=None, focal_px=FOCAL_PX * 1.2))
    answer = told(wrong, stars, tilt)
    assert answer.fix is None and answer.status is Status.NOT_IDENTIFIED
    (focal_px,) = map(float, re.findall(r"a focal length of (\d+) px fits", answer.message))
    assert focal_px == pytest.approx(FOCAL_PX, rel=1e-3)
