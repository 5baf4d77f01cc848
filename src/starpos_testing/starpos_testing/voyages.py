# SPDX-License-Identifier: Apache-2.0
"""Voyages of vehicles with their truth: inertial readings, velocities and stars that an instrument on board would record.

Nothing here is the product's: readings are differences of a path in inertial axes, under a gravity of its own.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from starpos.instrument.camera import Camera
from starpos.navigation.records import ImuLog, ImuModel, VelocityLog
from starpos.navigation.sightings import PlacelessFrame, placeless

# Unix, in November 2026.
BEGIN_S = 1.7937e9
SPIN, SEMI_AXIS, FLATTENING = 7.292115e-5, 6378137.0, 1 / 298.257223563
CAMERA_TO_BODY = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FOCAL_PX, HALF_PX, STARS, STAR_SIGMA_PX = 4266.0, (968.0, 608.0), 30, 0.2
LIGHT_M_PER_S = 299792458.0
INDUSTRIAL = ImuModel(
    gyroscope_noise_density=4.4e-5,
    accelerometer_noise_density=3.3e-4,
    gyroscope_random_walk=1.6e-7,
    accelerometer_random_walk=6.3e-6,
    gyroscope_bias_stddev=8.7e-4,
    accelerometer_bias_stddev=0.0294,
    scale_stddev=5e-4,
    axes_stddev=5.2e-4,
)
TACTICAL = ImuModel(
    gyroscope_noise_density=1.5e-5,
    accelerometer_noise_density=1.3e-4,
    gyroscope_random_walk=2.4e-8,
    accelerometer_random_walk=1.3e-6,
    gyroscope_bias_stddev=4.8e-5,
    accelerometer_bias_stddev=0.0098,
    scale_stddev=1e-4,
    axes_stddev=8.7e-5,
)


def ellipsoid_place(latitude_deg, longitude_deg, height_m):
    """Place (3,) on WGS 84, m, and the rows east, north, up (3, 3) there."""
    phi, lam = np.radians([latitude_deg, longitude_deg])
    e2 = FLATTENING * (2 - FLATTENING)
    prime = SEMI_AXIS / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    return up * [prime + height_m, prime + height_m, prime * (1 - e2) + height_m], np.array(
        [east, np.cross(up, east), up]
    )


def geodetic_of(place):
    """Latitude, longitude in rad and height in m of places (N, 3), by iteration (Heiskanen and Moritz 1967, 5-3)."""
    e2, across = FLATTENING * (2 - FLATTENING), np.hypot(place[:, 0], place[:, 1])
    phi = np.arctan2(place[:, 2], across * (1 - e2))
    for _ in range(8):
        prime = SEMI_AXIS / np.sqrt(1 - e2 * np.sin(phi) ** 2)
        phi = np.arctan2(place[:, 2] + e2 * prime * np.sin(phi), across)
    height = across * np.cos(phi) + place[:, 2] * np.sin(phi) - SEMI_AXIS**2 / prime
    return phi, np.arctan2(place[:, 1], place[:, 0]), height


def attraction(place):
    """WGS 84's gravitational attraction, (N, 3) in m/s2, at (N, 3) places that turn with the Earth."""
    phi, lam, height = geodetic_of(place)
    sin2 = np.sin(phi) ** 2
    normal = 9.7803253359 * (1 + 1.931852652e-3 * sin2) / np.sqrt(1 - FLATTENING * (2 - FLATTENING) * sin2)
    normal = normal * (1 - 3.15704e-7 * height * (1 - 0.00142 * sin2) + 7.37e-14 * height**2)
    up = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], -1)
    return -normal[:, None] * up - SPIN**2 * place * [1, 1, 0]


def waves(rng, amplitude, low_s, high_s, number=5):
    """A function of time: a sum of sines whose standard deviation is the amplitude."""
    rate, phase = 2 * np.pi / rng.uniform(low_s, high_s, number), rng.uniform(0, 2 * np.pi, number)
    return lambda t: amplitude * np.sqrt(2 / number) * np.sin(np.multiply.outer(t, rate) + phase).sum(-1)


