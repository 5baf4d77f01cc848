# SPDX-License-Identifier: Apache-2.0
"""Exposures to a Night: every frame solved, all of them averaged."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.average import average
from starpos.calibration.turning import turn
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, StarposError
from starpos.fix.budget import heading_of, place_of
from starpos.fix.fix import Fix
from starpos.fix.solver import Solution, Solver, Status
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import a2_matrix
from starpos.instrument.instrument import Instrument
from starpos.progress import Progress, quiet
from starpos.report.folder import StarList, StarLists
from starpos.report.measures import wrapped
from starpos.report.night import NO_TILT, Night, ReportedPlace, Shot
from starpos.sky.catalogue import Catalogue
from starpos.utc import utc_text

STILL_SIGMA = 8.0  # readings further than this from their mean say that the camera was moved


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """What solving needs besides the exposures; instrument_for: of a frame's stars, raises InstrumentError."""

    instrument_for: Callable[[Stars], Instrument]
    catalogue: Catalogue
    atmosphere: Atmosphere
    vertical: Vertical
    turn_stddev_deg: float | None = None
    progress: Progress = quiet

    def solver(self, stars: Stars) -> Solver:
        return Solver(self.instrument_for(stars), self.catalogue, self.atmosphere, progress=self.progress)


def worked(exposures: StarLists, shop: Workshop) -> Night:
    """The night of these exposures; InstrumentError where no frame can have one."""
    solve = _one_by_one if shop.turn_stddev_deg is None else _turned
    shots, fixes, instrument, remarks, extrapolated_days = [], [], None, [], 0.0
    for done, (exposure, solution, used, said) in enumerate(solve(exposures, shop), 1):
        shots.append(_shot(exposure, solution))
        if solution.fix:
            fixes.append(solution.fix)
            instrument = used
            extrapolated_days = max(extrapolated_days, solution.extrapolated_days)
        remarks += said
        shop.progress(exposures.name[:20], done / exposures.count)
    combined, why_not, said = _combined(fixes, shots)
    remarks += said
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
    return replace(night, steady=_steady(night, instrument)) if combined else night


def _one_by_one(exposures: StarLists, shop: Workshop) -> Iterator:
    """(Exposure, Solution, Instrument, remarks) of each frame."""
    hint, prepared = None, set()
    for exposure in exposures.read():
        if not isinstance(exposure.stars, Stars):
            yield exposure, _unreadable(exposure), None, ()
            continue
        solver = shop.solver(exposure.stars)
        size = exposure.stars.width, exposure.stars.height
        if size not in prepared:  # else the time of the first frame would hold the building of the triangles
            prepared.add(size)
            with suppress(StarposError):  # which the frame itself will say
                solver.prepare(*size)
        solution = solver.solve(exposure.stars, exposures.tilt, hint)
        hint = solution.hint or hint
        yield exposure, solution, solver.instrument, ()


def _turned(exposures: StarLists, shop: Workshop) -> Iterator:
    """The same of all frames together, with the A3 that they tell."""
    rows = list(exposures.read())
    good = [e for e in rows if isinstance(e.stars, Stars)]
    answers, instrument, said = iter(()), None, ()
    if good:
        solver = shop.solver(good[0].stars)
        instrument = solver.instrument
        try:
            turned = turn(
                solver, [e.stars for e in good], exposures.tilt, shop.turn_stddev_deg, shop.progress
            )
            answers, instrument = iter(turned.solutions), turned.instrument
            angles = " ".join(f"{a:.5f}" for a in instrument.calibration.misalignment_deg)
            said = (
                f"A3 was found from the headings: --misalignment {angles}, the plumb line in the camera to "
                f"{turned.plumb_stddev_arcsec:.2f} arcsec",
            )
        except FixError as error:
            answers = (Solution.failed(e.stars, Status.POOR_FIT, str(error)) for e in good)
    for k, exposure in enumerate(rows):
        solution = next(answers) if isinstance(exposure.stars, Stars) else _unreadable(exposure)
        yield exposure, solution, instrument, said if k == 0 else ()


def _unreadable(exposure: StarList) -> Solution:
    return Solution(
        Status.BAD_INPUT, str(exposure.stars), source=exposure.name, utc_unix_s=None, stars_detected=0
    )


def _shot(exposure: StarList, s: Solution) -> Shot:
    """What the report keeps of a solution."""
    stars, fix = exposure.stars, s.fix
    seen = {}
    if s.star is not None:
        seen["xy"] = np.stack([stars.x, stars.y], -1)[s.star]
        seen["magnitudes"] = s.magnitudes
    if fix:
        seen |= {
            "place": ReportedPlace.of(fix),
            "residual_px": -fix.residual_px,
            "residual_arcsec": fix.residual_arcsec,
            "camera_to_itrs": fix.camera_to_itrs,
        }
    elif s.attitude:
        seen["residual_arcsec"] = s.attitude.residual_arcsec
    return Shot(
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
        **seen,
    )


def _combined(fixes: Sequence[Fix], shots: Sequence[Shot]) -> tuple[ReportedPlace | None, str, list[str]]:
    """The average; else a sentence why not; and what there is to say of it."""
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
    """A sentence for a night without a fix."""
    if not shots:
        return "there is no frame in it"
    return f"none of its {len(shots)} frames gave a fix; the first: {shots[0].message}"


def _steady(night: Night, instrument: Instrument) -> np.ndarray | None:
    """Night.steady: the fixes with the mean tilt of the night for each; None where the camera did not stand still."""
    tilts = np.array([s.tilt for _, s in night.fixed])
    headings = np.array([s.place.heading for _, s in night.fixed])
    own = np.array([s.place.own for _, s in night.fixed])
    moved = np.abs(tilts - np.median(tilts, axis=0)).max() * 6.371e6
    noise = np.sqrt(np.median(np.trace(own[:, :2, :2], axis1=1, axis2=2) / 2))
    turned = np.abs(wrapped(headings - headings[0])).max()
    if len(tilts) < 3 or moved > STILL_SIGMA * noise + 1.0 or turned > np.radians(1.0):
        return None
    g = a2_matrix(*tilts.mean(0)) @ instrument.mounting.a3
    steady = []
    for _, shot in night.fixed:
        place = place_of(g @ shot.camera_to_itrs.T)
        link_to_enu = place.local_to_enu @ g @ instrument.mounting.link_to_camera
        steady.append((place.latitude, place.longitude, heading_of(link_to_enu)))
    return np.array(steady)
