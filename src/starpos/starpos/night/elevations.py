# SPDX-License-Identifier: Apache-2.0
"""The place from pointings without a roll: each gives its distance from the zenith, several give the place."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.altitudes import Circle, Directions, circle_of, place_of_circles
from starpos.calibration.axis import MIN_WITHOUT_SITE, FoundAxis, find_axis
from starpos.earth.orientation import EarthState
from starpos.errors import FixError, StarposError
from starpos.fix.pointing import IDEAL
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration
from starpos.instrument.mounting import Mounting
from starpos.instrument.tilts import Tilts
from starpos.night.doubts import Near, doubts
from starpos.night.remarks import of_inclinometer
from starpos.night.together import Together
from starpos.sky.site import Site
from starpos.units import ARCSEC


@dataclass(frozen=True)
class Elevations:
    """Each pointing's circle on which its place lies, or the error; the place of all.

    axis: A3 whose axis the elevations determined too; None if A3 was known well enough or they do not determine it.
    """

    circles: tuple[Circle | StarposError, ...]
    together: Together
    axis: FoundAxis | None = None


def from_elevations(
    solver: Solver,
    pointings: Sequence[Pointing],
    tilts: Tilts,
    near: Near | None = None,
    self_calibrate: bool = False,
) -> Elevations:
    """Find the place of pointings, and A3's axis where it is not known to a few arcmin.

    near: selects between two places that the elevations leave. self_calibrate: treat A3 as unknown.
    """
    if self_calibrate:
        unknown = Calibration.of(solver.instrument.calibration.misalignment_deg)
        solver = replace(solver, instrument=replace(solver.instrument, calibration=unknown))
    circles = circles_of(solver, pointings, tilts)
    sound = [c for c in circles if isinstance(c, Circle)]
    if not sound:
        return Elevations(tuple(circles), Together())
    there, axis = None if near is None else (near.latitude, near.longitude), None
    try:
        directions = Directions.of(sorted(sound, key=lambda c: c.utc_unix_s))
        if self_calibrate or (directions.wide and len(directions.circles) >= MIN_WITHOUT_SITE):
            axis = axis_of(solver, pointings, tilts, there)
            # A3's error is counted from the given A3, or from the one found if none was given
            sound = axis.about(axis.a3 if self_calibrate else solver.instrument.calibration.a3)
        place = place_of_circles(sound, there)
        together = Together(place, "", (*of_inclinometer(solver.instrument), *doubts((), place, None, near)))
    except FixError as error:
        together = Together(None, str(error))
    return Elevations(tuple(circles), together, axis)


def axis_of(
    solver: Solver,
    pointings: Sequence[Pointing],
    tilts: Tilts,
    near: tuple[float, float] | None = None,
    site: Site | None = None,
    site_stddev_arcsec: float = 0.0,
) -> FoundAxis:
    """A3's axis from pointings at a site, or at an unknown place; FixError if they do not determine it."""

    levelled = []
    for pointing in pointings:
        # `circles_of` reports why a pointing has no circle
        with suppress(StarposError):
            levelled.append((pointing, *solver.levelled(pointing, tilts)))

    def with_a3(a3: np.ndarray) -> list[Circle]:
        mounting = replace(solver.instrument.mounting, a3=a3)
        circles = []
        for pointing, state, tilt in levelled:
            with suppress(FixError):
                circles.append(_circle(solver, pointing, tilt, mounting, state))
        return circles

    ray = (solver.instrument.camera or IDEAL).centre_ray
    given = solver.instrument.calibration
    return find_axis(with_a3, given, ray, site, site_stddev_arcsec * ARCSEC, near)


def circles_of(solver: Solver, pointings: Sequence[Pointing], tilts: Tilts) -> list[Circle | StarposError]:
    """Each pointing's circle, or the error."""
    circles: list[Circle | StarposError] = []
    for pointing in pointings:
        try:
            state, tilt = solver.levelled(pointing, tilts)
            circles.append(_circle(solver, pointing, tilt, solver.instrument.mounting, state))
        except StarposError as error:
            circles.append(error)
    return circles


def _circle(solver: Solver, pointing: Pointing, tilt: Tilt, mounting: Mounting, state: EarthState) -> Circle:
    camera, clock_s = solver.instrument.camera or IDEAL, solver.clock_stddev_s(pointing)
    return circle_of(pointing, camera, tilt, mounting, solver.atmosphere, state, clock_s)
