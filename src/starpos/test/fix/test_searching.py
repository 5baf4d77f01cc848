# SPDX-License-Identifier: Apache-2.0
"""Frames that are identified at the second try: stars in a part of them, and stars that are detected otherwise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.detection import second_look as ways
from starpos.earth.place import Place
from starpos.fix import searching
from starpos.fix.searching import PART, Question, answer_frame, identify_every_way
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver, focal_that_fits
from starpos.frames.frame import Disc, Frame, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import NO_TILTS
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
    assert found.ok and found.pointing.dec == pytest.approx(np.radians(DEC_DEG), abs=1e-4)
    assert (
        identify_every_way(solver, Question(item=stars, stars=stars)).solution.star.tolist()
        == found.star.tolist()
    )


@pytest.fixture
def frame():
    return Frame(np.zeros((200, 300), np.uint8))


class Answering:
    """A solver that gives these answers, one after another; `ways` it was asked by, each with the stars' source."""

    def __init__(self, *answers):
        self.answers, self.ways = iter(answers), []

    def identify(self, stars, predicted=(), part=1.0, look=None):
        self.ways.append(("look" if look else "search", stars.source, part))
        return next(self.answers)

    def solve(self, stars, tilts, hint=None, predicted=(), known=None):
        self.ways.append(("solve", stars.source, known))
        return next(self.answers)


def identified(solver, item, stars, **more):
    return identify_every_way(solver, Question(item=item, stars=stars, **more))


def test_an_answer_by_stars_detected_otherwise_needs_more_evidence(frame, catalogue, left_half, monkeypatch):
    stars = left_half
    good = Solver(Instrument(FOCAL_PX), catalogue).identify(stars, part=PART)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    others = [replace(stars, source=str(k)) for k in range(4)]
    monkeypatch.setattr(ways, "other_views", lambda frame, window: iter(others))
    weak = replace(good, pointing=replace(good.pointing, log_odds=searching.MIN_LOG_ODDS_OTHERWISE - 0.1))
    sight = identified(Answering(*4 * [lost], *4 * [weak], lost, good), frame, stars)
    assert sight.solution is good and sight.stars.source == "1"
    sight = identified(Answering(*4 * [lost], *12 * [weak]), frame, stars)
    assert sight.solution is lost and sight.stars is stars
    # the stars that were detected first need no more than a star list does
    assert identified(Answering(lost, weak), frame, stars).solution is weak


def test_an_answer_a_list_and_a_bad_frame_are_left_as_they_are(frame):
    stars = no_stars(300, 200)
    for item, status, ways_tried in ((frame, Status.BAD_INPUT, 1), (stars, Status.TOO_FEW_STARS, 2)):
        answer = Solution.failed(stars, status, "as it was")
        assert identified(Answering(*ways_tried * [answer]), item, stars).solution is answer


def test_no_other_way_is_begun_when_the_time_is_over(frame):
    lost = Solution.failed(no_stars(300, 200), Status.NOT_IDENTIFIED, "lost")
    assert identified(Answering(lost), frame, no_stars(300, 200), until_s=0.0).solution is lost


DISC = Disc(x=150.0, y=100.0, covariance=np.eye(2), radius_px=20.0, sharp=True)


@pytest.mark.parametrize(
    ("tilts", "disc", "first"),
    [
        (None, None, ["search"]),
        (NO_TILTS, None, ["solve"]),
        # the level's search is another one: refraction is removed first
        (None, DISC, ["search"]),
        (NO_TILTS, DISC, ["search", "solve"]),
    ],
    ids=["identified", "solved", "identified beside a disc", "solved beside a disc"],
)
def test_no_way_is_tried_twice_on_the_same_stars(frame, tilts, disc, first, monkeypatch):
    stars = replace(no_stars(300, 200), disc=disc)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    others = [replace(stars, source=str(k)) for k in range(2)]
    monkeypatch.setattr(ways, "other_views", lambda frame, window: iter(others))
    monkeypatch.setattr(searching, "by_sun", lambda *asked: lost)
    solver = Answering(*20 * [lost])
    places = None if disc is None else Place.on_ellipsoid(48.0, 11.0, height_m=0.0)
    question = Question(item=frame, stars=stars, tilts=tilts, places=places)
    assert not answer_frame(solver, question).solution.ok
    assert len(solver.ways) == len(set(solver.ways)) == 11 + len(first)
    tried = [way for way, source, _ in solver.ways if source == stars.source]
    assert tried == [*first, "look", "search", "look"]


def test_stars_beside_a_disc_that_are_identified_are_not_searched_again(frame):
    stars = replace(no_stars(300, 200), disc=DISC)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    seen = replace(lost, status=Status.OK, pointing=SimpleNamespace(log_odds=99.0), found=SimpleNamespace())
    solver = Answering(seen, replace(lost, status=Status.OK))
    assert answer_frame(solver, Question(item=frame, stars=stars, tilts=NO_TILTS)).solution.ok
    assert solver.ways == [("search", stars.source, 1.0), ("solve", stars.source, seen.found)]


def test_the_given_focal_length_is_not_tried_again(catalogue, left_half, monkeypatch):
    tried = []
    monkeypatch.setattr("starpos.fix.solver.field_of", lambda *field: tried.append(field[-1].fx))
    monkeypatch.setattr("starpos.fix.solver.identify", lambda field, sky: None)
    assert focal_that_fits(Solver(Instrument(FOCAL_PX), catalogue), left_half) is None
    assert len(tried) == len(set(tried)) == 12 and FOCAL_PX not in tried


def test_what_another_way_has_identified_is_not_searched_again(frame):
    stars = no_stars(300, 200)
    found = SimpleNamespace(log_odds=99.0)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "lost")
    seen = replace(lost, pointing=found, found=found)
    fixed = replace(lost, status=Status.OK, message="fix")
    solver = Answering(lost, lost, seen, fixed)
    assert answer_frame(solver, Question(item=frame, stars=stars, tilts=NO_TILTS)).solution.ok
    assert solver.ways[-1] == ("solve", stars.source, found)


def test_a_fix_of_known_stars_searches_nothing(catalogue, left_half, monkeypatch):
    """The stars are not found by the search of all, so the fix rests on what is known."""
    solver = Solver(Instrument(FOCAL_PX, calibration=Calibration.of((0, 0, 0), (5, 5, 5))), catalogue)
    stars = replace(left_half, mid_unix_s=1.79e9, exposure_s=0.5)
    found = solver.identify(stars, part=PART).found
    monkeypatch.setattr("starpos.fix.solver.identify", None)
    level = Tilt(0.0, 0.0, np.eye(2) * 1e-10, utc_unix_s=1.79e9)
    assert solver.solve(stars, level, known=found).found.star.tolist() == found.star.tolist()