def carried(wave, begin, rate):
    """A function of time: a wave about what begins somewhere and grows at a rate."""
    return lambda t: begin + rate * t + wave(t)


def walking_wind(walk, terms=160):
    """A wind that walks at random from 0 by `walk` m/s/sqrt(s): a function of generator and seconds that makes its way.

    A way is a function of time, in m.  The first terms of the walk's series by Karhunen and Loeve: as smooth as an
    accelerometer needs it.
    """

    def way(rng, seconds):
        rate = (np.arange(terms) + 0.5) * np.pi / seconds
        velocity = rng.normal(0, walk * np.sqrt(2 / seconds), terms) / rate
        return lambda t: (velocity / rate * (1 - np.cos(np.multiply.outer(t, rate)))).sum(-1)

    return way


def turbulent_wind(stddev, outer_s=600.0, terms=160):
    """A wind of that standard deviation, m/s, whose spectrum falls with the frequency's 5/3rd power beyond 1/outer_s.

    Likewise; sines of periods from 10 s to two hours (Kolmogorov 1941).
    """

    def way(rng, seconds):
        edges = np.geomspace(1 / 7200, 0.1, terms + 1)
        rate, phase = 2 * np.pi * np.sqrt(edges[1:] * edges[:-1]), rng.uniform(0, 2 * np.pi, terms)
        power = np.diff(edges) / (1 + (rate * outer_s / np.pi) ** (5 / 3))
        length = stddev * np.sqrt(2 * power / power.sum()) / rate
        return lambda t: (length * (np.sin(np.multiply.outer(t, rate) + phase) - np.sin(phase))).sum(-1)

    return way


def swinging_wind(stddev, period_s):
    """A wind that swings with a period in s, and an amplitude of that standard deviation, m/s; likewise."""

    def way(rng, seconds):
        rate, phase, amplitude = 2 * np.pi / period_s, rng.uniform(0, 2 * np.pi), rng.normal(0, stddev)
        return lambda t: amplitude / rate * (np.sin(rate * t + phase) - np.sin(phase))

    return way


def path_of(kind, seconds, rng, more_wind=None):
    """Functions of time: displacement (N, 3) in m east, north, up, and roll, pitch, yaw (N, 3) in rad (ROS)."""
    begin = rng.uniform(0, 2 * np.pi)
    grid = np.arange(-1.0, seconds + 1.0, 0.05)
    lean, heave = [np.zeros_like] * 2, [np.zeros_like] * 3
    speed, yaw = 0.0 * grid, begin + 0.0 * grid
    if kind == "rover":
        moving = np.clip((grid - 10) / 10, 0, 1)
        yaw = begin + moving * (2 * np.pi * grid / 150 + waves(rng, 0.5, 40, 120)(grid))
        speed = 0.8 * moving * (1 + 0.5 * np.sin(2 * np.pi * grid / 90))
        lean = [waves(rng, np.radians(4), 12, 50) for _ in range(2)]
    elif kind == "ship":
        yaw = begin + np.clip(grid - 30, 0, 240) * 2 * np.pi / 240 + waves(rng, 0.02, 8, 20)(grid)
        speed = 5.0 + waves(rng, 0.1, 60, 200)(grid)
        lean = [waves(rng, np.radians(4), 7, 11), waves(rng, np.radians(1.5), 5, 8)]
        heave = [waves(rng, 0.4, 6, 11) for _ in range(3)]
    elif kind == "drone":
        yaw = begin + 2 * np.pi * grid / 100 + waves(rng, 0.02, 4, 12)(grid)
        speed = 20.0 + waves(rng, 0.3, 8, 40)(grid)
        bank, wind = np.arctan(20 * 2 * np.pi / 100 / 9.81), rng.normal(0, 3, 2)
        lean = [carried(waves(rng, 0.02, 2, 8), -bank, 0.0), waves(rng, 0.02, 2, 8)]
        heave = [carried(waves(rng, 0.5, 5, 20), 0.0, v) for v in (*wind, 0.0)]
        if more_wind is not None:
            ways = [more_wind(rng, seconds) for _ in range(2)]
            heave[:2] = [
                lambda t, steady=steady, way=way: steady(t) + way(t)
                for steady, way in zip(heave, ways, strict=False)
            ]
    elif kind == "parked":
        lean = [lambda t, a=a: a + 0 * t for a in (0.03, -0.02)]
    else:
        raise ValueError(kind)
    course = CubicSpline(grid, yaw)
    track = [CubicSpline(grid, part).antiderivative() for part in (speed * np.cos(yaw), speed * np.sin(yaw))]

    def displacement(t):
        return np.stack([track[0](t) + heave[0](t), track[1](t) + heave[1](t), heave[2](t)], -1)

    return displacement, lambda t: np.stack([lean[0](t), lean[1](t), course(t)], -1)


