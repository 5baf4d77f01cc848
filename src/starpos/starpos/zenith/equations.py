# SPDX-License-Identifier: Apache-2.0
"""The observation equations of a session: what a tiltmeter reads by attitudes, deflection and A3, and its errors.

Up leans from the ellipsoid's normal by xi to the north and eta to the east, so in geodetic east, north, up it is along
n = (eta, xi, 1).  The tiltmeter's axes X', Y' rise by asin(A3 C n) there, where C is the camera's attitude by the stars.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.earth.place import Place
from starpos.fix.terms import ErrorTerm
from starpos.instrument.inclinometer import OUTDOORS_WALK_C_PER_SQRT_HOUR, InclinometerErrors
from starpos.units import ARCSEC, HOUR_S
from starpos.zenith.sighting import StarPlaces, ZenithSighting

TURNS_TRIED = 360


@dataclass(frozen=True, eq=False, kw_only=True)
class LeanEstimate:
    """A deflection, lean (2,): how far up leans to the north and to the east (xi, eta), rad; and A3 (3, 3)."""

    lean: np.ndarray
    a3: np.ndarray

    def moved(self, step: np.ndarray) -> "LeanEstimate":
        """The estimate after a step (5,): xi, eta, and a small rotation of A3 about S's axes."""
        return LeanEstimate(lean=self.lean + step[:2], a3=rotation.from_vector(step[2:]) @ self.a3)

    def deflection(self, latitude: float) -> np.ndarray:
        """Deflection (2,) xi, eta in rad at a geodetic latitude, by the astronomic latitude and longitude of up.

        xi is the difference of the latitudes, eta the difference of the longitudes times cos(latitude) (Heiskanen and
        Moritz 1967,
        section 5-4).  It differs from up's lean by xi eta tan(latitude), 3 mas at 80 deg for 10 arcsec of each.
        """
        north, east = self.lean
        sine, cosine = np.sin(latitude), np.cos(latitude)
        across = cosine - sine * north
        astronomic = np.arctan2(sine + cosine * north, np.hypot(east, across))
        return np.array([astronomic - latitude, np.arctan2(east, across) * cosine])


@dataclass(frozen=True, eq=False, kw_only=True)
class Lines:
    """The equations of N frames, linear about a LeanEstimate.

    off (N, 2): readings minus those that the estimate predicts, rad.
    Derivatives of the prediction: by_parameters (N, 2, 5) as in `LeanEstimate.moved`; by_camera (N, 2, 3), by a small
    rotation of the camera about C's axes; by_sky (N, 2, 3), by one of the sky about ITRS's axes.
    """

    off: np.ndarray
    by_parameters: np.ndarray
    by_camera: np.ndarray
    by_sky: np.ndarray

    @property
    def by_lean(self) -> np.ndarray:
        """Derivatives (N, 2, 2) by xi and eta, up's lean to the north and to the east."""
        return self.by_parameters[..., :2]

    @property
    def by_second(self) -> np.ndarray:
        """Derivatives (N, 2) by a second of the clock, in which the sky turns about the pole, rad."""
        return self.by_sky[..., 2] * ROTATION_RAD_S

    @classmethod
    def at(
        cls, estimate: LeanEstimate, sightings: Sequence[ZenithSighting], bending: float, mark: Place
    ) -> "Lines":
        """The equations about an estimate.

        bending: refraction (rad) for 1 rad of zenith distance.  The attitudes count it from the ellipsoid's normal; light
        is bent towards the plumb line, so all stars stand that share of the deflection further over.
        """
        attitude = np.array([s.enu_to_camera for s in sightings])
        shown = 1 - bending
        north, east = shown * estimate.lean
        up = rotation.normalised(np.array([east, north, 1.0]))
        sensor = estimate.a3 @ attitude
        there = sensor @ up
        slope = 1 / np.sqrt(1 - there[:, :2] ** 2)
        theta = np.array([s.tilt.theta[:2] for s in sightings])

        def of(turn: np.ndarray) -> np.ndarray:
            """Change (N, 2, 3) of the angles, where up moves by `turn` (N, 3, 3)."""
            return slope[..., None] * turn[:, :2]

        lean = of(sensor)[..., [1, 0]] * shown
        a3 = of(-rotation.cross_matrices(there))
        camera = of(estimate.a3 @ -rotation.cross_matrices(attitude @ up))
        return cls(
            off=theta - np.arcsin(there[:, :2]),
            by_parameters=np.concatenate([lean, a3], 2),
            by_camera=camera,
            by_sky=of(sensor @ -rotation.cross_matrix(up) @ mark.axes),
        )


