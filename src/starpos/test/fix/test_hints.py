# SPDX-License-Identifier: Apache-2.0
"""Frames whose header gives a wrong focal length: each is found by the one that fits, and its header is named."""

import re
from dataclasses import replace

import numpy as np
import pytest

from starpos.fix import searching
from starpos.fix.searching import Question, Sight, answer_by_header, of_one_camera
from starpos.fix.solution import FieldPointing, Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.header import read_exposure
from starpos.instrument.camera import EQUIDISTANT, PLUMB_BOB, Camera
from starpos.instrument.instrument import Instrument
from starpos.night.reading import Instruments
from starpos.night.work import Solving
from starpos.progress import quiet
from starpos.sky.catalogue import load_catalogue
from starpos_testing.skies.cygnus import DEC_DEG, stars_of_cygnus

SIZE, FOCAL_MM, PIXEL_UM = (2808, 1872), 150.0, 6.4
FOCAL_PX = 1000 * FOCAL_MM / PIXEL_UM
RIGHT = {"FOCALLEN": FOCAL_MM, "XPIXSZ": PIXEL_UM}


@pytest.fixture
def seen(catalogue, rng):
    """A function that gives the stars of a field of 8 deg, with a header."""
    camera = Camera.from_focal(*SIZE, FOCAL_PX)

    def stars(header):
        return stars_of_cygnus(catalogue, rng, camera, 7.5, 0.05, **read_exposure(header, "frame.fits").facts)

    return stars


# the pixel of another binning, metres in place of millimetres, the plate scale of a reduced picture
@pytest.mark.parametrize(
    ("header", "told"),
    [
        (
            RIGHT | {"XPIXSZ": 3.2},
            r"46875 px \(150 mm, pixels of 3.2 um\); 234.. px, 75 mm for such pixels, fits",
        ),
        (
            RIGHT | {"FOCALLEN": 0.15},
            r"23 px \(0.15 mm, pixels of 6.4 um\); 234.. px, 150 mm for such pixels, fits",
        ),
        ({"SCALE": 4.4}, r"468.. px; 234.. px fits"),
    ],
)
def test_a_wrong_header_binds_nothing(seen, header, told):
    stars = seen(header)
    work = Solving(Instruments(None, by_header=True))
    sight = work(stars)
    assert sight.solution.ok and np.degrees(sight.solution.pointing.dec) == pytest.approx(DEC_DEG, abs=1e-3)
    assert sight.instrument.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    assert re.fullmatch(
        f"frame.fits: its header is wrong: it makes a focal length of {told}", sight.solution.remark
    )


def test_a_right_header_is_not_doubted(seen):
    sight = Solving(Instruments(None, by_header=True))(seen(RIGHT))
    assert sight.solution.ok and (sight.solution.remark, sight.instrument) == ("", None)


def test_each_frame_has_its_own_header(seen):
    """The first frame's focal length differs from the others'."""
    given = Instruments(Instrument(1000.0 * 50 / PIXEL_UM), by_header=True)
    sight = Solving(given)(seen(RIGHT))
    assert sight.solution.ok and sight.solution.remark == ""


def test_a_focal_length_that_somebody_gave_is_no_hint(seen):
    """It holds, because a place rests on it: the frame is lost, and no other one is tried."""
    sight = Solving(Instruments(Instrument(2 * FOCAL_PX)))(seen(RIGHT))
    assert sight.solution.status is Status.NOT_IDENTIFIED


def test_turning_takes_the_focal_length_that_fits(seen):
    work = Solving(Instruments(None, by_header=True))
    wrong, right = work(seen(RIGHT | {"XPIXSZ": 3.2})), work(seen(RIGHT))
    solver, frames = of_one_camera(_solver(46875.0), [wrong, right])
    assert solver.instrument.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    # what was identified by another focal length is identified anew
    assert frames[0] is wrong and frames[1] is not right
    assert frames[1].found.star.tolist() == right.found.star.tolist()
    solver, frames = of_one_camera(_solver(FOCAL_PX), [right])
    assert solver.instrument.focal_px == FOCAL_PX and frames == [right]


@pytest.fixture
def lost(seen):
    """Stars whose header is wrong, and the solver by that header."""
    return seen(RIGHT | {"XPIXSZ": 3.2}), _solver(46875.0)


def asked(stars, solver):
    return answer_by_header(solver, Question(item=stars, stars=stars), quiet)


def never(*_):
    raise AssertionError("nothing is searched, or solved again")


def test_a_frame_that_nothing_fits_keeps_its_sentence(lost, rng):
    """Random points are searched within the time that a frame has, and reported by the first sentence."""
    stars, solver = lost
    points = replace(stars.select(np.arange(6)), x=rng.uniform(0, SIZE[0], 6), y=rng.uniform(0, SIZE[1], 6))
    sight = asked(points, solver)
    assert sight.solution.status is Status.NOT_IDENTIFIED and sight.instrument is None
    assert sight.solution.message == solver.identify(points).message


def test_a_focal_length_near_the_headers_needs_no_search_at_every_scale(catalogue, rng, monkeypatch):
    monkeypatch.setattr(searching, "identify_blind_every_way", never)
    wide, header = (
        Camera.from_focal(1000, 700, 5000.0),
        read_exposure({"FOCALLEN": 34, "XPIXSZ": 6.4}, "frame.fits").facts,
    )
    sight = Solving(Instruments(None, by_header=True))(
        stars_of_cygnus(catalogue, rng, wide, 6.5, 0.05, **header)
    )
    assert sight.solution.ok and "(34 mm" in sight.solution.remark and "32 mm" in sight.solution.remark


def test_a_scale_and_a_lens_that_then_identify_nothing_are_not_told(lost, monkeypatch):
    stars, solver = lost
    searched, tried = [], []

    def blind(solver, *_):
        searched.append(solver.search_s)
        a_fisheye = FieldPointing(ra=0.0, dec=0.0, roll=0.0, focal_px=900.0, residual_arcsec=1.0, log_odds=99.0,
                             mirrored=False, model=EQUIDISTANT)  # fmt: skip
        return Sight(stars, Solution.of(stars, pointing=a_fisheye))

    def identify(solver, question):
        tried.append((solver.instrument.focal_px, solver.instrument.model))
        return sight

    sight = Sight(stars, solver.identify(stars))
    monkeypatch.setattr(searching, "answer_frame", identify)
    monkeypatch.setattr(searching, "identify_blind_every_way", blind)
    assert asked(stars, solver) is sight
    assert (searched, tried) == ([searching.HINT_SEARCH_S], [(46875.0, PLUMB_BOB), (900.0, EQUIDISTANT)])


@pytest.mark.parametrize(
    ("instrument", "status"),
    [
        (Instrument(46875.0), Status.TOO_FEW_STARS),
        (Instrument(46875.0, frame_size=(100, 80)), Status.BAD_INPUT),
    ],
)
def test_what_no_focal_length_can_help_is_not_searched(instrument, status, seen, monkeypatch):
    monkeypatch.setattr(searching, "focal_that_fits", never)
    stars = seen(RIGHT).select(np.arange(3))
    solver = replace(_solver(46875.0), instrument=instrument)
    assert asked(stars, solver).solution.status is status


def _solver(focal_px):
    return Solver(Instrument(focal_px), load_catalogue())
