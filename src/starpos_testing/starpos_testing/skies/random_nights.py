# SPDX-License-Identifier: Apache-2.0
"""Random nights, solved as a user would and compared with their truth: they test whether stated errors are right.

The paper has fifty such nights.  Drawn at random are the place, how camera and inclinometer are fixed to each other, the
inclinometer's zero, drift, scale and temperature, the air, the clock, the Earth's rotation and the errors of the
catalogue.  The instrument knows only their sizes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from starpos import rotation
from starpos.averaging.average import Average, average
from starpos.calibration.misalignment import calibrate_at, turn
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import ROTATION_RAD_S, earth_orientation
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection, geodetic
from starpos.errors import StarposError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.instrument.tilt_log import TiltLog
from starpos.rotation import half_turn
from starpos.simulation.scene import Scene, TiltErrors, detected, expose, read_tilt
from starpos.sky.catalogue import EPOCH, Catalogue
from starpos.sky.site import Site, camera_to_enu
from starpos.units import ARCSEC, DAY_S, MAS

# the paper's camera
CAMERA = Camera.from_focal(5616, 3744, 93750.0)
EXPOSURE_S, READINGS, CADENCE_S, TURN_S = 0.5, 5, 5.0, 60.0
# 2016 to 2026.
FIRST_UNIX_S, LAST_UNIX_S = 1451606400.0, 1798761600.0
# 1 sigma of the lean that a turn by hand causes
LEAN_DEG = 0.05


def tiltmeter(noise_arcsec: float) -> InclinometerErrors:
    """Errors of a tiltmeter whose drift is as small as its noise."""
    noise = noise_arcsec * ARCSEC
    return InclinometerErrors(
        noise_rad=noise, quantum_rad=noise / 8, drift_rad_per_sqrt_hour=noise, temperature_rad_per_c=noise
    )


@at_once
@dataclass(frozen=True, kw_only=True)
class NightWorld:
    """The truth of a night, and the instrument's knowledge of it.

    scene: the instrument with its errors at its place, under the stars of `sky`.  site: its place by gravity.
    clock_s: its time stamps minus UTC.  per_c (2,): change of the inclinometer's zero in rad per deg C.
    `told`, air: instrument and air as the user knows them.
    """

    scene: Scene
    site: Site
    sky: Catalogue
    clock_s: float
    per_c: np.ndarray
    told: Instrument
    air: Atmosphere


@at_once
@dataclass(frozen=True, kw_only=True)
class NightOutcome:
    """Errors of one night and the covariances stated for them.

    off (3,): east m, north m, heading rad, against the astronomic truth; off_ground: against the geodetic truth.
    trouble: why there is no answer; then all numbers are NaN.
    """

    kind: str
    off: np.ndarray
    covariance: np.ndarray
    off_ground: np.ndarray
    covariance_ground: np.ndarray
    trouble: str = ""

    @property
    def position_nees(self) -> float:
        """Squared error of the astronomic place in units of its covariance; 2 on average if that is right."""
        return float(self.off[:2] @ np.linalg.solve(self.covariance[:2, :2], self.off[:2]))

    @property
    def ground_nees(self) -> float:
        """Squared error of the geodetic place in units of its covariance; 2 on average if that is right."""
        m = self.off_ground[:2]
        return float(m @ np.linalg.solve(self.covariance_ground[:2, :2], m))

    @property
    def heading_nees(self) -> float:
        """Squared error of the heading in units of its variance; 1 on average if that is right."""
        return float(self.off[2] ** 2 / self.covariance[2, 2])


@dataclass(eq=False)
class Zero:
    """The zero of an inclinometer as it wanders with time."""

    errors: InclinometerErrors
    rng: np.random.Generator
    now_s: float
    rad: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def at(self, unix_s: float) -> np.ndarray:
        """The zero (2,) in rad at a time, not before the last one."""
        hours = max(unix_s - self.now_s, 0.0) / 3600
        self.rad = self.rad + self.rng.normal(0, 1, 2) * self.errors.drift_rad_per_sqrt_hour * np.sqrt(hours)
        self.now_s = max(self.now_s, unix_s)
        return self.rad


def draw(
    rng: np.random.Generator,
    catalogue: Catalogue,
    errors: InclinometerErrors,
    clock_stddev_s: float,
    camera: Camera,
) -> tuple[NightWorld, float]:
    """Draw a world at a random time and place; returns it with the time (Unix s)."""
    begin = rng.uniform(FIRST_UNIX_S, LAST_UNIX_S)
    year = EPOCH + (begin - 946728000.0) / (365.25 * DAY_S)
    altitude, roll = rng.uniform(70, 86), rng.uniform(0, 360)
    azimuth = rng.uniform(0, 360)
    truth = Calibration().turned_to(_mounted(rng, camera_to_enu(azimuth, altitude, roll)[2]))
    told = Instrument(camera.fx, inclinometer=errors, clock_stddev_s=clock_stddev_s)
    airs = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3), Atmosphere.measured(None, None)
    air = airs[rng.choice(len(airs))]
    scene = Scene(
        camera=camera,
        instrument=replace(told, calibration=truth),
        site=Site(0.0, 0.0),
        azimuth_deg=azimuth,
        altitude_deg=altitude,
        roll_deg=roll,
        tilt_errors=TiltErrors(
            errors.noise_rad,
            tuple(rng.normal(0, np.radians(0.1), 2)),
            scale=tuple(rng.normal(0, errors.scale, 2)),
            quantum=errors.quantum_rad,
        ),
    )
    world = NightWorld(
        scene=scene,
        site=Site(0.0, 0.0),
        sky=_with_errors(catalogue, year, rng),
        clock_s=float(rng.normal(0, clock_stddev_s)),
        per_c=rng.normal(0, errors.temperature_rad_per_c, 2),
        told=told,
        air=air,
    )
    return at_place(world, rng, begin), begin


def at_place(world: NightWorld, rng: np.random.Generator, unix_s: float) -> NightWorld:
    """The instrument at another random place, in other air, with other errors of the Earth's rotation."""
    latitude = np.degrees(np.arcsin(rng.uniform(np.sin(np.radians(-66)), np.sin(np.radians(66)))))
    longitude = rng.uniform(-180, 180)
    air = world.air
    pressure = np.clip(rng.normal(air.pressure_pa, air.pressure_stddev_pa), 40e3, 115e3)
    temperature = np.clip(rng.normal(air.temperature_c, air.temperature_stddev_c), -50, 50)
    true_air = replace(air, pressure_pa=float(pressure), temperature_c=float(temperature))
    orientation = earth_orientation(unix_s)
    east = rng.normal(0, orientation.ut1_sigma_s) * ROTATION_RAD_S
    pole = rng.normal(0, orientation.pole_sigma, 2)
    seen = Site(
        latitude + np.degrees(pole[1]),
        longitude + np.degrees(east + pole[0] / np.cos(np.radians(latitude))),
        true_air,
    )
    return replace(world, scene=replace(world.scene, site=seen), site=Site(latitude, longitude))


