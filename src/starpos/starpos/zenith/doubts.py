# SPDX-License-Identifier: Apache-2.0
"""A zenith session: its deflection, and what speaks against it: faces that do not come round, a jump of clock or zero."""

from collections.abc import Sequence

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.orientation import earth_motion
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError
from starpos.instrument.instrument import Instrument
from starpos.sky.catalogue import load_catalogue
from starpos.units import ARCSEC, utc_text
from starpos.zenith.adjustment import DeflectionSession, FaceQuality, adjusted, check_round
from starpos.zenith.sighting import ZenithSighting

# On land 6 arcsec are usual, over 25 are found in high mountains only, over 120 nowhere.
LARGE_ARCSEC, MAX_ARCSEC = 25.0, 120.0
# chi-square of a step or of a face, which chance exceeds in one session of 10^5 with hundreds of frames
DOUBTED_CHI2 = 36.0
# a face above that is named: chance does it in one of 1000 sessions of eight faces
UNLIKE_CHI2 = 18.0
# A tiltmeter is worse than stated where twice the log of the likelihood gains by this: chance does it in one session of
# 500.
WORSE_GAIN = 9.0
# a face with a smaller share of the usual number of frames is thin
THIN = 0.5
# Tycho-2 over 6 deg and more: less than 1 mas in places, of 1991.25, and about 0.5 mas a year in proper motions (Hog et
# al. 2000, A&A 355, L27, section 3).  A catalogue whose stars err by less than LIKE_GAIA_ARCSEC has no such zones.
ZONES_ARCSEC, ZONES_ARCSEC_PER_YEAR, ZONES_EPOCH, LIKE_GAIA_ARCSEC = 0.001, 0.0005, 1991.25, 0.005
# Limit on the scale's effect of differences of lean, in sigma of the deflection: beyond it the result assumes the same
# scale everywhere, which is not stated.
UNLEVEL_SIGMA = 3.0


def checked_session(
    sightings: Sequence[ZenithSighting], instrument: Instrument, atmosphere: Atmosphere, mark: Place
) -> DeflectionSession:
    """The deflection of a session; FixError, with a sentence, where the sightings do not bear one."""
    found = adjusted(sightings, instrument, atmosphere, mark)
    check_round(found.covariance_arcsec2, found.sightings, found.faces)
    for fit in (found.as_stated, found):
        chi2, sentence = (0.0, "") if fit is None else _doubt(fit)
        if chi2 > DOUBTED_CHI2 and not (fit is found.as_stated and _no_jump(found)):
            raise FixError(sentence)
    size = float(np.hypot(found.xi_arcsec, found.eta_arcsec))
    if size > MAX_ARCSEC:
        raise FixError(
            f"the deflection would be {size:.0f} arcsec, as on no place of the Earth: the site is "
            f"{_off(found)}, or the clock is wrong"
        )
    return found


def remarks(found: DeflectionSession, frames: int, scale: float) -> list[str]:
    """Sentences on possible faults of a deflection.

    frames: number that was given.  scale: stated error of the tiltmeter's scale.
    """
    said = []
    size = float(np.hypot(found.xi_arcsec, found.eta_arcsec))
    if size > LARGE_ARCSEC:
        said.append(
            f"the deflection is {size:.1f} arcsec, which only high mountains have: elsewhere the site is {_off(found)}, "
            "or the clock is wrong (1 s is 15 arcsec of eta at the equator)"
        )
    number = np.bincount(found.faces)
    for face in np.flatnonzero(number < THIN * np.median(number)):
        said.append(
            f"face {face + 1} has {number[face]} frames of the usual {np.median(number):.0f}: clouds, or its tilts were "
            "refused"
        )
    unlike = _unlike(found)
    for quality in unlike:
        xi, eta = quality.stddev_arcsec
        said.append(f"{_face_off(quality)} (1 sigma {xi:.2f}, {eta:.2f}): look at its frames")
    if not unlike and found.gain > WORSE_GAIN:
        said += _worse(found)
    zones = _zones_arcsec(found)
    if found.sigma_arcsec.min() < zones:
        said.append(
            f"zonal errors of Tycho-2, up to {zones:.3f} arcsec here, are not in the covariance: all sessions under "
            "these stars share them: use Gaia's places (starpos catalogue build --gaia)"
        )
    if frames > len(found.sightings):
        said.append(f"{frames - len(found.sightings)} of {frames} frames are left out")
    lean = max(np.ptp([s.tilt.theta[k] for s in found.sightings]) for k in (0, 1)) / ARCSEC
    if scale * lean > UNLEVEL_SIGMA * found.sigma_arcsec.max():
        said.append(
            f"the tiltmeter's angles differ by up to {lean:.0f} arcsec from face to face, of which its scale, known to "
            f"{scale:.2g}, makes {scale * lean:.2g} arcsec: level every face to "
            f"{found.sigma_arcsec.max() / scale:.0f} arcsec"
        )
    return said


