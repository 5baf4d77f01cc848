# SPDX-License-Identifier: Apache-2.0
"""Remarks on a night, each a sentence; among them doubts: mistaken tilts, a place far from the stated one.

A remark begins with a small letter and ends without a full stop; it is '' where there is nothing to say.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.average import SCATTER, Average
from starpos.averaging.elevation_axis import FoundAxis
from starpos.calibration.misalignment import Calibrated
from starpos.earth.ellipsoid import EARTH_RADIUS_M, zenith_of
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.errors import TiltError
from starpos.fix import checks
from starpos.fix.budget import local_north
from starpos.fix.fix import Fix, length_text
from starpos.fix.solution import Solution
from starpos.fix.terms import Origin, total_covariance
from starpos.frames.gravity import PHONE
from starpos.frozen import at_once
from starpos.instrument.inclinometer import InclinometerErrors, Tilt, level_of, up_of
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilt_table import like_radians
from starpos.rotation import angle, half_turn
from starpos.units import HOUR_S, utc_text

# sigma of two coordinates together, beyond which a place is once in 100
CLAIMED_SIGMAS = 3.03
# of a camera that lay on a table: its lean's change, and the largest gap between its headings, rad
TABLE_COSINE, TABLE_GAP_RAD = float(np.cos(np.radians(5.0))), np.radians(190.0)
# with a larger error of A3 (arcsec) the headings hardly determine it
WORTH_SAVING_ARCSEC = 600.0


def of_tilts(log: TiltLog, path: str, inclinometer: InclinometerErrors) -> str:
    """Say that a table of tilts is rounded to coarser steps than the inclinometer's; TiltError if it is in radians."""
    if radians := like_radians(log):
        raise TiltError(f"{path}: {radians}")
    coarser = inclinometer.coarser(log.step_rad)
    return f"{path}: {coarser}" if coarser else ""


def of_gravity(instrument: Instrument, by_log: bool = False) -> str:
    """Say what a place by photographs rests on; instrument: with their level.  by_log: a telephone's log is it."""
    if not instrument.has_level_inside:
        return ""
    level = "felt by the telephone" if instrument.inclinometer_model == PHONE else "by the camera's level"
    where = "the telephone's log, as the camera's own" if by_log else f"the gravity in the files, {level}"
    return f"the level is {where}; time, zone and lens are the files', and their GPS is only compared"


def of_mark(place: Fix | Average, mark: "Near") -> str:
    """Compare a place with the one that GPS wrote into a frame's file, on WGS 84."""
    off = np.array([half_turn(place.longitude - mark.longitude), place.latitude - mark.latitude])
    off *= EARTH_RADIUS_M * np.array([np.cos(mark.latitude), 1.0])
    sigmas = float(np.sqrt(off @ np.linalg.solve(place.covariance[:2, :2], off)))
    km = mark.km_from(place.latitude, place.longitude)
    told = f"the place is {km:.0f} km from the GPS place in the file"
    if sigmas < CLAIMED_SIGMAS:
        return f"{told}, within the claim"
    within_km = CLAIMED_SIGMAS * float(np.sqrt(np.diag(place.covariance)[:2].max())) / 1000
    if ahead_h := _hours_ahead(replace(mark, km=within_km), place):
        side = "ahead of" if ahead_h > 0 else "behind"
        why = f"as of a clock {abs(ahead_h):g} h {side} the zone in the file: state its own with --exif-utc-offset"
    else:
        why = "the telephone moved while it exposed, or its GPS place is an older one"
    return f"{told}, {sigmas:.1f} sigma, beyond the claim: {why}"


def of_copies(fixes: Sequence[Fix]) -> str:
    """Say that some photographs are of the same moment as others."""
    copies = len(fixes) - len({f.utc_unix_s for f in fixes})
    return f"{copies} of the photographs are copies of others: they count once" if copies else ""


def of_table(fixes: Sequence[Fix], whole: Average, given: Instrument) -> str:
    """Say what --self-calibrate would give for a telephone that was turned on a table."""
    ups = np.array([f.tilt.up for f in fixes])
    middle = ups.mean(0) / np.linalg.norm(ups.mean(0))
    turns = np.sort([f.heading for f in fixes])
    gap = np.diff(turns, append=turns[0] + 2 * np.pi).max()
    known = given.calibration.frames > 0 or not given.has_level_inside
    if known or (ups @ middle).min() < TABLE_COSINE or gap > TABLE_GAP_RAD:
        return ""
    left = total_covariance(t for t in whole.terms if t.origin is not Origin.A3)
    km, now_km = (float(np.sqrt(np.diag(c)[:2].max())) / 1000 for c in (left, whole.covariance))
    return (
        "the camera was turned where it lay: --self-calibrate finds the error of its level, for a place to about "
        f"{km:.1f} km ({now_km:.1f} km without it), and with --save OUT later photographs have it"
    )


