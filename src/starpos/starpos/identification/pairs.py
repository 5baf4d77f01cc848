# SPDX-License-Identifier: Apache-2.0
"""Find points of a frame that lie close to each other."""

import numpy as np

# Number of distances up to which a table of all is faster than two trees.
SMALL_TABLE = 100_000


def close_pairs(xy: np.ndarray, reach_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of the points xy (N, 2) closer than reach_px: two arrays of rows (M,), the smaller row first."""
    order = np.argsort(xy[:, 0], kind="stable")
    x, y = xy[order].T
    left, right = [], []
    # sorted by x, neighbours first, then every second one, and so on: few stars of a frame have a neighbour
    for k in range(1, len(x)):
        near = np.flatnonzero(x[k:] - x[:-k] < reach_px)
        if not len(near):
            break
        near = near[np.square(x[near + k] - x[near]) + np.square(y[near + k] - y[near]) < reach_px**2]
        left.append(order[near])
        right.append(order[near + k])
    if not left:
        return np.zeros(0, int), np.zeros(0, int)
    one, other = np.concatenate(left), np.concatenate(right)
    return np.minimum(one, other), np.maximum(one, other)


def mutual_nearest(
    xy: np.ndarray, predicted: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of xy (N, 2) and predicted (S, 2) that are each other's nearest within radius (N,) px: two arrays of rows."""
    if not (len(xy) and len(predicted)):
        return np.zeros(0, int), np.zeros(0, int)
    if len(xy) * len(predicted) < SMALL_TABLE:
        apart2 = np.square(xy[:, 0, None] - predicted[:, 0]) + np.square(xy[:, 1, None] - predicted[:, 1])
        nearest, back = apart2.argmin(1), apart2.argmin(0)
        distance = np.sqrt(apart2[np.arange(len(xy)), nearest])
    else:
        # slow to import, and seldom needed
        from scipy.spatial import cKDTree

        distance, nearest = cKDTree(predicted).query(xy)
        back = cKDTree(xy).query(predicted)[1]
    good = (distance < radius) & (back[nearest] == np.arange(len(xy)))
    return np.flatnonzero(good), nearest[good]