def _mounted(rng: np.random.Generator, up: np.ndarray) -> np.ndarray:
    """A3 (3, 3) of an inclinometer that is upright to about 1 deg and faces anywhere; `up` (3,): the zenith in C."""
    x, y = np.sin(np.radians(rng.normal(0, 1, 2)))
    plumb = np.array([x, y, np.sqrt(1 - x * x - y * y)])
    return rotation.from_vector(plumb * rng.uniform(0, 2 * np.pi)) @ rotation.shortest_turn(up, plumb)


def _with_errors(catalogue: Catalogue, year: float, rng: np.random.Generator) -> Catalogue:
    """The true sky: each star is off its catalogue place by an error of the size stated for the year."""
    n = len(catalogue)
    sigma = catalogue.sigma(np.arange(n), year) / MAS
    east, north = rng.normal(0, 1, (2, n)) * sigma
    dec = catalogue.dec_mas * MAS
    ra = catalogue.ra_mas + np.round(east / np.maximum(np.cos(dec), 1e-3)).astype(catalogue.ra_mas.dtype)
    return replace(
        catalogue, ra_mas=ra, dec_mas=catalogue.dec_mas + np.round(north).astype(catalogue.dec_mas.dtype)
    )


def photograph(
    world: NightWorld,
    zero: Zero,
    begin: float,
    turns_deg: Sequence[float],
    frames: int,
    rng: np.random.Generator,
) -> tuple[list[Stars], np.ndarray, float]:
    """Frames at several headings, with a turn by hand in between; returns stars, readings and the last heading (rad).

    readings (N, 4): Unix s, theta_x, theta_y in rad, deg C.
    """
    stars: list[Stars] = []
    rows: list[tuple[float, ...]] = []
    now = begin
    # deg C, and deg C per hour
    warmth, trend = rng.normal(0, 2.0), rng.normal(0, 1.0)
    for turned in turns_deg:
        lean = rng.normal(0, LEAN_DEG, 2)
        scene = world.scene
        scene = replace(
            scene,
            azimuth_deg=scene.azimuth_deg + turned,
            altitude_deg=scene.altitude_deg + lean[0],
            roll_deg=scene.roll_deg + lean[1],
        )
        for _ in range(frames):
            light = expose(scene, world.sky, now, EXPOSURE_S, rng)
            stars.append(detected(scene, light, now + EXPOSURE_S / 2 + world.clock_s, EXPOSURE_S, rng))
            warm = warmth + trend * (now - begin) / 3600
            off = zero.at(now) + scene.tilt_errors.zero + warm * world.per_c
            shaky = replace(scene, tilt_errors=replace(scene.tilt_errors, zero=tuple(off)))
            for k in range(READINGS):
                moment = now + (k + 0.5) * EXPOSURE_S / READINGS + world.clock_s
                rows.append((moment, *read_tilt(shaky, rng), 15.0 + warm))
            now += CADENCE_S
        now += TURN_S
    return stars, np.array(rows), scene.heading


