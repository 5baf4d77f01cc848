# SPDX-License-Identifier: Apache-2.0
"""Frames whose header gives a wrong focal length: each is found by the one that fits, and its header is named."""

import re

import numpy as np
import pytest

from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.header import about
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.night.hints import of_one_camera, without_hint
from starpos.night.reading import Given
from starpos.night.work import Identifying
from starpos.rotation import unit_vector
from starpos.sky.catalogue import load_catalogue

SIZE, FOCAL_MM, PIXEL_UM = (2808, 1872), 600.0, 6.4
FOCAL_PX = 1000 * FOCAL_MM / PIXEL_UM
RIGHT = {"FOCALLEN": FOCAL_MM, "XPIXSZ": PIXEL_UM}


@pytest.fixture
def seen(catalogue, rng):
    """A function that gives the stars of a field of 2 deg, with a header."""
    camera = Camera.from_focal(*SIZE, FOCAL_PX)
    ra, dec = np.radians([295.77, 49.79])
    axis, north = unit_vector(ra, dec), unit_vector(ra, dec + np.pi / 2)
    attitude = np.stack([np.cross(-north, axis), -north, axis])
    index = catalogue.cone(axis, camera.half_diagonal_rad, 9.0)
    index = index[np.argsort(catalogue.vmag(index))]
    xy = camera.project(catalogue.directions(index) @ attitude.T) + rng.normal(0, 0.05, (len(index), 2))
    xy = xy[((xy > 0) & (xy < np.array(SIZE) - 1)).all(1)]
    n = len(xy)

    def stars(header):
        return Stars(
            x=xy[:, 0],
            y=xy[:, 1],
            flux=np.arange(n, 0, -1.0),
            snr=np.full(n, 50.0),
            covariance=np.broadcast_to(0.0025 * np.eye(2), (n, 2, 2)),
            flags=np.zeros(n),
            width=SIZE[0],
            height=SIZE[1],
            **about(header, "frame.fits"),
        )

    return stars


# the pixel of another binning, metres in place of millimetres, the plate scale of a reduced picture
@pytest.mark.parametrize(
    ("header", "told"),
    [
        (
            RIGHT | {"XPIXSZ": 3.2},
            r"187500 px \(600 mm, pixels of 3.2 um\); 937.. px, 300 mm for such pixels, fits",
        ),
        (
            RIGHT | {"FOCALLEN": 0.6},
            r"94 px \(0.6 mm, pixels of 6.4 um\); 937.. px, 600 mm for such pixels, fits",
        ),
        ({"SCALE": 1.1}, r"1875.. px; 937.. px fits"),
    ],
)
def test_a_wrong_header_binds_nothing(seen, header, told):
    stars = seen(header)
    work = Identifying(Given(None, by_header=True))
    sight, _ = work(stars)
    assert sight.solution.ok and np.degrees(sight.solution.attitude.dec) == pytest.approx(49.79, abs=1e-3)
    assert sight.instrument.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    assert re.fullmatch(
        f"frame.fits: its header is wrong: it makes a focal length of {told}", sight.solution.remark
    )


def test_a_right_header_is_not_doubted(seen):
    sight, _ = Identifying(Given(None, by_header=True))(seen(RIGHT))
    assert sight.solution.ok and (sight.solution.remark, sight.instrument) == ("", None)


def test_each_frame_has_its_own_header(seen):
    """The first frame's focal length is not that of the others."""
    given = Given(Instrument(1000.0 * 50 / PIXEL_UM), by_header=True)
    sight, _ = Identifying(given)(seen(RIGHT))
    assert sight.solution.ok and sight.solution.remark == ""


def test_a_focal_length_that_somebody_gave_is_no_hint(seen):
    """It holds, because a place rests on it: the frame is lost, and no other one is tried."""
    sight, _ = Identifying(Given(Instrument(2 * FOCAL_PX)))(seen(RIGHT))
    assert sight.solution.status is Status.NOT_IDENTIFIED


def test_turning_takes_the_focal_length_that_fits(seen):
    work = Identifying(Given(None, by_header=True))
    wrong, right = work(seen(RIGHT | {"XPIXSZ": 3.2}))[0], work(seen(RIGHT))[0]
    solver, frames = of_one_camera(_solver(187500.0), [wrong, right])
    assert solver.instrument.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    # what was identified by another focal length is identified anew
    assert [found is None for _, found in frames] == [False, True]
    solver, frames = of_one_camera(_solver(FOCAL_PX), [right])
    assert solver.instrument.focal_px == FOCAL_PX and frames[0][1] is right.found


def test_a_frame_that_nothing_fits_keeps_its_sentence(seen, rng):
    """Points of chance are searched within the time that a frame has, and told by the first sentence."""
    stars = seen(RIGHT | {"XPIXSZ": 3.2}).take(slice(0, 6))
    solver = _solver(187500.0)
    lost = Identifying(Given(solver.instrument))(stars)[0]

    def never(solver):
        raise AssertionError("no focal length fits")

    points = Stars(**stars.about | {name: getattr(stars, name) for name in ("flux", "snr", "covariance", "flags")}
                   | {"x": rng.uniform(0, SIZE[0], 6), "y": rng.uniform(0, SIZE[1], 6)},
                   width=SIZE[0], height=SIZE[1])  # fmt: skip
    assert without_hint(solver, points, points, lost, never, lambda *_: None) is lost


def _solver(focal_px):
    return Solver(Instrument(focal_px), load_catalogue())