def start_of(sightings: Sequence[ZenithSighting]) -> LeanEstimate:
    """An estimate from nothing: the turn of the tiltmeter about the plumb line for which all frames agree best.

    For a given turn the equations are linear in the deflection and the two tilts of A3.
    """
    attitude = np.array([s.enu_to_camera for s in sightings])
    theta = np.sin([s.tilt.theta[:2] for s in sightings])
    n = len(theta)
    # unknown: two tilts of the camera, eta, xi
    design = np.concatenate([np.broadcast_to(np.eye(2), (n, 2, 2)), attitude[:, :2, :2]], 2).reshape(2 * n, 4)
    gain = np.linalg.pinv(design)
    turns = np.arange(TURNS_TRIED) * 2 * np.pi / TURNS_TRIED
    c, s = np.cos(turns), np.sin(turns)
    # readings along the camera's axes, if A3 turns by each angle
    back = np.stack([np.outer(theta[:, 0], c) + np.outer(theta[:, 1], s),
                     np.outer(theta[:, 1], c) - np.outer(theta[:, 0], s)], 1)  # fmt: skip
    y = (back - attitude[:, :2, 2, None]).reshape(2 * n, TURNS_TRIED)
    left = y - design @ (gain @ y)
    best = int(np.argmin((left**2).sum(0)))
    across, down, eta, xi = gain @ y[:, best]
    a3 = rotation.about_axis(2, turns[best])
    # A3 takes C's x by `across` up and its y by `down`
    tilted = rotation.from_vector(a3 @ np.array([-down, across, 0.0]))
    return LeanEstimate(lean=np.array([xi, eta]), a3=tilted @ a3)


# Daily and half-daily terms of UT1 and of the pole, which daily tables do not have. The values are the root mean square
# of the ocean tides' terms (IERS Conventions (2010), tables 8.2 and 8.3: M2 alone is 0.33 mas of the pole, O1 0.02 ms of
# UT1). They include the error of interpolating UT1 linearly across a day of its fortnightly tide (0.8 ms, table 8.1).
DAILY_UT1_S, DAILY_POLE_RAD = 3e-5, 3e-4 * ARCSEC
# Correlation time of anomalous refraction, within the minutes to hours of Hirt (2006), A&A 459, 283.
AIR_TAU_S = 1200.0


# errors of the air: new in each frame, and changing within AIR_TAU_S
MOTION, ANOMALOUS = "image motion", "anomalous refraction"


def errors_of(
    lines: Lines,
    sightings: Sequence[ZenithSighting],
    places: StarPlaces,
    faces: np.ndarray,
    inclinometer: InclinometerErrors,
    since_unix_s: float,
) -> dict[str, np.ndarray]:
    """Covariances (2 N, 2 N) in rad2, by source, of the readings X', Y' of N frames; of the air, for errors of 1 rad.

    since_unix_s: time at which the tiltmeter's zero was found with A3, NaN: unknown.
    """
    t = np.array([s.utc_unix_s for s in sightings])
    own = np.eye(len(t))
    apart_s = np.abs(t[:, None] - t)
    terms = (
        *_of_tilts(sightings, faces, inclinometer, since_unix_s),
        *_of_stars(lines, sightings, places),
        *_of_time(lines, sightings),
        ErrorTerm.of_frames(MOTION, lines.by_lean, own),
        ErrorTerm.of_frames(ANOMALOUS, lines.by_lean, np.exp(-apart_s / AIR_TAU_S)),
    )
    return {t.name: t.covariance for t in terms}