def _tilt_log(world: NightWorld, readings: np.ndarray) -> TiltLog:
    utc_unix_s, theta_x, theta_y, temperature_c = readings.T
    return TiltLog.of(utc_unix_s, theta_x, theta_y, temperature_c, world.told.inclinometer.noise_rad)


def turned_night(
    rng: np.random.Generator,
    catalogue: Catalogue,
    errors: InclinometerErrors = SCA100T_CALIBRATED,
    headings: int = 4,
    frames: int = 25,
    clock_stddev_s: float = 0.01,
    camera: Camera = CAMERA,
) -> NightOutcome:
    """A night of an instrument with unknown A3 that is turned on the spot."""
    world, begin = draw(rng, catalogue, errors, clock_stddev_s, camera)
    turns = [k * 360 / headings for k in range(headings)]
    stars, readings, heading = photograph(world, Zero(errors, rng, begin), begin, turns, frames, rng)
    solver = Solver(world.told, catalogue, world.air)

    def answer() -> Average:
        return average(turn(solver, stars, _tilt_log(world, readings)).fixes)

    return _outcome("turned", answer, world.site, heading, rng)


def calibrated_night(
    rng: np.random.Generator,
    catalogue: Catalogue,
    errors: InclinometerErrors = SCA100T_CALIBRATED,
    frames: int = 6,
    clock_stddev_s: float = 0.01,
    camera: Camera = CAMERA,
) -> NightOutcome:
    """A night after a calibration: calibrated at a known place with two leans, days before at another place."""
    world, begin = draw(rng, catalogue, errors, clock_stddev_s, camera)
    zero = Zero(errors, rng, begin)
    stars, before, _ = photograph(world, zero, begin, [0.0], frames, rng)
    lower = replace(world, scene=replace(world.scene, altitude_deg=world.scene.altitude_deg - 5))
    more, after, _ = photograph(lower, zero, begin + 3600, [0.0], frames, rng)
    tilts = _tilt_log(world, np.concatenate([before, after]))
    solver = Solver(world.told, catalogue, world.air)
    later = begin + DAY_S * rng.uniform(0.1, 20)
    there = at_place(world, rng, later)
    there = replace(
        there, scene=replace(there.scene, altitude_deg=there.scene.altitude_deg + rng.normal(0, 1.0))
    )

    shots, readings, heading = photograph(there, zero, later, [0.0], frames, rng)

    def answer() -> Average:
        found = calibrate_at(solver, stars + more, tilts, world.site.place)
        ready, levels = replace(solver, instrument=found.instrument), _tilt_log(there, readings)
        solutions = [ready.solve(s, levels) for s in shots]
        return average([s.fix for s in solutions if s.fix])

    return _outcome("calibrated", answer, there.site, heading, rng)


def _outcome(
    kind: str, answer: Callable[[], Average], site: Site, heading: float, rng: np.random.Generator
) -> NightOutcome:
    """Compare an answer with the truth: the astronomic site and the heading (rad)."""
    try:
        a = answer()
    except StarposError as e:
        nothing, no_covariance = np.full(3, np.nan), np.full((3, 3), np.nan)
        return NightOutcome(
            kind=kind,
            off=nothing,
            covariance=no_covariance,
            off_ground=nothing,
            covariance_ground=no_covariance,
            trouble=str(e),
        )
    unknown = Deflection()
    xi, eta = rng.normal(0, unknown.stddev_arcsec, 2)
    phi, lam = np.radians([site.latitude_deg, site.longitude_deg])
    true = geodetic(phi, lam, heading, np.zeros((3, 3)), Deflection(xi, eta, 0.0))
    said = geodetic(a.latitude, a.longitude, a.heading, a.covariance, unknown)
    return NightOutcome(
        kind=kind,
        off=_apart(a.latitude - phi, a.longitude - lam, a.heading - heading, phi),
        covariance=a.covariance,
        off_ground=_apart(
            said.latitude - true.latitude, said.longitude - true.longitude, said.heading - true.heading, phi
        ),
        covariance_ground=said.covariance,
    )


def _apart(latitude: float, longitude: float, heading: float, phi: float) -> np.ndarray:
    """East m, north m, heading rad (3,) of differences in rad at the latitude phi."""
    prime, meridian = curvature_radii_m(phi)
    return np.array([half_turn(longitude) * prime * np.cos(phi), latitude * meridian, half_turn(heading)])