def _doubt(fit: DeflectionSession) -> tuple[float, str]:
    """Chi-square of what speaks most against an adjustment, and the sentence about it."""
    return max((_clock(fit), _zero(fit), _face(fit)), key=lambda doubt: doubt[0])


def _no_jump(found: DeflectionSession) -> bool:
    """Whether a tiltmeter that is worse than stated explains the residuals better than one jump or one face does."""
    return found.same_air is not None and _doubt(found.same_air)[0] < found.gain


def _unlike(found: DeflectionSession) -> list[FaceQuality]:
    """The faces that are unlike the others."""
    if found.as_stated is None or found.same_air is None:
        return [face for face in found.face_quality if face.chi2 > UNLIKE_CHI2]
    # a larger drift or scale hides a face, which counts where it explains the residuals better
    both = zip(found.as_stated.face_quality, found.same_air.face_quality, strict=True)
    return [face for face, here in both if face.chi2 > UNLIKE_CHI2 and here.chi2 > found.gain]


def _worse(found: DeflectionSession) -> list[str]:
    """Errors of the tiltmeter that the residuals show larger than its file states them."""
    if found.as_stated is None:
        return []
    stated, shown = found.as_stated.inclinometer, found.inclinometer
    said = []
    for name, field, unit in (
        ("tilt_drift_arcsec_per_sqrt_hour", "drift_rad_per_sqrt_hour", ARCSEC),
        ("tilt_scale", "scale", 1.0),
    ):
        less, more = (getattr(errors, field) / unit for errors in (stated, shown))
        if more > 1.01 * less:
            said.append(
                f"the tiltmeter shows a {name} of {more:.2g}, its file states {less:.2g}: the errors hold what it "
                "shows; state that, or calibrate it"
            )
    return said


def _zones_arcsec(found: DeflectionSession) -> float:
    """Zonal errors of the catalogue at the session's date, at most; 0 for a catalogue like Gaia's."""
    year, _ = earth_motion(found.sightings[0].utc_unix_s)
    sigma = float(np.median(load_catalogue().sigma(found.stars, year))) / ARCSEC
    if sigma < LIKE_GAIA_ARCSEC:
        return 0.0
    return ZONES_ARCSEC + ZONES_ARCSEC_PER_YEAR * abs(year - ZONES_EPOCH)


def _off(found: DeflectionSession) -> str:
    """How far the site would be off."""
    north, east = np.array([found.xi_arcsec, found.eta_arcsec]) * ARCSEC * EARTH_RADIUS_M
    return (
        f"{np.hypot(north, east) / 1000:.1f} km off (the stars have it {abs(north):.0f} m "
        f"{'north' if north > 0 else 'south'} and {abs(east):.0f} m {'east' if east > 0 else 'west'} of there)"
    )


def _clock(found: DeflectionSession) -> tuple[float, str]:
    """Chi-square of the likeliest jump of the clock, and the sentence about it."""
    step, chi2, at = _steps(found, found.lines.by_second[..., None])
    when = utc_text(found.sightings[at].utc_unix_s)
    return chi2, (
        f"the clock that stamps the frames seems to have jumped by {step[0]:+.3f} s before {when}: use the frames "
        "before or after, or repeat the session with a disciplined clock"
    )


def _zero(found: DeflectionSession) -> tuple[float, str]:
    """Chi-square of the likeliest jump of the tiltmeter's zero, and the sentence about it."""
    step, chi2, at = _steps(found, np.broadcast_to(np.eye(2), (len(found.sightings), 2, 2)))
    x, y = step / ARCSEC
    # two parameters where the clock has one
    return chi2 - 2, (
        f"the tiltmeter's zero seems to have jumped by {x:+.2f}, {y:+.2f} arcsec before "
        f"{utc_text(found.sightings[at].utc_unix_s)}: use the frames before or after, or repeat the session"
    )


def _face(found: DeflectionSession) -> tuple[float, str]:
    """Chi-square of the face that goes least with the others, and the sentence about it."""
    if not found.face_quality:
        return 0.0, ""
    worst = max(found.face_quality, key=lambda face: face.chi2)
    # two parameters where the clock has one
    return worst.chi2 - 2, f"{_face_off(worst)}: leave its frames out, or repeat it"


def _face_off(face: FaceQuality) -> str:
    return (
        f"face {face.number + 1} (top of the frame at {face.heading_deg:.0f} deg, {face.frames} frames) is "
        f"{np.hypot(*face.off_arcsec):.2f} arcsec off what the others have"
    )


def _steps(found: DeflectionSession, columns: np.ndarray) -> tuple[np.ndarray, float, int]:
    """The likeliest jump (m,) along columns (N, 2, m), its chi-square, and the frame from which on it holds."""
    late = np.arange(len(columns))
    every = [found.tested(columns * (late >= k)[:, None, None]) for k in late[1:]]
    at = int(np.argmax([chi2 for _, _, chi2 in every]))
    step, _, chi2 = every[at]
    return step, chi2, at + 1
