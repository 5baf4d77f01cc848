# SPDX-License-Identifier: Apache-2.0
"""Frames that are identified at the second try: stars in a part of them, and stars that are detected otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import otherwise as ways
from starpos.fix import again
from starpos.fix.again import PART, identified_otherwise
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.rotation import unit_vector

SIZE, FOCAL_PX = (1280, 960), 2657.0


def stars_of_cygnus(catalogue, rng):
    """Stars of the left half of a field whose brighter ones lie on its right."""
    camera = Camera.from_focal(*SIZE, FOCAL_PX)
    ra, dec, roll = np.radians([295.77, 49.79, 124.67])
    axis, north = unit_vector(ra, dec), unit_vector(ra, dec + np.pi / 2)
    down = -np.cos(roll) * north - np.sin(roll) * np.cross(north, axis)
    attitude = np.stack([np.cross(down, axis), down, axis])
    index = catalogue.cone(attitude[2], camera.half_diagonal_rad, 6.5)
    index = index[np.argsort(catalogue.vmag(index))]
    xy = camera.project(catalogue.directions(index) @ attitude.T) + rng.normal(0, 0.3, (len(index), 2))
    xy = xy[((xy > 0) & (xy < [640, 959])).all(1)]
    n = len(xy)
    return Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=np.arange(n, 0, -1.0),
        snr=np.full(n, 20.0),
        covariance=np.broadcast_to(0.01 * np.eye(2), (n, 2, 2)),
        flags=np.zeros(n),
        width=SIZE[0],
        height=SIZE[1],
        window=(0, 0, 640, 960),
    )


def test_a_part_of_a_frame_without_the_brightest_stars_around_it(catalogue, rng):
    stars, solver = stars_of_cygnus(catalogue, rng), Solver(Instrument(FOCAL_PX), catalogue)
    assert solver.identify(stars).status is Status.NOT_IDENTIFIED
    found = solver.identify(stars, part=PART)
    assert found.ok and found.attitude.dec == pytest.approx(np.radians(49.79), abs=1e-4)


@pytest.fixture
def frame():
    return Frame(np.zeros((200, 300), np.uint8))


def test_an_answer_by_stars_detected_otherwise_needs_more_evidence(frame, catalogue, rng, monkeypatch):
    stars = stars_of_cygnus(catalogue, rng)
    good = Solver(Instrument(FOCAL_PX), catalogue).identify(stars, part=PART)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    monkeypatch.setattr(ways, "otherwise", lambda frame, window: iter([stars, stars, stars]))
    assert identified_otherwise(frame, stars, lost, lambda s: good) is good
    weak = replace(good, attitude=replace(good.attitude, log_odds=again.ENOUGH_OTHERWISE - 0.1))
    tries = iter([weak, lost, good])
    assert identified_otherwise(frame, stars, lost, lambda s: next(tries)) is good
    assert identified_otherwise(frame, stars, lost, lambda s: weak) is lost


def test_an_answer_a_list_and_a_bad_frame_are_left_as_they_are(frame):
    stars = no_stars(300, 200)
    never = None
    for item, status in ((frame, Status.OK), (frame, Status.BAD_INPUT), (stars, Status.TOO_FEW_STARS)):
        answer = Solution.failed(stars, status, "as it was")
        assert identified_otherwise(item, stars, answer, never) is answer
