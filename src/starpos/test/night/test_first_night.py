# SPDX-License-Identifier: Apache-2.0
"""A first night, step by step, whatever way the level is mounted; and what holds a step up."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.fix.solver import Solver
from starpos.instrument.instrument import Calibration
from starpos.instrument.tilt_log import TiltLog
from starpos.night.first_night import LEVEL, FirstNight
from starpos.night.reading import Instruments
from starpos.night.work import Solving
from starpos.rotation import about_axis
from starpos_testing.skies.first_night import Stand, scene_at, usual
from starpos_testing.skies.scenes import AIR, EXPOSURE, START, stars_of, wide_scene

NOISE_RAD = np.radians(1e-3)
# frames for each step, after a lens that is in focus
STANDS = [Stand(3), *(stand for stand in usual() if stand.exposure_s == EXPOSURE)]
HANGING = about_axis(0, np.pi)
STEPS = ["focus", "exposure", LEVEL, "horizon", "turn"]


@pytest.fixture(scope="module")
def arrived(catalogue):
    """The lists of stars of a first night, and up (3,) in C at each."""
    rng, scene = np.random.default_rng(5), wide_scene(misalignment_deg=(0.0, 0.0, 0.0))
    scenes = [scene_at(stand, scene) for stand in STANDS for _ in range(stand.frames)]
    lists = [stars_of(at, catalogue, rng, START + 15.0 * k) for k, at in enumerate(scenes)]
    return [(replace(stars, fwhm_px=2.4), at.attitude[2]) for stars, at in zip(lists, scenes, strict=True)]


def looked(arrived, catalogue, mounted=None, axes=2, change=lambda k, log: log):
    """The night after all its frames, and each frame's step and look.

    mounted (3, 3): C into S.  change: of the readings (their number, log) around each frame.
    """
    mounted, rng = np.eye(3) if mounted is None else mounted, np.random.default_rng(7)
    given = replace(wide_scene().instrument, calibration=Calibration().turned_to(mounted))
    night, work, told = (
        FirstNight(Solver(given, catalogue, AIR)),
        Solving(Instruments(given), atmosphere=AIR),
        [],
    )
    for k, (stars, up) in enumerate(arrived):
        times = stars.mid_unix_s + np.arange(-6.0, 6.0, 0.2)
        x, y, z = np.arcsin(mounted @ up)[:, None] + rng.normal(0, NOISE_RAD, (3, len(times)))
        log = TiltLog.of(times, x, y, np.full(len(times), np.nan), NOISE_RAD, z if axes == 3 else None)
        if night.step:
            told.append((night.step, night.inspect(work(stars), change(k, log))))
    return night, told


@pytest.mark.parametrize(
    ("mounted", "axes"), [(None, 2), (None, 3), (HANGING, 3)], ids=["two", "three", "hanging"]
)
def test_a_level_of_two_or_three_axes_and_one_that_hangs_come_to_the_same_a3(
    arrived, catalogue, mounted, axes
):
    night, told = looked(arrived, catalogue, mounted, axes)
    assert not night.step and [step for step, look in told if look.done] == STEPS
    found = night.turned.instrument.calibration.a3
    true = np.eye(3) if mounted is None else mounted
    # the plumb line of the camera, which the headings determine
    assert np.degrees(np.arccos(np.clip((found.T @ true)[2, 2], -1, 1))) * 3600 < 30
    places = [s.fix for s in night.turned.solutions]
    site = np.radians([wide_scene().site.latitude_deg, wide_scene().site.longitude_deg])
    assert all(np.abs(np.array([p.latitude, p.longitude]) - site).max() < np.radians(0.05) for p in places)


def test_a_level_that_ends_or_moves_holds_its_step_up_and_says_what_to_do(arrived, catalogue):
    def shaken(k, log):
        # from the frame of the level on: none, too short, ended long before, shaken
        kept = {
            4: "tilt.csv: no such file",
            5: log.until(log.utc_unix_s[8]),
            6: replace(log, utc_unix_s=log.utc_unix_s - 60),
        }
        swing = replace(log, theta_x=log.theta_x + np.radians(0.1) * np.sin(log.utc_unix_s))
        return kept.get(k, swing if k == 7 else log)

    _, told = looked([*arrived[:4], *4 * arrived[4:5]], catalogue, change=shaken)
    level = [(look.done, look.todo) for step, look in told if step == LEVEL]
    assert [done for done, _ in level] == [False] * 4
    assert [todo.split()[0] for _, todo in level] == ["connect", "leave", "leave", "wait"]