@dataclass(frozen=True, eq=False, kw_only=True)
class MadeVoyage:
    """What was recorded, and the truth at frames_s (F,), Unix s: latitude, longitude, heading in rad (F,), place (F, 3).

    body_to_itrs (F, 3, 3), mount (3, 3): the camera into the body.
    """

    imu: ImuLog
    velocity: VelocityLog
    frames: list[PlacelessFrame]
    latitude: np.ndarray
    longitude: np.ndarray
    heading: np.ndarray
    place: np.ndarray
    body_to_itrs: np.ndarray
    mount: np.ndarray
    frames_s: np.ndarray


def made(
    kind="rover",
    seconds=240.0,
    seed=1,
    model=INDUSTRIAL,
    latitude_deg=48.0,
    longitude_deg=11.0,
    height_m=300.0,
    rate_hz=50.0,
    cadence_s=1.0,
    mount_deg=1.0,
    velocity_sigma=0.03,
    errors=True,
    more_wind=None,
    drive=None,
    shaking=0.3,
):
    """Record a voyage; without `errors` the readings are exact, the mount as believed and the stars where they are.

    more_wind: of a drone, an axis, besides a steady one: `walking_wind`, `turbulent_wind`, `swinging_wind`.
    drive: in place of the kind's way, one of `halting`, whose wheels shake the accelerometer, m/s2.
    """
    rng, on = np.random.default_rng(seed), float(errors)
    if drive is None:
        displacement, angles = path_of(kind, seconds, rng, more_wind)
    else:
        way = drive(seconds, rng)
        displacement, angles = way.displacement, way.angles
    origin, axes = ellipsoid_place(latitude_deg, longitude_deg, height_m)

    def place(t):
        return origin + displacement(t) @ axes

    def inertial(t, vectors):
        return Rotation.from_rotvec(np.outer(SPIN * t, [0, 0, 1])).apply(vectors)

    def body(t):
        return Rotation.from_matrix(axes.T) * Rotation.from_euler("ZYX", angles(t)[:, ::-1])

    dt, h = 1 / rate_hz, 1e-3
    end = np.arange(1, int(seconds * rate_hz) + 1) * dt
    middle = end - dt / 2
    edges = np.append(0.0, end)
    speed = (inertial(edges + h, place(edges + h)) - inertial(edges - h, place(edges - h))) / (2 * h)
    pull = inertial(middle, attraction(place(middle)))
    turned = Rotation.from_rotvec(np.outer(SPIN * edges, [0, 0, 1])) * body(edges)
    half = Rotation.from_rotvec(np.outer(SPIN * middle, [0, 0, 1])) * body(middle)
    gyro = (turned[:-1].inv() * turned[1:]).as_rotvec() / dt
    force = half.inv().apply(np.diff(speed, axis=0) / dt - pull)
    if errors:
        gyro, force = _disturbed(gyro, force, model, dt, rng)
        if drive is not None:
            # it adds up to nothing, as the way is what it is
            force += np.diff(shaking * way.moving(edges)[:, None] * rng.normal(size=(len(edges), 3)), axis=0)
    mount = Rotation.from_rotvec(np.radians(rng.normal(0, mount_deg, 3)) * on).as_matrix() @ CAMERA_TO_BODY
    log_s = np.arange(0.1, seconds, 0.1)
    ground = body(log_s).inv().apply((place(log_s + h) - place(log_s - h)) / (2 * h))
    ground = ground * (1 + on * rng.normal(0, 0.005)) + on * rng.normal(0, velocity_sigma, ground.shape)
    frames_s = np.arange(0.5, seconds, cadence_s)
    attitude, places = body(frames_s).as_matrix(), place(frames_s)
    phi, lam, _ = geodetic_of(places)
    east = np.stack([-np.sin(lam), np.cos(lam), 0 * lam], -1)
    up = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], -1)
    ahead = attitude[:, :, 0]
    heading = np.arctan2((ahead * east).sum(1), (ahead * np.cross(up, east)).sum(1)) % (2 * np.pi)
    return MadeVoyage(
        imu=ImuLog.of(BEGIN_S + end, gyro, force),
        velocity=VelocityLog(
            utc_unix_s=BEGIN_S + log_s, velocity=ground, sigma=np.full(len(log_s), velocity_sigma)
        ),
        frames=[
            _frame(BEGIN_S + t, a @ mount, p, rng, on)
            for t, a, p in zip(frames_s, attitude, places, strict=True)
        ],
        latitude=phi,
        longitude=lam,
        heading=heading,
        place=places,
        body_to_itrs=attitude,
        mount=mount,
        frames_s=BEGIN_S + frames_s,
    )


