# SPDX-License-Identifier: Apache-2.0
"""Frames that are identified at the second try: stars in a part of them, and stars that are detected otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.detection import second_look as ways
from starpos.fix import searching
from starpos.fix.searching import PART, identify_every_way
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.cygnus import DEC_DEG, stars_of_cygnus

SIZE, FOCAL_PX = (1280, 960), 2657.0


@pytest.fixture
def left_half(catalogue, rng):
    """Stars of the left half of a field whose brighter ones lie on its right."""
    camera = Camera.from_focal(*SIZE, FOCAL_PX)
    return stars_of_cygnus(
        catalogue, rng, camera, 6.5, 0.3, roll_deg=124.67, width=641, window=(0, 0, 640, 960)
    )


def test_a_part_of_a_frame_without_the_brightest_stars_around_it(catalogue, left_half):
    stars, solver = left_half, Solver(Instrument(FOCAL_PX), catalogue)
    assert solver.identify(stars).status is Status.NOT_IDENTIFIED
    found = solver.identify(stars, part=PART)
    assert found.ok and found.attitude.dec == pytest.approx(np.radians(DEC_DEG), abs=1e-4)
    assert identify_every_way(solver, stars, stars).solution.star.tolist() == found.star.tolist()


@pytest.fixture
def frame():
    return Frame(np.zeros((200, 300), np.uint8))


class Answering:
    """A solver that gives these answers, one after another."""

    def __init__(self, *answers):
        self.answers = iter(answers)

    def identify(self, stars, predicted=(), look=None, part=1.0):
        return next(self.answers)


def test_an_answer_by_stars_detected_otherwise_needs_more_evidence(frame, catalogue, left_half, monkeypatch):
    stars = left_half
    good = Solver(Instrument(FOCAL_PX), catalogue).identify(stars, part=PART)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    others = [replace(stars, source=str(k)) for k in range(4)]
    monkeypatch.setattr(ways, "otherwise", lambda frame, window: iter(others))
    weak = replace(good, attitude=replace(good.attitude, log_odds=searching.MIN_LOG_ODDS_OTHERWISE - 0.1))
    sight = identify_every_way(Answering(lost, lost, weak, weak, lost, good), frame, stars)
    assert sight.solution is good and sight.stars.source == "1"
    sight = identify_every_way(Answering(lost, lost, *6 * [weak]), frame, stars)
    assert sight.solution is lost and sight.stars is stars
    # the stars that were detected first need no more than a star list does
    assert identify_every_way(Answering(lost, weak), frame, stars).solution is weak


def test_an_answer_a_list_and_a_bad_frame_are_left_as_they_are(frame):
    stars = no_stars(300, 200)
    for item, status, ways_tried in ((frame, Status.BAD_INPUT, 1), (stars, Status.TOO_FEW_STARS, 2)):
        answer = Solution.failed(stars, status, "as it was")
        assert identify_every_way(Answering(*ways_tried * [answer]), item, stars).solution is answer


def test_no_other_way_is_begun_when_the_time_is_over(frame):
    lost = Solution.failed(no_stars(300, 200), Status.NOT_IDENTIFIED, "lost")
    assert identify_every_way(Answering(lost), frame, no_stars(300, 200), until_s=0.0).solution is lost
