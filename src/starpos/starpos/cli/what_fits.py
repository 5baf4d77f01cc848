# SPDX-License-Identifier: Apache-2.0
"""Says which focal length fits a frame that was not identified with the given one."""

from contextlib import suppress

from starpos.cli.console import complain
from starpos.cli.frame_work import Reader, stars_of
from starpos.errors import StarposError
from starpos.fix.blind import BlindSolver
from starpos.fix.other_focal import focal_that_fits
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.identification import quad_cache
from starpos.identification.blind import STAGES
from starpos.instrument.instrument import Instrument
from starpos.sky.catalogue import load_catalogue


def say_what_would_fit(command: str, read: Reader, instrument: Instrument, path: str) -> None:
    """Complain of the focal length that a frame fits, if one near the given one does, or any that is quickly found."""
    with suppress(StarposError):
        stars = stars_of(read(path))
        focal_px = focal_that_fits(Solver(instrument, load_catalogue()), stars) or _quickly_found(stars)
        if focal_px is not None:
            complain(command, f"{path}: a focal length of {focal_px:.0f} px fits: give that one")


def _quickly_found(stars: Stars) -> float | None:
    """The focal length in px that the first stage of the search at every scale finds, where its quads are built."""
    if not quad_cache.is_built(load_catalogue()):
        return None
    found = BlindSolver(load_catalogue(), stages=STAGES[:1]).identify(stars)
    return None if found.attitude is None else found.attitude.focal_px