def _of_tilts(
    sightings: Sequence[ZenithSighting],
    faces: np.ndarray,
    inclinometer: InclinometerErrors,
    since_unix_s: float,
) -> list[ErrorTerm]:
    tilts = [s.tilt for s in sightings]
    theta, t = np.array([tilt.theta[:2] for tilt in tilts]), np.array([s.utc_unix_s for s in sightings])
    n, axes = len(t), np.broadcast_to(np.eye(2), (len(t), 2, 2))
    noise = np.array([np.linalg.cholesky(tilt.noise[:2, :2]) for tilt in tilts])
    begin = t.min() if np.isnan(since_unix_s) else min(since_unix_s, t.min())
    hours = np.minimum.outer(t - begin, t - begin) / HOUR_S
    same = _shared_readings(sightings)
    rounding = np.array([inclinometer.undithered_rad(tilt) for tilt in tilts])
    sources = [
        ErrorTerm.of_frames("tilt readings", noise, same),
        ErrorTerm.of_frames("tilt quantisation", axes * rounding[:, None, None], np.eye(n)),
        ErrorTerm.of_frames("tilt drift", axes * inclinometer.drift_rad_per_sqrt_hour, hours),
        ErrorTerm.of_frames("tilt scale", axes * theta[..., None] * inclinometer.scale),
        ErrorTerm.of_frames("tilt cross", theta[:, ::-1, None] * inclinometer.cross),
        ErrorTerm.of_frames("tilt face", axes * inclinometer.pose_rad, faces[:, None] == faces),
    ]
    warm = np.array([tilt.temperature_c for tilt in tilts])
    per_c = inclinometer.temperature_rad_per_c
    if np.isfinite(warm).all():
        sources.append(
            ErrorTerm.of_frames("tilt temperature", axes * ((warm - warm.mean()) * per_c)[:, None, None])
        )
    else:
        walk = hours * OUTDOORS_WALK_C_PER_SQRT_HOUR**2
        sources.append(ErrorTerm.of_frames("tilt temperature", axes * per_c, walk))
    return sources


def _shared_readings(sightings: Sequence[ZenithSighting]) -> np.ndarray:
    """Correlation (N, N) of the mean tilts of frames, of which neighbours may share readings."""
    times = [s.tilt.times or (s.utc_unix_s,) for s in sightings]
    number = np.array([len(t) for t in times])
    reading = np.unique(np.concatenate(times), return_inverse=True)[1]
    member = np.zeros((len(times), reading.max() + 1))
    member[np.repeat(np.arange(len(times)), number), reading] = 1 / np.sqrt(np.repeat(number, number))
    return member @ member.T


def _of_stars(lines: Lines, sightings: Sequence[ZenithSighting], places: StarPlaces) -> list[ErrorTerm]:
    n = len(sightings)
    roots = np.linalg.cholesky([s.camera.covariance_about_own for s in sightings])
    bent = np.array([s.by_refraction for s in sightings])
    rows = np.array([s.by_rows for s in sightings])
    return [
        ErrorTerm.of_frames("centroids", lines.by_camera @ roots, np.eye(n)),
        ErrorTerm.of_frames("catalogue", places.columns(lines.by_camera, sightings)),
        ErrorTerm.of_frames("refraction", lines.by_camera @ bent[..., None]),
        ErrorTerm.of_frames("shutter", lines.by_camera @ rows),
    ]


def _of_time(lines: Lines, sightings: Sequence[ZenithSighting]) -> list[ErrorTerm]:
    clock = np.array([np.hypot(s.clock_stddev_s, s.stamp_stddev_s) for s in sightings])
    ut1 = np.array([s.orientation.ut1_sigma_s for s in sightings])
    pole = np.array([s.orientation.pole_sigma for s in sightings])
    return [
        ErrorTerm.of_frames("clock", (lines.by_second * clock[:, None])[..., None]),
        ErrorTerm.of_frames("ut1", (lines.by_second * np.hypot(ut1, DAILY_UT1_S)[:, None])[..., None]),
        ErrorTerm.of_frames("pole", lines.by_sky[..., :2] * np.hypot(pole, DAILY_POLE_RAD)[:, None, None]),
    ]
