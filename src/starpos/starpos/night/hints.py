# SPDX-License-Identifier: Apache-2.0
"""Frames whose focal length comes only from their header: if it fits nothing, the search goes on without it.

A header is a hint. Programs write the focal length of another telescope, the pixels of an unbinned frame, or metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from starpos.errors import FieldError, StarposError
from starpos.fix.blind import BlindSolver
from starpos.fix.other_focal import focal_that_fits
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame
from starpos.frames.header import focal_mm
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument.instrument import Instrument
from starpos.night.searching import Sight, identify_blind_every_way
from starpos.progress import Progress

# CPU time, s, of the search at every scale for a frame with a header: under clouds each frame of a night takes it.
SEARCH_S = 5.0


def without_hint(
    solver: Solver,
    item: Frame | Stars,
    stars: Stars,
    sight: Sight,
    work: Callable[[Solver], Sight],
    progress: Progress,
) -> Sight:
    """The sight of a frame with its header's focal length, or if that identifies nothing, with the one that fits.

    solver: with the header's focal length. work: gives the sight with any solver.
    """
    if not _misled(solver, item, sight):
        return sight
    fitting = _fitting(solver, item, stars, progress)
    if fitting is None:
        return sight
    again = work(replace(solver, instrument=fitting))
    if again.solution.attitude is None:
        return sight
    remark = wrong_header(item, again.solution.attitude.focal_px)
    return replace(again, solution=replace(again.solution, remark=remark), instrument=fitting)


def of_one_camera(
    solver: Solver, sights: Sequence[Sight]
) -> tuple[Solver, list[tuple[Stars, Identification | None]]]:
    """A solver with the focal length of a night's frames, and each frame with its identification by this solver.

    solver: with the header's focal length, which holds unless a frame was identified with another one.
    """
    other = next((s.instrument for s in sights if s.instrument is not None), None)
    if other is not None:
        solver = replace(solver, instrument=other)
    return solver, [(s.stars, s.found if s.instrument is other else None) for s in sights]


def wrong_header(item: Frame | Stars, focal_px: float) -> str:
    """A sentence that says which focal length fits a frame in place of its header's."""
    told = "" if item.focal_px is None else f": it makes a focal length of {item.focal_px:.0f} px"
    fits = f"{focal_px:.0f} px"
    if item.focal_px is not None and item.pixel_um is not None:
        told += f" ({focal_mm(item.focal_px, item.pixel_um):.4g} mm, pixels of {item.pixel_um:g} um)"
        fits += f", {focal_mm(focal_px, item.pixel_um):.4g} mm for such pixels,"
    return f"{item.place}: its header is wrong{told}; {fits} fits"


def _misled(solver: Solver, item: Frame | Stars, sight: Sight) -> bool:
    """Whether another focal length may identify a frame that is not identified."""
    if sight.solution.status is Status.NOT_IDENTIFIED:
        return True
    if sight.solution.status is not Status.BAD_INPUT:
        return False
    try:
        solver.view(item.width, item.height, item.origin_px)
    except FieldError:
        return True
    # the solution has the sentence
    except StarposError:
        return False
    return False


def _fitting(solver: Solver, item: Frame | Stars, stars: Stars, progress: Progress) -> Instrument | None:
    """The solver's instrument with the focal length, and the lens, that a frame's stars fit; None if none is found."""
    focal_px = focal_that_fits(solver, stars)
    if focal_px is not None:
        return replace(solver.instrument, focal_px=focal_px)
    blind = BlindSolver(solver.catalogue, progress, search_s=SEARCH_S)
    blind.prepare()
    seen = identify_blind_every_way(blind, item, stars).solution.attitude
    return None if seen is None else replace(solver.instrument, focal_px=seen.focal_px, model=seen.model)
