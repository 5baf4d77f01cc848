# SPDX-License-Identifier: Apache-2.0
"""The start of an adjustment: inertial readings checked against the stars, and a first motion from both."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.ellipsoid import place_of_zenith
from starpos.earth.gravity import itrs_place
from starpos.earth.orientation import earth_state
from starpos.errors import VoyageError
from starpos.navigation.equations import Motion, Odometry, StarAttitudes, turned_back
from starpos.navigation.preintegration import Pieces, Sums
from starpos.navigation.records import ImuModel
from starpos.navigation.sightings import SunFrame
from starpos.rotation import best_rotation, normalised
from starpos.sky.bodies import MOON, body_at
from starpos.units import SIGMA_PER_MAD

GRAVITY = 9.8
# maximum difference of the mean force from gravity, and the same in sigmas of the model
MAX_OFF, SIGMAS = 0.5, 6.0
# so low, in the mean, no camera on a vehicle looks for stars: so far from the plumb line, deg
LOWEST_DEG = 80.0
# turns that are seen so far above their noise show the gyro's axes; and what part of them may be off
CLEARLY, MAX_SHARE = 20.0, 0.3
# maximum scatter of a gyro's turns over its model's noise while the stars show no turn; more means another unit
MAX_SCATTER = 8.0
# minimum error (rad) of the turn of a stray frame, and maximum number of stray frames in a row
STRAY, MAX_STRAYS = np.radians(3.0), 5
# Intervals before and after a frame that show where up is; sigmas of the altitude at which a disc is no Sun; rad at which
# the Moon is another body than the Sun.
AROUND, SUN_SIGMAS, MOON_APART = 3, 4.0, np.radians(2.0)
# rad/s in other units
UNITS = {"deg/s": np.degrees(1.0), "rev/min": 30 / np.pi}


def check_gravity(pieces: Pieces, sums: Sums, model: ImuModel, camera_to_body: np.ndarray) -> None:
    """Raise VoyageError where gravity is missing, or below the camera; sums are of the unchanged readings."""
    whole = pieces.missing_s < pieces.span_s / 2
    if not whole.any():
        raise VoyageError(
            "hardly any inertial reading lies between the frames: check that the clocks of camera and IMU agree"
        )
    force = sums.speed[whole] / pieces.span_s[whole, None]
    size = float(np.median(np.linalg.norm(force, axis=1)))
    allowed = MAX_OFF + SIGMAS * (model.accelerometer_bias_stddev + GRAVITY * model.scale_stddev)
    if abs(size - 1) < 0.1:
        raise VoyageError(f"the IMU's force is {size:.3f} in the median, as if it was in g: give m/s2")
    if abs(size - GRAVITY) > allowed:
        raise VoyageError(
            f"the IMU's force is {size:.2f} m/s2 in the median, where gravity is {GRAVITY:g}: check its unit, that no "
            "axis is missing and that gravity is not taken off"
        )
    up = np.median(force, axis=0) @ camera_to_body
    away = np.degrees(np.arccos(up[2] / np.linalg.norm(up)))
    if away > LOWEST_DEG:
        raise VoyageError(
            f"gravity has up {away:.0f} deg from where the camera looks, so that no stars would be seen: check the "
            "accelerometer's axes (x forward, y left, z up, +9.8 m/s2 on z at rest)"
        )


def check_turns(stars: StarAttitudes, pieces: Pieces, model: ImuModel, camera_to_body: np.ndarray) -> None:
    """Raise VoyageError where the turns between neighbouring frames differ, by the stars and by the gyro."""
    near = np.flatnonzero(np.diff(stars.index) == 1)
    near = near[pieces.missing_s[stars.index[near]] == 0]
    first = stars.index[near]
    if len(first) < 3:
        return
    body = stars.camera_to_itrs @ camera_to_body.T
    span = pieces.span_s[first, None]
    back = turned_back(span[:, 0])
    seen = Rotation.from_matrix((back @ body[near]).transpose(0, 2, 1) @ body[near + 1]).as_rotvec() / span
    # the mean and not the turn itself, which in another unit may be more than half of a circle
    felt = (pieces.gyro * pieces.length_s[..., None]).sum(1)[first] / span
    noise = np.sqrt(np.trace(stars.covariance[near], axis1=1, axis2=2) * 2 / 3) / span[:, 0]
    noise = np.hypot(noise, model.gyroscope_noise_density / np.sqrt(span[:, 0]))
    off = felt - seen
    bias = np.median(off, axis=0)
    clear = np.linalg.norm(seen - np.median(seen, axis=0), axis=1) > CLEARLY * noise
    if clear.any():
        turns, others = seen[clear] - np.median(seen, axis=0), felt[clear] - np.median(felt, axis=0)
        share = float(np.median(np.linalg.norm(others - turns, axis=1) / np.linalg.norm(turns, axis=1)))
        if share > MAX_SHARE:
            raise VoyageError(
                f"the gyro's turns differ from the stars' by {100 * share:.0f} %: {_cause(turns, others)}"
            )
    scatter = float(np.median(np.linalg.norm(off - bias, axis=1) / noise))
    if not clear.any() and scatter > MAX_SCATTER:
        raise VoyageError(
            f"the gyro scatters by {scatter:.0f} times the noise of its model, where the stars see no turn, as if it was "
            "in deg/s: give rad/s, or the model of the IMU"
        )
    allowed = SIGMAS * (model.gyroscope_bias_stddev + float(np.median(noise)))
    allowed += MAX_SHARE * float(np.linalg.norm(np.median(seen, axis=0)))
    if np.abs(bias).max() > allowed:
        raise VoyageError(
            f"the gyro turns by {np.degrees(np.abs(bias).max()):.3g} deg/s more than the stars, its model allows "
            f"{np.degrees(allowed):.2g}, as if it was in deg/s: give rad/s, and the model of the IMU"
        )


def upright(
    stars: StarAttitudes, zenith: np.ndarray, sums: Sums, camera_to_body: np.ndarray
) -> tuple[StarAttitudes, np.ndarray]:
    """Attitudes of which only a ray is known, turned about it until up is where the force points; zenith (3,) in ITRS.

    Returns also by how much the force puts each ray (L,) nearer to the zenith than it is, rad.
    """
    lone = ~stars.whole
    around = np.ones(2 * AROUND + 1) / (2 * AROUND + 1)
    force = np.stack([np.convolve(part, around, "same") for part in sums.speed.T], -1)
    up = normalised(force[np.minimum(stars.index[lone], len(force) - 1)]) @ camera_to_body
    ray, attitude = stars.rays[lone], stars.camera_to_itrs.copy()
    seen = np.einsum("kij,kj->ki", attitude[lone], ray)
    attitude[lone] = best_rotation(
        np.stack([ray, up], 1), np.stack([seen, np.broadcast_to(zenith, seen.shape)], 1)
    )
    felt, stated = (
        np.arccos(np.clip(c, -1, 1)) for c in (np.einsum("ki,ki->k", ray, up), np.sum(seen * zenith, 1))
    )
    return replace(stars, camera_to_itrs=attitude), stated - felt


def check_sun(
    off: np.ndarray, sun: SunFrame, model: ImuModel, mount_stddev: float, zenith: np.ndarray
) -> None:
    """Raise VoyageError where gravity has another altitude than the Sun's, or the Moon stands as high.

    off (L,): of the frames, as by `upright`.  sun: one of them.
    """
    scatter = float(np.median(np.abs(off - np.median(off)))) * SIGMA_PER_MAD
    at_rest = np.hypot(model.accelerometer_bias_stddev / GRAVITY, mount_stddev)
    own = np.linalg.eigvalsh(sun.camera.covariance)[1] + scatter**2 / max(1.0, len(off) / (2 * AROUND + 1))
    most = SUN_SIGMAS * float(np.hypot(at_rest, own**0.5))
    higher = float(np.median(off))
    if abs(higher) > most:
        side = "higher" if higher > 0 else "lower"
        raise VoyageError(
            f"gravity has the bright disc {abs(np.degrees(higher)):.1f} deg {side} than the Sun, "
            f"{np.degrees(most):.1f} at most by the stated errors: it is a lamp, or the clock, the place, "
            "link_to_camera or the IMU's axes are wrong"
        )
    bodies = body_at(MOON, earth_state(sun.utc_unix_s)), sun.body
    moon, there = (body.from_place(zenith) for body in bodies)
    above = np.arcsin(moon @ zenith) - np.arcsin(there @ zenith) - higher
    if moon @ zenith > 0 and abs(above) < most and np.linalg.norm(moon - there) > MOON_APART:
        raise VoyageError("the Sun and the Moon stand equally high: which of them the disc is shows later")


def stray_frames(
    stars: StarAttitudes, pieces: Pieces, sums: Sums, model: ImuModel, camera_to_body: np.ndarray
) -> np.ndarray:
    """Mask (F,) of a few frames whose attitude the gyro contradicts before and after them.

    Such frames are identified wrongly or have another's time, and are too far off for an adjustment to begin with.
    """
    body, back = stars.camera_to_itrs @ camera_to_body.T, turned_back(pieces.span_s)
    begin = np.append(0.0, np.cumsum(pieces.span_s))
    lost = np.append(0.0, np.cumsum(pieces.missing_s))
    breaks = [0]
    for k, (first, last) in enumerate(zip(stars.index[:-1], stars.index[1:], strict=True), 1):
        turned = body[k - 1]
        for node in range(first, last):
            turned = back[node] @ turned @ sums.turn[node]
        off = np.arccos(np.clip((np.trace(turned.T @ body[k]) - 1) / 2, -1, 1))
        most = STRAY + SIGMAS * model.gyroscope_bias_stddev * (begin[last] - begin[first])
        if off > most and lost[last] == lost[first]:
            breaks.append(k)
    size = np.diff([*breaks, len(body)])
    return np.repeat(size <= MAX_STRAYS, size) if len(breaks) > 1 else np.zeros(len(body), bool)


def _cause(seen: np.ndarray, felt: np.ndarray) -> str:
    """The change that would make the gyro's turns (N, 3) equal the stars' (N, 3)."""
    ratio = float(np.median(np.linalg.norm(felt, axis=1) / np.linalg.norm(seen, axis=1)))
    for unit, size in UNITS.items():
        if abs(ratio / size - 1) < MAX_SHARE:
            return f"they seem to be in {unit}: give rad/s"
    best, misses = "", MAX_SHARE
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            missed = np.linalg.norm(felt[:, axes] * signs - seen, axis=1)
            share = float(np.median(missed / np.linalg.norm(seen, axis=1)))
            if share < misses:
                names = ["-+"[sign > 0] + "xyz"[axis] for axis, sign in zip(axes, signs, strict=True)]
                best, misses = f"its x, y, z seem to be {', '.join(names)} of the file: turn the axes", share
    return best or "check its axes and its unit, and that the clocks of camera and IMU agree"


# the equations from one node to the next hold for so long
MAX_APART_S = 1.5


def nodes_of(frames: np.ndarray) -> np.ndarray:
    """Times (K,) of nodes: the frames' times (F,), in order, and others between, none farther apart than MAX_APART_S."""
    parts = np.maximum(np.ceil(np.diff(frames) / MAX_APART_S).astype(int), 1)
    numbers = np.append(0, np.cumsum(parts))
    return np.interp(np.arange(numbers[-1] + 1), numbers, frames)