def _disturbed(gyro, force, model, dt, rng):
    """Readings with errors drawn from a model."""
    bent = []
    for values, bias, density, walk in (
        (gyro, model.gyroscope_bias_stddev, model.gyroscope_noise_density, model.gyroscope_random_walk),
        (
            force,
            model.accelerometer_bias_stddev,
            model.accelerometer_noise_density,
            model.accelerometer_random_walk,
        ),
    ):
        matrix = np.where(np.eye(3, dtype=bool), model.scale_stddev, model.axes_stddev) * rng.normal(
            size=(3, 3)
        )
        wander = np.cumsum(rng.normal(0, walk * dt**0.5, values.shape), 0)
        noise = rng.normal(0, density / dt**0.5, values.shape)
        bent.append(values @ (np.eye(3) + matrix).T + rng.normal(0, bias, 3) + wander + noise)
    return bent


def _frame(utc_unix_s, camera_to_itrs, place, rng, on):
    """Stars of a frame in a vacuum, spread over it."""
    xy = rng.uniform(-1, 1, (STARS, 2)) * HALF_PX
    seen = np.column_stack([xy, np.full(STARS, FOCAL_PX)])
    seen = seen / np.linalg.norm(seen, axis=1)[:, None] @ camera_to_itrs.T
    # the diurnal aberration, to first order
    moving = SPIN * np.array([-place[1], place[0], 0.0]) / LIGHT_M_PER_S
    apparent = seen - (moving - (seen @ moving)[:, None] * seen)
    optics = Camera(width=1, height=1, fx=FOCAL_PX, fy=FOCAL_PX, cx=0.0, cy=0.0)
    return PlacelessFrame(
        utc_unix_s=utc_unix_s,
        stamp_stddev_s=0.0,
        source=f"frame {utc_unix_s:.1f}",
        camera=placeless(
            xy + on * rng.normal(0, STAR_SIGMA_PX, xy.shape),
            np.tile(np.eye(2) * STAR_SIGMA_PX**2, (STARS, 1, 1)),
            optics,
            apparent / np.linalg.norm(apparent, axis=1)[:, None],
        ),
    )
