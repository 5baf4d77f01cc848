# SPDX-License-Identifier: Apache-2.0
"""A first voyage from nothing: attitudes by stars, carried on by the gyro; up by the mean force among the stars."""

import numpy as np

from starpos.earth.ellipsoid import place_of_zenith
from starpos.earth.gravity import itrs_place
from starpos.navigation.links import turned_back
from starpos.navigation.measures import StarAttitudes
from starpos.navigation.motion import Motion
from starpos.navigation.odometry import Odometry
from starpos.navigation.preintegration import Pieces, Sums
from starpos.rotation import normalised


def nodes_of(frames: np.ndarray, most_apart_s: float) -> np.ndarray:
    """Times (K,) of nodes: the frames' times (F,), in order, and others between, so that no gap is longer."""
    parts = np.maximum(np.ceil(np.diff(frames) / most_apart_s).astype(int), 1)
    begin, step = np.repeat(frames[:-1], parts), np.repeat(np.diff(frames) / parts, parts)
    return np.append(
        begin + step * (np.arange(len(begin)) - np.repeat(np.cumsum(parts) - parts, parts)), frames[-1]
    )


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
        number = np.maximum(np.bincount(odometry.node, minlength=count), 1)
        mean = (
            np.stack([np.bincount(odometry.node, part, count) for part in odometry.velocity.T], -1)
            / number[:, None]
        )
        velocity = np.einsum("kij,kj->ki", attitude, mean)
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
        nominal=camera_to_body,
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
