# SPDX-License-Identifier: Apache-2.0
"""Sentences about frames and fixes that cannot be right: noise, no sky, below the horizon, a moved camera, an unknown
A3.
"""

import math
from collections.abc import Iterable

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S, EarthState, earth_state
from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError, PlaceError, TimeError
from starpos.fix.budget import CALIBRATION
from starpos.fix.fix import Fix, angle_text, zenith_variance
from starpos.fix.terms import ErrorTerm
from starpos.frames.frame import SATURATED, Stars
from starpos.frames.reading import why_no_time
from starpos.frames.tables import Pointing
from starpos.identification import MIN_STARS, Identification, Sky, fisheye
from starpos.identification._frame import mean_sigma
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import unnamed
from starpos.sky import deeper
from starpos.sky.catalogue import Catalogue
from starpos.units import ARCSEC, HOUR_S, utc_text

# Lowest altitude with a known refraction.
MIN_DEG = np.degrees(np.arcsin(MIN_COS_ZENITH))


def state_at(frame: Stars | Pointing) -> EarthState:
    """The state of the Earth at a frame; TimeError if its time is not known, or cannot be used."""
    if frame.mid_unix_s is None:
        raise TimeError(f"{frame.place}: no time of exposure: {why_no_time(frame)}")
    return earth_state(frame.mid_unix_s)


def check_above_horizon(sine: float, calibration: Calibration) -> None:
    """Raise FixError if a camera's stars are below the horizon, or where no refraction is known.

    sine: of the altitude of their middle by the tilts and A3. While A3 is not known, as before it is found by turning,
    this has no meaning.
    """
    if not calibration.unknown and sine < MIN_COS_ZENITH:
        raise FixError(
            f"by the tilts and A3 the stars are {_altitude_text(sine)}, and a position needs stars {MIN_DEG:.0f} "
            f"deg or more above it: check the signs and the order of the inclinometer's axes, and A3"
        )


def check_visible(sine: float) -> None:
    """Raise PlaceError if a camera's stars cannot be seen from a known place; sine: of the altitude of the lowest."""
    if sine < MIN_COS_ZENITH:
        raise PlaceError(
            f"from the given place the stars, or some, are {_altitude_text(sine)}, and a heading needs stars "
            f"{MIN_DEG:.0f} deg or more above it: check latitude and longitude, their order and signs, "
            f"and the clock"
        )


# More identified stars than these below this altitude, and than this share of all detections there, are no mistakes of
# the identification: a lamp on the ground has a star in its place once in ten times at most
FEW_SET, SET_SHARE, SET_DEG = 3, 0.3, -1.0


def set_stars(sines: np.ndarray, detected: np.ndarray) -> str:
    """Say that identified stars lie under the horizon; '' if at most a few do.

    sines (N,): of their altitudes.  detected (D,): the same of all detections.
    """
    under = _under(sines)
    if under <= max(FEW_SET, SET_SHARE * _under(detected)):
        return ""
    lowest = _altitude_text(float(sines.min()))
    return f"{under} of the {len(sines)} identified stars would be under the horizon, the lowest {lowest}"


def _under(sines: np.ndarray) -> int:
    return int(np.count_nonzero(sines < math.sin(math.radians(SET_DEG))))


def check_risen(stars: Stars, found: Identification, camera: Camera, sky: Sky, up: np.ndarray) -> None:
    """Raise PlaceError if a frame's identified stars would lie under the horizon of a known place.

    up (3,): the zenith in C there.  Of a fisheye all stars count, as the lens puts them that they show: the one given may
    fit the middle of the frame only.
    """
    every, star = camera.directions(stars.x, stars.y), found.star
    if _under(every @ up) <= FEW_SET:
        return
    if fisheye.is_wide(camera) and not found.mirrored:
        rows = np.flatnonzero(stars.on_frame & np.isfinite(every[:, 0]))
        field = fisheye.WideField(every[rows], mean_sigma(stars.covariance[rows]), camera)
        part = fisheye.part_of(field, sky, found.but(star=np.searchsorted(rows, star)))
        whole = fisheye.outwards(sky, *part)
        if whole is not None and whole[2]:
            lens, better, _ = whole
            every, star = lens.directions(stars.x, stars.y), rows[better.star]
            up = better.attitude @ found.attitude.T @ up
    sines = every @ up
    if low := set_stars(sines[star], sines):
        raise PlaceError(
            f"from the given place {low}: check latitude and longitude, their order and signs, and the hour (UTC, not "
            "local time)"
        )


