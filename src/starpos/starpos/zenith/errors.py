# SPDX-License-Identifier: Apache-2.0
"""The errors of a session's readings, source by source, each with its whole covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.orientation import ROTATION_RAD_S
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.units import ARCSEC, HOUR_S
from starpos.zenith.lines import Lines
from starpos.zenith.places import StarPlaces
from starpos.zenith.sighting import Mark, ZenithSighting

# Unmeasured temperature of a tiltmeter: it follows a clear night's air, some degrees in a few hours.
UNKNOWN_WALK_C_PER_SQRT_HOUR = 2.0
# Daily and half-daily terms of UT1 and of the pole, which daily tables do not have. The values are the root mean square
# of the ocean tides' terms (IERS Conventions (2010), tables 8.2 and 8.3: M2 alone is 0.33 mas of the pole, O1 0.02 ms of
# UT1). They include the error of interpolating UT1 linearly across a day of its fortnightly tide (0.8 ms, table 8.1).
DAILY_UT1_S, DAILY_POLE_RAD = 3e-5, 3e-4 * ARCSEC
# Correlation time of anomalous refraction, within the minutes to hours of Hirt (2006), A&A 459, 283.
AIR_TAU_S = 1200.0


@dataclass(frozen=True, eq=False)
class Source:
    """A source of error: covariance (2 N, 2 N) in rad2 of the angles of N frames, X' and Y' of each in turn."""

    name: str
    covariance: np.ndarray

    @classmethod
    def shared(cls, name: str, columns: np.ndarray) -> "Source":
        """Independent errors of 1 sigma that all frames share: columns (N, 2, m)."""
        flat = columns.reshape(-1, columns.shape[2])
        return cls(name, flat @ flat.T)

    @classmethod
    def varying(cls, name: str, kernel: np.ndarray, legs: np.ndarray) -> "Source":
        """Errors of legs (N, 2, m) whose covariance from frame to frame is kernel (N, N)."""
        size = 2 * len(kernel)
        flat = legs.reshape(size, -1)
        return cls(name, np.repeat(np.repeat(kernel, 2, 0), 2, 1) * (flat @ flat.T))


@dataclass(frozen=True, eq=False, kw_only=True)
class Errors:
    """All errors of the readings: sources without the air, and the air's errors for 1 rad of each.

    motion: image motion, new in each frame.  air: anomalous refraction, that changes within AIR_TAU_S.
    """

    sources: tuple[Source, ...]
    motion: Source
    air: Source


def errors_of(
    lines: Lines,
    sightings: Sequence[ZenithSighting],
    places: StarPlaces,
    faces: np.ndarray,
    inclinometer: InclinometerErrors,
    mark: Mark,
    since_unix_s: float,
) -> Errors:
    """The errors of a session; since_unix_s: time at which the tiltmeter's zero was found with A3, NaN: unknown."""
    t = np.array([s.utc_unix_s for s in sightings])
    own = np.eye(len(t))
    apart_s = np.abs(t[:, None] - t)
    return Errors(
        sources=(
            *_of_tilts(sightings, faces, inclinometer, since_unix_s),
            *_of_stars(lines, sightings, places),
            *_of_time(lines, sightings, mark),
        ),
        motion=Source.varying("image motion", own, lines.by_lean),
        air=Source.varying("anomalous refraction", np.exp(-apart_s / AIR_TAU_S), lines.by_lean),
    )


def _of_tilts(
    sightings: Sequence[ZenithSighting],
    faces: np.ndarray,
    inclinometer: InclinometerErrors,
    since_unix_s: float,
) -> list[Source]:
    tilts = [s.tilt for s in sightings]
    theta, t = np.array([tilt.theta[:2] for tilt in tilts]), np.array([s.utc_unix_s for s in sightings])
    n, axes = len(t), np.broadcast_to(np.eye(2), (len(t), 2, 2))
    noise = np.array([np.linalg.cholesky(tilt.noise[:2, :2]) for tilt in tilts])
    begin = t.min() if np.isnan(since_unix_s) else min(since_unix_s, t.min())
    hours = np.minimum.outer(t - begin, t - begin) / HOUR_S
    same = _shared_readings(sightings)
    rounding = np.array([inclinometer.undithered_rad(tilt) for tilt in tilts])
    sources = [
        Source.varying("tilt readings", same, noise),
        Source.varying("tilt quantisation", np.eye(n), axes * rounding[:, None, None]),
        Source.varying("tilt drift", hours, axes * inclinometer.drift_rad_per_sqrt_hour),
        Source.shared("tilt scale", axes * theta[..., None] * inclinometer.scale),
        Source.shared("tilt cross", theta[:, ::-1, None] * inclinometer.cross),
        Source.varying("tilt face", faces[:, None] == faces, axes * inclinometer.pose_rad),
    ]
    warm = np.array([tilt.temperature_c for tilt in tilts])
    per_c = inclinometer.temperature_rad_per_c
    if np.isfinite(warm).all():
        sources.append(
            Source.shared("tilt temperature", axes * ((warm - warm.mean()) * per_c)[:, None, None])
        )
    else:
        walk = hours * UNKNOWN_WALK_C_PER_SQRT_HOUR**2
        sources.append(Source.varying("tilt temperature", walk, axes * per_c))
    return sources


def _shared_readings(sightings: Sequence[ZenithSighting]) -> np.ndarray:
    """Correlation (N, N) of the mean tilts of frames, of which neighbours may share readings."""
    times = [s.tilt.times or (s.utc_unix_s,) for s in sightings]
    number = np.array([len(t) for t in times])
    reading = np.unique(np.concatenate(times), return_inverse=True)[1]
    member = np.zeros((len(times), reading.max() + 1))
    member[np.repeat(np.arange(len(times)), number), reading] = 1 / np.sqrt(np.repeat(number, number))
    return member @ member.T


def _of_stars(lines: Lines, sightings: Sequence[ZenithSighting], places: StarPlaces) -> list[Source]:
    n = len(sightings)
    roots = np.linalg.cholesky([s.centroids for s in sightings])
    bent = np.array([s.by_refraction for s in sightings])
    rows = np.array([s.by_rows for s in sightings])
    return [
        Source.varying("centroids", np.eye(n), lines.by_camera @ roots),
        Source.shared("catalogue", places.columns(lines.by_camera, sightings)),
        Source.shared("refraction", lines.by_camera @ bent[..., None]),
        Source.shared("shutter", lines.by_camera @ rows),
    ]


def _of_time(lines: Lines, sightings: Sequence[ZenithSighting], mark: Mark) -> list[Source]:
    # in a second the sky turns about the pole
    second = lines.by_sky @ (mark.enu[:, 2] * ROTATION_RAD_S)
    clock = np.array([np.hypot(s.clock_stddev_s, s.stamp_stddev_s) for s in sightings])
    ut1 = np.array([s.orientation.ut1_sigma_s for s in sightings])
    pole = np.array([s.orientation.pole_sigma for s in sightings])
    return [
        Source.shared("clock", (second * clock[:, None])[..., None]),
        Source.shared("ut1", (second * np.hypot(ut1, DAILY_UT1_S)[:, None])[..., None]),
        Source.shared("pole", lines.by_sky @ mark.enu[:, :2] * np.hypot(pole, DAILY_POLE_RAD)[:, None, None]),
    ]