def first_motion(
    nodes: np.ndarray,
    stars: StarAttitudes,
    pieces: Pieces,
    sums: Sums,
    odometry: Odometry | None,
    camera_to_body: np.ndarray,
) -> Motion:
    """The Motion at nodes (K,), Unix s, that the adjustment begins with, from the sums of the readings as they are."""
    count = len(nodes)
    attitude = _attitudes(count, stars, turned_back(pieces.span_s), sums.turn, camera_to_body)
    force = np.einsum("kij,kj->i", attitude[:-1], sums.speed)
    latitude, longitude = place_of_zenith(normalised(force))
    velocity = np.zeros((count, 3))
    if odometry is not None:
        number, total = odometry.totals(np.ones(len(odometry.node)), odometry.velocity, count)
        velocity = np.einsum("kij,kj->ki", attitude, total / np.maximum(number, 1)[:, None])
    way = np.cumsum(velocity[:-1] * pieces.span_s[:, None], axis=0)
    return Motion(
        utc_unix_s=nodes,
        attitude=attitude,
        place=itrs_place(latitude, longitude, 0.0) + np.concatenate([np.zeros((1, 3)), way]),
        velocity=velocity,
        gyro_bias=np.zeros((count, 3)),
        accel_bias=np.zeros((count, 3)),
        speed=np.zeros(count),
        drift=np.zeros((count, 3)),
        camera_to_body=camera_to_body,
        gyro_matrix=np.zeros((3, 3)),
        accel_matrix=np.zeros((3, 3)),
        log_axes=np.zeros(3),
    )


def _attitudes(
    count: int, stars: StarAttitudes, back: np.ndarray, turn: np.ndarray, camera_to_body: np.ndarray
) -> np.ndarray:
    """Attitudes (count, 3, 3) of the body: by stars where there are some, else by the gyro from the neighbouring node."""
    attitude = np.empty((count, 3, 3))
    known = np.zeros(count, bool)
    known[stars.index] = True
    attitude[stars.index] = stars.camera_to_itrs @ camera_to_body.T
    for k in range(stars.index[0] - 1, -1, -1):
        attitude[k] = back[k].T @ attitude[k + 1] @ turn[k].T
    for k in range(stars.index[0] + 1, count):
        if not known[k]:
            attitude[k] = back[k - 1] @ attitude[k - 1] @ turn[k - 1]
    return attitude