def _altitude_text(sine: float) -> str:
    altitude_deg = np.degrees(np.arcsin(max(sine, -1.0)))
    return f"{abs(altitude_deg):.1f} deg {'above' if altitude_deg > 0 else 'below'} the horizon"


# A trail of which this much more than the stars' width (times it, and px) is missing; and the smallest width of a trail
# across, px, for which the detector's FWHM is the geometric mean of length and width.
TRAIL_WIDTHS, TRAIL_PX, ACROSS_PX = 3.0, 3.0, 0.8
# The same by the stars' shapes, which the detector's covariances have: a trail that is this many times as long as wide
# is missed where the stars have less than this share of what it would add.
LONGER_THAN_WIDE, MISSED_SHARE = 1.15, 0.3
# (FWHM / length)^2 of the normal curve with a trail's variance
TRAIL_VARIANCE = 8 * math.log(2) / 12


def check_exposure(stars: Stars, camera: Camera, directions: np.ndarray) -> None:
    """Raise FixError if stars are points although the camera, at rest, would show trails of the exposure's length.

    directions (N, 3): of stars on the frame, GCRS.
    """
    if stars.fwhm_px is None or not stars.exposure_s:
        return
    across_pole = math.sqrt(1 - float(np.mean(directions[:, 2] ** 2)))
    trail_px = ROTATION_RAD_S * stars.exposure_s * across_pole * camera.fx
    too_narrow = trail_px > max(TRAIL_WIDTHS * stars.fwhm_px + TRAIL_PX, stars.fwhm_px**2 / ACROSS_PX)
    if too_narrow or _too_round(stars.covariance, stars.fwhm_px**2, trail_px):
        raise FixError(
            f"{stars.place}: its stars are points of {stars.fwhm_px:.1f} px (FWHM), and an exposure of "
            f"{stars.exposure_s:g} s of a camera at rest makes trails of {trail_px:.0f} px: its exposure time is wrong "
            "(milliseconds?), or it was tracked, added or stacked: give single frames of a camera at rest with their own "
            "times"
        )


# Trails are of the sky's motion if their directions agree so well with it, rad, and with each other (the mean of unit
# vectors). They show a longer exposure than stated if they are LONG times as long as wide, and their length is beyond
# LONGER_THAN_STATED times the expected one and LONGER_PX.
ALONG_SKY_RAD, IN_LINE, LONG = math.radians(5.0), 0.9, 1.4
LONGER_THAN_STATED, LONGER_PX = 2.0, 2.0


def check_trails(
    stars: Stars, rows: np.ndarray, camera: Camera, attitude: np.ndarray, directions: np.ndarray
) -> None:
    """Raise FixError if stars are trails along the sky's motion that are far longer than the exposure stated.

    rows (N,): of the stars with these directions (N, 3), GCRS, to which attitude (3, 3) turns the camera.
    """
    if stars.fwhm_px is None or not stars.exposure_s or len(rows) < MIN_STARS:
        return
    covariance = stars.covariance[rows]
    # a list of stars has round errors
    if not np.any(covariance[:, 0, 1]):
        return
    later = directions + ROTATION_RAD_S * np.cross([0.0, 0.0, 1.0], directions)
    # px in a second
    motion = camera.project(later @ attitude.T) - camera.project(directions @ attitude.T)
    size, axes = np.linalg.eigh(covariance)
    turned = np.angle(axes[:, 0, 1] + 1j * axes[:, 1, 1]) - np.angle(motion[:, 0] + 1j * motion[:, 1])
    # a trail has no end that is its first
    mean = complex(np.mean(np.exp(2j * turned)))
    if abs(mean) < IN_LINE or abs(np.angle(mean)) > 2 * ALONG_SKY_RAD:
        return
    longer = math.sqrt(float(np.median(size[:, 1] / size[:, 0])))
    trail_px = stars.fwhm_px * math.sqrt((longer - 1 / longer) / TRAIL_VARIANCE)
    stated_px = stars.exposure_s * float(np.median(np.linalg.norm(motion, axis=1)))
    if longer > LONG and trail_px > LONGER_THAN_STATED * stated_px + LONGER_PX:
        raise FixError(
            f"{stars.place}: its stars are trails of about {trail_px:.0f} px along the sky's motion, and an exposure of "
            f"{stars.exposure_s:g} s of a camera at rest makes {stated_px:.1f} px: its exposure time is wrong (minutes?) "
            "or it is a sum of exposures: give single frames with their own times"
        )


