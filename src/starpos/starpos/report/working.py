# SPDX-License-Identifier: Apache-2.0
"""Makes a Night of exposures: solves each frame and averages the fixes."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.average import average
from starpos.calibration.turning import turn
from starpos.calibration.unknown import unknown_a3
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, StarposError
from starpos.fix.budget import heading_of, place_of
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.identification.hint import Hint
from starpos.instrument.axis import with_frame_size
from starpos.instrument.inclinometer import level_of, up_of
from starpos.instrument.instrument import Instrument
from starpos.progress import Progress, quiet
from starpos.report.folder import StarList, StarLists
from starpos.report.night import NO_TILT, Night, ReportedPlace, Shot
from starpos.rotation import half_turns
from starpos.sky.catalogue import Catalogue
from starpos.utc import utc_text

# if readings are further from their median than this, the camera was moved
STILL_SIGMA = 8.0


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """All that solving needs besides the exposures.

    instrument_for: gives the instrument for the stars of a frame, may raise InstrumentError.
    turn_stddev_deg: to calibrate by turning, the sigma of A3's turn; None to use A3 as given.
    """

    instrument_for: Callable[[Stars], Instrument]
    catalogue: Catalogue
    atmosphere: Atmosphere
    vertical: Vertical
    turn_stddev_deg: float | None = None
    progress: Progress = quiet

    def solver(self, stars: Stars) -> Solver:
        """The solver for frames like this one."""
        return Solver(self.instrument_for(stars), self.catalogue, self.atmosphere, progress=self.progress)


def worked(exposures: StarLists, shop: Workshop) -> Night:
    """The night of these exposures; raises InstrumentError if there is no instrument for a frame."""
    framing = _Framing(shop.instrument_for)
    shop = replace(shop, instrument_for=framing)
    if shop.turn_stddev_deg is None:
        solved = _one_by_one(exposures, shop)
    else:
        solved = _turned(exposures, shop, shop.turn_stddev_deg)
    shots: list[Shot] = []
    fixes: list[Fix] = []
    remarks = list(exposures.remarks)
    instrument: Instrument | None = None
    extrapolated_days = 0.0
    for done, item in enumerate(solved, 1):
        shots.append(_shot(item.exposure, item.solution))
        if item.solution.fix:
            fixes.append(item.solution.fix)
            instrument = item.instrument
            extrapolated_days = max(extrapolated_days, item.solution.extrapolated_days)
        remarks += item.remarks
        shop.progress(exposures.name[:20], done / exposures.count)
    combined, why_not, said = _combined(fixes, shots)
    remarks += [*said, *([framing.doubt] if framing.doubt else [])]
    if instrument and shop.turn_stddev_deg is None:
        unknown = unknown_a3(instrument.calibration, (combined or fixes[-1]).covariance, fixes[-1].terms)
        remarks += [unknown] if unknown else []
    if extrapolated_days > 0:
        remarks.append(
            f"the Earth's rotation is extrapolated {extrapolated_days:.0f} days beyond the IERS table, which the budget "
            "holds as ut1: upgrade astropy-iers-data"
        )
    night = Night(
        name=exposures.name,
        origin=exposures.origin,
        shots=shots,
        combined=combined,
        why_not=why_not,
        vertical=shop.vertical,
        atmosphere=shop.atmosphere,
        truth=exposures.truth,
        remarks=tuple(remarks),
    )
    steady = _steady(night, instrument) if combined and instrument else None
    return replace(night, steady=steady)


class _Framing:
    """The instrument for the stars of a frame, whose frame is that of the first one; and a doubt about its axis."""

    def __init__(self, instrument_for: Callable[[Stars], Instrument]) -> None:
        self._instrument_for, self.doubt = instrument_for, ""
        self._first: Stars | None = None

    def __call__(self, stars: Stars) -> Instrument:
        self._first = stars if self._first is None else self._first
        framed, doubt = with_frame_size(self._instrument_for(stars), self._first)
        self.doubt = self.doubt or doubt
        return framed


@dataclass(frozen=True)
class _Solved:
    """A frame, its solution, the instrument it was solved with (None if it has no stars), and what there is to say."""

    exposure: StarList
    solution: Solution
    instrument: Instrument | None
    remarks: tuple[str, ...] = ()


def _one_by_one(exposures: StarLists, shop: Workshop) -> Iterator[_Solved]:
    """Solve each frame by itself."""
    hint: Hint | None = None
    prepared: set[tuple[int, int]] = set()
    for exposure in exposures.read():
        if not isinstance(exposure.stars, Stars):
            yield _Solved(exposure, _unreadable(exposure), None)
            continue
        solver = shop.solver(exposure.stars)
        size = exposure.stars.width, exposure.stars.height
        # otherwise the time of the first frame would include the building of the triangles
        if size not in prepared:
            prepared.add(size)
            # the frame itself reports an error
            with suppress(StarposError):
                solver.prepare(*size)
        solution = solver.solve(exposure.stars, exposures.tilt, hint)
        hint = solution.hint or hint
        yield _Solved(exposure, solution, solver.instrument)


def _turned(exposures: StarLists, shop: Workshop, turn_stddev_deg: float) -> Iterator[_Solved]:
    """Solve all frames together, with the A3 that they tell."""
    rows = list(exposures.read())
    good = [e.stars for e in rows if isinstance(e.stars, Stars)]
    solutions: list[Solution] = []
    instrument: Instrument | None = None
    remarks: tuple[str, ...] = ()
    if good:
        solver = shop.solver(good[0])
        instrument = solver.instrument
        try:
            turned = turn(solver, good, exposures.tilt, turn_stddev_deg, shop.progress)
            solutions, instrument = list(turned.solutions), turned.instrument
            remarks = (
                "A3 was found from the headings: the plumb line in the camera is known to "
                f"{turned.plumb_stddev_arcsec:.2f} arcsec",
            )
        except FixError as error:
            solutions = [Solution.failed(stars, Status.POOR_FIT, str(error)) for stars in good]
    answers = iter(solutions)
    for k, exposure in enumerate(rows):
        solution = next(answers) if isinstance(exposure.stars, Stars) else _unreadable(exposure)
        yield _Solved(exposure, solution, instrument, remarks if k == 0 else ())


def _unreadable(exposure: StarList) -> Solution:
    return Solution(
        Status.BAD_INPUT, str(exposure.stars), source=exposure.name, utc_unix_s=None, stars_detected=0
    )


def _shot(exposure: StarList, s: Solution) -> Shot:
    """The part of a solution that the report shows."""
    stars = exposure.stars
    shot = Shot(
        name=exposure.name,
        status=s.status,
        message=s.message,
        utc_unix_s=float("nan") if s.utc_unix_s is None else s.utc_unix_s,
        pointing=s.attitude,
        size=(stars.width, stars.height) if isinstance(stars, Stars) else None,
        stars_detected=s.stars_detected,
        stars_matched=len(s.names),
        tilt=(s.tilt.theta_x, s.tilt.theta_y) if s.tilt else NO_TILT,
        identify_s=s.identify_s,
        fix_s=s.fix_s,
        residual_arcsec=s.attitude.residual_arcsec if s.attitude else float("nan"),
        warnings=s.warnings,
    )
    if isinstance(stars, Stars) and s.star is not None and s.magnitudes is not None:
        shot = replace(shot, xy=np.stack([stars.x, stars.y], -1)[s.star], magnitudes=s.magnitudes)
    if s.fix is None:
        return shot
    return replace(
        shot,
        place=ReportedPlace.of(s.fix),
        residual_px=-s.fix.residual_px,
        residual_arcsec=s.fix.residual_arcsec,
        camera_to_itrs=s.fix.camera_to_itrs,
    )


def _combined(fixes: Sequence[Fix], shots: Sequence[Shot]) -> tuple[ReportedPlace | None, str, list[str]]:
    """The average or None, a sentence why there is none, and remarks on it."""
    if not fixes:
        return None, why_none(shots), []
    try:
        whole = average(fixes)
    except FixError as error:
        return None, str(error), []
    said = []
    if whole.left_out:
        said.append(
            f"{whole.left_out} frames are not in the average: they lie further from it than their errors allow"
        )
    if whole.moved:
        since = utc_text(whole.began_unix_s)
        said.append(
            f"the instrument was moved: the average is of its last place, {whole.frames} frames since {since}"
        )
    return ReportedPlace.of(whole), "", said


def why_none(shots: Sequence[Shot]) -> str:
    """A sentence that says why a night has no fix."""
    if not shots:
        return "there is no frame in it"
    return f"none of its {len(shots)} frames gave a fix; the first: {shots[0].message}"


def _steady(night: Night, instrument: Instrument) -> np.ndarray | None:
    """Places (N, 3) for Night.steady, each with the mean tilt of the night; None if the camera was moved."""
    tilts = np.array([s.tilt for _, s in night.fixed])
    headings = np.array([p.heading for p in night.places])
    own = np.array([p.own for p in night.places])
    attitudes = [s.camera_to_itrs for _, s in night.fixed if s.camera_to_itrs is not None]
    moved = np.abs(tilts - np.median(tilts, axis=0)).max() * EARTH_RADIUS_M
    noise = np.sqrt(np.median(np.trace(own[:, :2, :2], axis1=1, axis2=2) / 2))
    turned = np.abs(half_turns(headings - headings[0])).max()
    if len(tilts) < 3 or moved > STILL_SIGMA * noise + 1.0 or turned > np.radians(1.0):
        return None
    g = level_of(up_of(tilts.mean(0))) @ instrument.mounting.a3
    steady = []
    for camera_to_itrs in attitudes:
        place = place_of(g @ camera_to_itrs.T)
        link_to_enu = place.local_to_enu @ g @ instrument.mounting.link_to_camera
        steady.append((place.latitude, place.longitude, heading_of(link_to_enu)))
    return np.array(steady)