def of_extrapolation(solved: Iterable[Solution]) -> str:
    """Say by how many days the last fix lies beyond the IERS table, and how far it may be off for that."""
    worst = max(solved, key=lambda s: s.extrapolated_days, default=None)
    if worst is None or worst.fix is None or worst.extrapolated_days <= 0:
        return ""
    (ut1,) = (t for t in worst.fix.terms if t.name == "ut1")
    return (
        f"the Earth's rotation is extrapolated {worst.extrapolated_days:.0f} days beyond the IERS table, "
        f"{np.sqrt(ut1.covariance[0, 0]):.0f} m east (1 sigma, in the budget): upgrade astropy-iers-data"
    )


def of_average(whole: Average, solved: Sequence[Solution] = ()) -> Iterator[str]:
    """Say what an average leaves out; solved: the frames with its fixes, of which a single one left out is named."""
    there = whole.latitude, whole.longitude
    if whole.moved:
        begin = utc_text(whole.began_unix_s)
        yield f"the instrument was moved: the average is of its last place, {whole.frames} frames since {begin}"
    off = [(apart_m((f.latitude, f.longitude), there), s.source) for s in solved if (f := s.fix)]
    if whole.left_out == 1 and off and max(off)[1]:
        away_m, source = max(off)
        yield (
            f"{source}: its place lies {length_text(away_m)} from the place of the others, further than its errors "
            "allow: it is not in the average: check its tilt and time"
        )
    elif whole.left_out:
        yield (
            f"{whole.left_out} fixes lie further from the others than their errors allow: they are not in the average"
        )


def beyond_stated(place: Average | None) -> bool:
    """Whether the residuals of elevations are beyond their stated errors; they are if no place fits."""
    if place is None:
        return True
    shares = [np.trace(t.covariance[:2, :2]) for t in place.terms if t.name == SCATTER]
    return place.left_out > 0 or sum(shares) > np.trace(place.covariance[:2, :2]) / 2


def of_left_out(elevations: int) -> str:
    """Say that some elevations are not used."""
    told = (
        f"{elevations} elevations contradict the others and are left out: their tilts or pointings are wrong"
    )
    return told if elevations else ""


def of_elevations(place: Average) -> tuple[str, ...]:
    """Say which elevations the place is not from, and that the others scatter."""
    told = (
        "the elevations scatter by more than the stated errors of tilts and A3: the claimed error includes it"
    )
    return of_left_out(place.left_out), told if beyond_stated(replace(place, left_out=0)) else ""


def of_denied_a3(axis: FoundAxis, given: Calibration) -> str:
    """Say that the elevations deny the A3 that was given."""
    return (
        f"the elevations deny the A3 given, by {axis.sigma_from(given):.0f} sigma: the place is from the A3 that they "
        "determine: calibrate again"
    )


def worth_saving(turned: Calibrated) -> bool:
    """Whether the headings determine A3."""
    return turned.plumb_stddev_arcsec <= WORTH_SAVING_ARCSEC


def of_turn(turned: Calibrated) -> Iterator[str]:
    """Say how well A3 was found by turning."""
    error = f"the plumb line in the camera is known to {turned.plumb_stddev_arcsec:.2f} arcsec"
    if not worth_saving(turned):
        yield (f"not calibrated: the headings hardly determine A3, {error}: turn it further")
        return
    found = turned.instrument.calibration
    yield (f"calibrated: {error}; {checks.at_another_lean(found)}")
    if checks.may_turn(found):
        yield (f"to use A3 at another lean, {checks.FIND_TURN}")
    yield turned.beyond


NEAR_KM = 50.0
# a place is far if it lies this many sigma beyond the stated distance
FAR_SIGMA = 4.0
# Minimum distance between frames of one place whose tilts are mistaken, and factor by which the right tilts reduce it.
APART_M, NEARER = 20_000.0, 20.0
# clocks that are not on UTC are usually wrong by a multiple of this
ZONE_H = 0.5

# camera_to_itrs (3, 3) of a frame, and its tilt
Leaning = tuple[np.ndarray, Tilt]


def _of_minutes(theta: np.ndarray) -> np.ndarray:
    """Angles of which the digits behind the point are minutes and their decimals."""
    degrees, minutes = np.divmod(np.abs(np.degrees(theta)), 1)
    return np.radians(np.sign(theta) * (degrees + minutes / 0.6))


# possible mistakes in tilts, and functions that give the corrected angles (N, 2), rad
MISTAKES: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("theta_x and theta_y exchanged", lambda theta: theta[:, ::-1]),
    ("the other sign of theta_x", lambda theta: theta * [-1, 1]),
    ("the other sign of theta_y", lambda theta: theta * [1, -1]),
    ("the other sign of both tilts", lambda theta: -theta),
    ("tilts that were radians", np.degrees),
    ("tilts that were sines", lambda theta: np.arcsin(np.clip(np.degrees(theta), -1, 1))),
    ("tilts that were percent", lambda theta: np.arctan(np.degrees(theta) / 100)),
    ("tilts that were gon", lambda theta: 0.9 * theta),
    ("tilts that were degrees and minutes (dd.mm or dd.mmss)", _of_minutes),
)


