# SPDX-License-Identifier: Apache-2.0
"""The place from pointings without a roll: each tells its distance from the zenith, several tell the place."""

from collections.abc import Sequence
from dataclasses import dataclass

from starpos.averaging.altitudes import Circle, circle_of, place_of_circles
from starpos.errors import FixError, StarposError
from starpos.fix.pointing import IDEAL
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.instrument.tilts import Tilts
from starpos.night.doubts import Near, doubts
from starpos.night.together import Together


@dataclass(frozen=True)
class Elevations:
    """The circle of each pointing on which its place lies, or the error for which it has none; the place of all."""

    circles: tuple[Circle | StarposError, ...]
    together: Together


def from_elevations(
    solver: Solver, pointings: Sequence[Pointing], tilts: Tilts, near: Near | None = None
) -> Elevations:
    """Find the place of pointings; near: which of two places it is, where the elevations leave two."""
    circles: list[Circle | StarposError] = []
    for pointing in pointings:
        try:
            circles.append(_circle(solver, pointing, tilts))
        except StarposError as error:
            circles.append(error)
    sound = [c for c in circles if isinstance(c, Circle)]
    together = Together()
    if sound:
        try:
            place = place_of_circles(sound, None if near is None else (near.latitude, near.longitude))
            together = Together(place, "", tuple(doubts((), place, None, near)))
        except FixError as error:
            together = Together(None, str(error))
    return Elevations(tuple(circles), together)


def _circle(solver: Solver, pointing: Pointing, tilts: Tilts) -> Circle:
    state, tilt = solver.levelled(pointing, tilts)
    instrument = solver.instrument
    return circle_of(
        pointing,
        instrument.camera or IDEAL,
        tilt,
        instrument.mounting,
        solver.atmosphere,
        state,
        solver.clock_stddev_s(pointing),
    )
