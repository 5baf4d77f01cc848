# SPDX-License-Identifier: Apache-2.0
"""Plans a session: the quickest one whose deflection has a wanted error, by the adjustment's own covariance.

A planned session is one of sightings without errors; `adjusted` gives the covariance that real ones would have.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S, EarthState
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError
from starpos.frames.exposure import UNKNOWN_SHUTTER
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument
from starpos.sky.catalogue import Catalogue
from starpos.units import MAS_DEG
from starpos.zenith.adjustment import AIR_SHARE, Air, adjusted
from starpos.zenith.sighting import ZenithSighting, site_attitude

# a round: a quarter turn from face to face
FACES = 4
ROUNDS = (1, 2, 3, 4, 6)
MIN_FRAMES, MAX_FRAMES = 3, 240
# number of stars planned in a frame; they get a smaller error if the frame has more
GROUPS = 12
# How faces happen to lean decides how well the tiltmeter's turn is known, and so up to a third of the error: number of
# sessions whose mean is a plan.
LEVELLINGS = 3


@dataclass(frozen=True, kw_only=True)
class ZenithSky:
    """What a frame at the zenith of a site sees.

    stars: their number.  centroid_rad: error of one on the frame, a coordinate.  catalogue_rad: of its place in the
    catalogue.  radius_rad: root mean square distance of the stars from the middle.  crossing_s: time for which a star
    stays on the frame, infinite at a pole.
    """

    stars: float
    centroid_rad: float
    catalogue_rad: float
    radius_rad: float
    crossing_s: float

    @classmethod
    def of(
        cls,
        catalogue: Catalogue,
        camera: Camera,
        latitude: float,
        limit_mag: float,
        centroid_px: float,
        year: float,
    ) -> "ZenithSky":
        """The mean over a day; limit_mag: V of the faintest stars that a frame shows.  FixError where it shows none."""
        width, height = camera.width / camera.fx, camera.height / camera.fy
        half = np.degrees(max(width, height)) / 2
        zenith_deg = np.degrees(latitude)
        low, high = max(zenith_deg - half, -90.0), min(zenith_deg + half, 90.0)
        dec_deg = catalogue.dec_mas * MAS_DEG
        rows = np.flatnonzero((dec_deg > low) & (dec_deg < high) & (catalogue.vmag() < limit_mag))
        band = 2 * np.pi * (np.sin(np.radians(high)) - np.sin(np.radians(low)))
        stars = len(rows) / band * width * height
        if stars < 1:
            raise FixError(
                f"a frame at this zenith shows {stars:.1f} stars of V < {limit_mag:g}: take a wider field, or state a "
                "fainter --limit-mag"
            )
        drift = ROTATION_RAD_S * np.cos(latitude)
        return cls(
            stars=stars,
            centroid_rad=centroid_px / camera.fx,
            # the adjustment weighs its stars by these errors
            catalogue_rad=float(np.mean(catalogue.sigma(rows, year) ** -2) ** -0.5),
            radius_rad=float(np.hypot(width, height) / np.sqrt(12)),
            crossing_s=float(np.sqrt(width * height) / drift) if drift > 1e-3 * ROTATION_RAD_S else np.inf,
        )


@dataclass(frozen=True, kw_only=True)
class Routine:
    """How an instrument works.

    frame_s: from frame to frame.  turning_s: from the last frame of a face to the first of the next.
    readings: of the tiltmeter in a frame.  level_rad: 1 sigma of the lean of a face, a component.
    """

    frame_s: float
    turning_s: float
    readings: int
    level_rad: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionPlan:
    """A session, and what it would give.

    frames: in each face.  sigma_arcsec (2,): of xi, eta.  terms: 1 sigma of xi and eta for each source of error.
    """

    rounds: int
    frames: int
    duration_s: float
    sigma_arcsec: np.ndarray
    terms: tuple[tuple[str, float, float], ...]

    @property
    def faces(self) -> int:
        """Number of faces."""
        return FACES * self.rounds

    @property
    def largest_arcsec(self) -> float:
        """The larger one of the errors of xi and eta."""
        return float(self.sigma_arcsec.max())


@dataclass(frozen=True, eq=False, kw_only=True)
class Planner:
    """All that does not change from plan to plan; state: of the Earth when the session begins."""

    instrument: Instrument
    camera: Camera
    atmosphere: Atmosphere
    mark: Place
    sky: ZenithSky
    routine: Routine
    motion_rad: float
    state: EarthState

    def plan(self, rounds: int, frames: int) -> SessionPlan:
        """A session of rounds of four faces, with frames in each."""
        air = Air(motion=self.motion_rad, anomalous=self.motion_rad * AIR_SHARE)
        begun = [
            adjusted(
                list(self._sightings(rounds, frames, seed)), self.instrument, self.atmosphere, self.mark, air
            )
            for seed in range(LEVELLINGS)
        ]
        names = [name for name, *_ in begun[0].terms]
        terms = np.sqrt(np.mean([[np.square(t[1:]) for t in one.terms] for one in begun], 0))
        return SessionPlan(
            rounds=rounds,
            frames=frames,
            duration_s=self._duration_s(rounds, frames),
            sigma_arcsec=np.sqrt(np.mean([one.sigma_arcsec**2 for one in begun], 0)),
            terms=tuple((name, xi, eta) for name, (xi, eta) in zip(names, terms.tolist(), strict=True)),
        )

    def _duration_s(self, rounds: int, frames: int) -> float:
        faces, work = FACES * rounds, self.routine
        return faces * frames * work.frame_s + (faces - 1) * (work.turning_s - work.frame_s)

    def quickest(self, sigma_arcsec: float) -> SessionPlan:
        """The quickest plan whose xi and eta have at most that error; FixError, with the reason, where none has."""
        best, longest = None, None
        for rounds in ROUNDS:
            low, high = MIN_FRAMES - 1, MAX_FRAMES // (FACES * rounds)
            if best is not None and best.duration_s < self._duration_s(rounds, MIN_FRAMES):
                break
            plan = longest = self.plan(rounds, high)
            if plan.largest_arcsec > sigma_arcsec:
                continue
            while plan.frames - low > 1:
                tried = self.plan(rounds, (low + plan.frames) // 2)
                if tried.largest_arcsec > sigma_arcsec:
                    low = tried.frames
                else:
                    plan = tried
            if best is None or plan.duration_s < best.duration_s:
                best = plan
        if best is not None:
            return best
        assert longest is not None
        name, xi, eta = max(longest.terms, key=lambda term: max(term[1:]))
        raise FixError(
            f"{sigma_arcsec:g} arcsec is not reached: {longest.faces} faces of {longest.frames} frames in "
            f"{longest.duration_s / 60:.0f} min leave {longest.largest_arcsec:.3f}, of which {name} makes "
            f"{max(xi, eta):.3f}: improve that, or average several nights"
        )

    def _sightings(self, rounds: int, frames: int, seed: int) -> Iterator[ZenithSighting]:
        # leans that are the same in every plan
        rng = np.random.default_rng(seed)
        a3, t = self.instrument.calibration.a3, 0.0
        for face in range(FACES * rounds):
            level = rotation.from_vector([*rng.normal(0, self.routine.level_rad, 2), 0.0])
            sensor = level @ rotation.about_axis(2, np.radians(360.0 * face / FACES))
            for _ in range(frames):
                yield self._sighting(a3.T @ sensor, np.arcsin(sensor[:2, 2]), t)
                t += self.routine.frame_s
            t += self.routine.turning_s - self.routine.frame_s

    def _sighting(self, attitude: np.ndarray, theta: np.ndarray, since_s: float) -> ZenithSighting:
        sky, instrument, readings = self.sky, self.instrument, self.routine.readings
        begin = since_s / sky.crossing_s * GROUPS
        stars = np.arange(np.ceil(begin), np.ceil(begin) + GROUPS).astype(int)
        noise = np.eye(2) * instrument.inclinometer.noise_rad**2 / readings
        utc_unix_s = self.state.utc_unix_s + since_s
        # the mean of its stars turns the attitude, each by its share
        across = rotation.cross_matrix(np.array([0.0, 0.0, 1.0])) @ attitude
        by_star = across * sky.catalogue_rad / np.sqrt(sky.stars * GROUPS)
        roll = sky.centroid_rad / sky.radius_rad
        rows = np.linspace(0, self.camera.height - 1, 9)
        late_s = (instrument.shutter or UNKNOWN_SHUTTER).errors_s(rows, self.camera.height).mean(0)
        drift = -ROTATION_RAD_S * (attitude @ self.mark.axes[:, 2])
        return ZenithSighting(
            utc_unix_s=utc_unix_s,
            camera=site_attitude(
                attitude, np.diag([sky.centroid_rad, sky.centroid_rad, roll]) ** 2 / sky.stars
            ),
            stars=stars,
            by_star=np.repeat(by_star[:, None], GROUPS, 1),
            star_weight=np.zeros((GROUPS, 3, 3)),
            star_common=np.zeros((4, GROUPS, 3)),
            star_pull=np.zeros((GROUPS, 3)),
            by_refraction=np.zeros(3),
            by_rows=np.outer(drift, late_s),
            residual_arcsec=np.zeros((GROUPS, 2)),
            tilt=Tilt(float(theta[0]), float(theta[1]), noise, utc_unix_s=utc_unix_s, samples=readings),
            orientation=self.state.orientation,
            clock_stddev_s=instrument.clock_stddev_s,
        )