@at_once
@dataclass(frozen=True)
class Near:
    """A place, in rad, at which the instrument is said to be within some km.

    stated_by: for sentences.  either_sign: whether its longitude may be counted to the west, as some programs do.
    """

    latitude: float
    longitude: float
    km: float = NEAR_KM
    stated_by: str = "--near"
    either_sign: bool = False

    @property
    def place(self) -> tuple[float, float]:
        """Latitude and longitude in rad."""
        return self.latitude, self.longitude

    def km_from(self, latitude: float, longitude: float) -> float:
        """Distance in km, on a sphere, to a place in rad."""
        return apart_m(self.place, (latitude, longitude)) / 1000


def doubts(
    fixes: Sequence[Fix], whole: Fix | Average, a3: np.ndarray | None, near: Near | None
) -> tuple[str, ...]:
    """Report places that mistaken tilts set apart, and a place far from `near`.

    a3 (3, 3): of the fixes' frames, None if it was not given: then it is not checked.
    """
    frames: list[Leaning] = [(f.camera.rotation, f.tilt) for f in fixes]
    return _mistaken(a3, frames), "" if near is None else _far(near, whole, a3, frames[-1:])


def apart_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Distance in m on a sphere of two places (latitude, longitude) in rad."""
    return EARTH_RADIUS_M * float(angle(zenith_of(*a), zenith_of(*b)))


def _far(near: Near, fix: Fix | Average, a3: np.ndarray | None, frames: Sequence[Leaning]) -> str:
    """Say that a fix lies far from a place, and which mistake would explain it; '' if it does not."""
    km = near.km_from(fix.latitude, fix.longitude)
    within_km = near.km + FAR_SIGMA * float(np.sqrt(np.diag(fix.covariance)[:2].max())) / 1000
    if km <= within_km:
        return ""
    told = f"the place is {km:.0f} km from {near.stated_by}, and should be within {near.km:g} km"
    ahead_h = _hours_ahead(near, fix)
    side = "ahead of" if ahead_h > 0 else "behind"
    other_side = replace(near, longitude=-near.longitude)
    if near.either_sign and other_side.km_from(fix.latitude, fix.longitude) <= within_km:
        if not ahead_h:
            return ""
        return f"{told}: its times may be {abs(ahead_h):g} h {side} UTC, or the header counts longitudes to the west"
    for name, places in _places(a3, frames):
        off = [near.km_from(*place) for place in places]
        if max(off) <= near.km:
            return f"{told}: with {name} it would be {max(off):.0f} km from there: check the tilts"
    if ahead_h:
        return f"{told}: its times may be {abs(ahead_h):g} h {side} UTC: check the clock of the camera"
    return f"{told}: check the times (UTC), the tilts and A3"


def _hours_ahead(near: Near, fix: Fix | Average) -> float:
    """Hours ahead of UTC by which wrong times explain a place; 0 if none do."""
    east = half_turn(fix.longitude - near.longitude)
    hours = round(-east / ROTATION_RAD_S / HOUR_S / ZONE_H) * ZONE_H
    turned = fix.longitude + hours * HOUR_S * ROTATION_RAD_S
    return hours if near.km_from(fix.latitude, turned) <= near.km else 0.0


def _mistaken(a3: np.ndarray | None, frames: Sequence[Leaning]) -> str:
    """Say which mistake has set the places of frames far apart; '' if none explains it.

    One heading alone never shows it: the same mistake then moves all places alike.
    """
    if a3 is None:
        return ""
    spread_m = _spread_m([_place(camera, tilt.theta, a3) for camera, tilt in frames])
    if spread_m < APART_M:
        return ""
    for name, places in _places(a3, frames):
        if (left_m := _spread_m(places)) < spread_m / NEARER:
            return (
                f"the frames' places lie {length_text(spread_m)} apart, and with {name} {length_text(left_m)}: "
                "check the table of tilts"
            )
    return ""


def _places(a3: np.ndarray | None, frames: Sequence[Leaning]) -> list[tuple[str, list[tuple[float, float]]]]:
    """The places of frames with two-axis tilts, by mistake."""
    if a3 is None or not frames or any(tilt.axes != 2 for _, tilt in frames):
        return []
    theta = np.array([tilt.theta for _, tilt in frames])
    found = []
    for name, corrected in MISTAKES:
        angles = corrected(theta)
        if np.abs(angles).max() < np.pi / 2:
            places = [_place(camera, one, a3) for (camera, _), one in zip(frames, angles, strict=True)]
            found.append((name, places))
    return found


def _place(camera_to_itrs: np.ndarray, theta: np.ndarray, a3: np.ndarray) -> tuple[float, float]:
    """Latitude, longitude (rad) of a frame with a tilt, without refraction."""
    place = local_north(level_of(up_of(theta)) @ a3 @ camera_to_itrs.T)
    return place.latitude, place.longitude


def _spread_m(places: Sequence[tuple[float, float]]) -> float:
    return max((apart_m(places[0], place) for place in places), default=0.0)