def _too_round(covariance: np.ndarray, area: float, trail_px: float) -> bool:
    """Whether the stars are far rounder than trails: their errors along and across are as their lengths and widths."""
    if not np.any(covariance[:, 0, 1]):
        return False
    small, large = np.linalg.eigvalsh(covariance).T
    longer = math.sqrt(float(np.median(large / small)))
    # a trail's area is the measured one; along it the variances of star and trail add up
    more = TRAIL_VARIANCE * trail_px**2
    expected = area / (0.5 * (math.hypot(more, 2 * area) - more))
    return expected > LONGER_THAN_WIDE and longer - 1 < MISSED_SHARE * (expected - 1)


# a camera at rest gets beyond it once in 900 frames
UNMOVED_SIGMAS = 4.0


def check_unmoved(fix: Fix, instrument: Instrument) -> None:
    """Raise FixError if a camera with a vertical of its own has turned against the Earth since its calibration.

    A camera that was moved looks like one at another place, but not like the same camera at the same place.
    """
    vertical = instrument.vertical
    if vertical is None:
        return
    then = np.asarray(vertical.camera_to_itrs, float)
    turned = fix.camera.rotation @ then.T
    since_s = abs(fix.utc_unix_s - instrument.calibration.utc_unix_s)
    sag2 = instrument.inclinometer.drift_rad_per_sqrt_hour**2 * since_s / HOUR_S
    # the air bends the whole field by about as much as it moves the zenith, then and now
    air2 = 2 * zenith_variance(t for t in fix.terms if t.name == "refraction")
    covariance = fix.camera.covariance + np.asarray(vertical.covariance_arcsec2) * ARCSEC**2
    covariance = covariance + np.eye(3) * (sag2 + air2)
    covariance[2, 2] += 2 * (ROTATION_RAD_S * fix.clock_stddev_s) ** 2
    angle = float(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    small = rotation.to_small_vector(turned)
    if angle < 0.5 and small @ np.linalg.solve(covariance, small) <= UNMOVED_SIGMAS**2:
        return
    raise FixError(
        f"the camera has moved, by {angle_text(angle)} against the Earth since its calibration of "
        f"{utc_text(instrument.calibration.utc_unix_s)}, where {angle_text(UNMOVED_SIGMAS * np.sqrt(sag2))} of sag are "
        "allowed for (or the clock is off): calibrate it again at a known place, or use an inclinometer"
    )


# Number of detections that show the distribution of their brightness.
MIN_DETECTIONS = 150
# If the brightest hundredth is less than this many times as bright as the median, all are noise.
MIN_RANGE, BRIGHTEST_SHARE = 3.5, 0.01


def why_noise(stars: Stars) -> str:
    """A sentence that says why the detections on a frame are noise; '' if they may be stars, and for a list of stars."""
    # only a detector says how wide images are; the flux of a list may be anything that sorts it
    if stars.fwhm_px is None or len(stars) < MIN_DETECTIONS:
        return ""
    brightest = float(stars.flux[int(BRIGHTEST_SHARE * len(stars))] / np.median(stars.flux))
    if brightest >= MIN_RANGE:
        return ""
    return (
        f"{stars.place}: its {len(stars)} detections are noise, because nearly all are equally bright (the brightest "
        f"hundredth {brightest:.1f} times the median): check exposure and lens cap, and save pictures without compression"
    )


# Images wider than this (FWHM, px) are out of focus, or the frame has more pixels than its lens resolves.
WIDE_PX = 8.0
# If this share of the brightest detections is saturated, their order of brightness may be wrong.
BRIGHTEST_STARS, MANY_SATURATED = 20, 0.5
# Half of the widest field that lenses without a fisheye's projection usually have, rad.
USUAL_HALF_FIELD = math.radians(50.0)


def why_unidentified(stars: Stars, camera: Camera, catalogue: Catalogue) -> str:
    """The sentence for a frame of which no part of the sky was found."""
    n = len(stars)
    wide = stars.fwhm_px is not None and stars.fwhm_px > WIDE_PX
    saturated = (stars.flags & SATURATED) != 0
    if n < MIN_STARS:
        hint = f" ({int(saturated.sum())} saturated)" if saturated.any() else ""
        found = f"{n} stars detected{hint}"
        focus = (
            f"they are {stars.fwhm_px:.0f} px wide (FWHM): focus"
            if wide
            else "check clouds, focus and exposure"
        )
        return f"{stars.place}: {found}, at least {MIN_STARS} are needed: {focus}"
    causes = []
    if thin := deeper.too_thin(catalogue, camera):
        causes.append(thin)
    if wide:
        causes.append(f"its stars are {stars.fwhm_px:.0f} px wide (FWHM): focus, or bin the pixels")
    if np.mean(saturated[:BRIGHTEST_STARS]) >= MANY_SATURATED:
        causes.append(
            f"{int(saturated[:BRIGHTEST_STARS].sum())} of its {min(n, BRIGHTEST_STARS)} brightest are saturated, so that "
            "their order of brightness says little: expose for a shorter time"
        )
    if camera.half_diagonal_rad > USUAL_HALF_FIELD and not fisheye.is_wide(camera):
        causes.append("a lens as wide as this is usually a fisheye (equidistant)")
    causes.append(f"check the focal length ({camera.fx:.0f} px given, 3 % is allowed), clouds and exposure")
    return f"{stars.place}: no part of the sky matches its {n} stars: {'; '.join(causes)}"


# what to do, in the options of `starpos solve` and in the parameters of the node
BY_OPTIONS = (
    "turn the instrument on the spot and give --self-calibrate, find it at a known place with starpos calibrate "
    "--site, or state it with --misalignment and --misalignment-stddev"
)
BY_PARAMETERS = (
    "turn the instrument on the spot and set self_calibration:=true, find it at a known place with solver/calibrate or "
    "starpos calibrate --site and set calibration_url, or set misalignment and misalignment_stddev"
)
# the same for the errors of the inclinometer
MODEL_BY_OPTIONS = (
    "name it with --inclinometer MODEL, or its model or errors (tilt_...) in an instrument file"
)
MODEL_BY_PARAMETERS = "set inclinometer.model, or name it or its errors in the file of calibration_url"
# of one lean nothing is known of the turn about the plumb line: then an angle has a sigma of some 100 deg
UNKNOWN_DEG = 60.0
# a turn that is known better than so is said to be known; a place that is wider is worth a word
KNOWN_DEG, WIDE_M = 5.0, 10_000.0
FIND_TURN = (
    "calibrate with leans of some degrees between the frames, or state it with --misalignment and "
    "--turn-stddev"
)


def unknown_a3(
    calibration: Calibration, covariance: np.ndarray, terms: Iterable[ErrorTerm], ways: str = BY_OPTIONS
) -> str:
    """Say in a sentence that A3, or its turn about the plumb line, makes a place wide, and what to do; '' if not.

    covariance: of the place, (2, 2) or larger, of east m and north m first.  terms: the budget of it, or of a fix there.
    ways: what to do where nothing is known of A3.
    """
    metres = float(np.sqrt(np.diag(covariance)[:2].max()))
    if calibration.unknown:
        return (
            f"the misalignment of camera and inclinometer is not known, so the position error is "
            f"{metres / 1000:.0f} km (1 sigma): {ways}"
        )
    own = sum(np.trace(t.covariance[:2, :2]) for t in terms if t.name == CALIBRATION)
    if metres < WIDE_M or own < 0.5 * np.trace(covariance[:2, :2]) or not may_turn(calibration):
        return ""
    return (
        "the instrument leans otherwise than when A3 was found, and A3's turn about the plumb line, "
        f"{_turn_text(calibration)}, makes the position error {metres / 1000:.0f} km (1 sigma): lean it as then, "
        f"or {FIND_TURN}"
    )


def unnamed_inclinometer(instrument: Instrument, ways: str = MODEL_BY_OPTIONS) -> str:
    """Say that no inclinometer is stated, and which one is assumed; '' if one is stated."""
    if (
        instrument.vertical is not None
        or instrument.inclinometer_model
        or instrument.inclinometer != unnamed()
    ):
        return ""
    return (
        "the inclinometer's model is not stated: the errors of an SCA100T as sold are assumed, "
        f"{np.degrees(unnamed().pose_rad):.2f} deg, 7 km or more (1 sigma): {ways}"
    )


def may_turn(calibration: Calibration) -> bool:
    """Whether A3's turn about the plumb line is hardly known."""
    return calibration.turn_stddev_deg > KNOWN_DEG


def at_another_lean(calibration: Calibration) -> str:
    """Say how well A3's turn about the plumb line is known, which counts at another lean."""
    return f"at another lean A3's turn about the plumb line matters, {_turn_text(calibration)}"


def _turn_text(calibration: Calibration) -> str:
    turn_deg = calibration.turn_stddev_deg
    return "which is not known" if turn_deg > UNKNOWN_DEG else f"known to {turn_deg:.2g} deg"
