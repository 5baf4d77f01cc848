# SPDX-License-Identifier: Apache-2.0
"""Where directions that are fixed to a camera point at a known place, and the axis about which a mount turns it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.errors import FixError
from starpos.fix.attitude import Attitude
from starpos.frozen import at_once

# of the camera C
OPTICAL_AXIS = (0.0, 0.0, 1.0)


@at_once
@dataclass(frozen=True, kw_only=True)
class Horizontal:
    """N directions as they are seen, refraction included.

    azimuth (N,): rad, 0 to 2 pi, from north over east.  altitude (N,): rad.
    covariance (N, 2, 2): rad2, of their errors across (cos altitude times the azimuth's error) and up.
    """

    azimuth: np.ndarray
    altitude: np.ndarray
    covariance: np.ndarray

    @property
    def sigma_azimuth(self) -> np.ndarray:
        """Standard deviations (N,) of the azimuths, rad; infinite at the zenith."""
        return np.sqrt(self.covariance[:, 0, 0]) / np.maximum(np.cos(self.altitude), 1e-12)

    @property
    def sigma_altitude(self) -> np.ndarray:
        """Standard deviations (N,) of the altitudes, rad."""
        return np.sqrt(self.covariance[:, 1, 1])


def axes_across(v: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 2, 3) across and up at directions v (N, 3): to larger azimuths, and to larger altitudes."""
    level = np.maximum(np.hypot(v[:, 0], v[:, 1]), 1e-12)[:, None]
    across = np.stack([v[:, 1], -v[:, 0], np.zeros(len(v))], -1) / level
    return np.stack([across, np.cross(across, v)], 1)


def horizontal(to_enu: Attitude, directions: np.ndarray, sigma: float | np.ndarray = 0.0) -> Horizontal:
    """Azimuths and altitudes of directions (N, 3) in the frame of an attitude into east, north, up.

    sigma: their own errors per axis, rad, one or (N,).
    """
    v = np.atleast_2d(directions) @ to_enu.rotation.T
    # a small rotation w moves v by w x v, which is w . (v x e) along e
    slope = np.cross(v[:, None], axes_across(v))
    own = np.eye(2) * np.square(np.broadcast_to(sigma, len(v)))[:, None, None]
    return Horizontal(
        azimuth=np.arctan2(v[:, 0], v[:, 1]) % (2 * math.pi),
        altitude=np.arcsin(np.clip(v[:, 2], -1, 1)),
        covariance=np.einsum("nki,ij,nlj->nkl", slope, to_enu.covariance, slope) + own,
    )


def towards(azimuth: np.ndarray, altitude: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) in east, north, up of azimuths and altitudes (N,) in rad."""
    return rotation.unit_vector(math.pi / 2 - azimuth, altitude)


# a mount that has turned by less than this shows no axis
LEAST_TURN_RAD = math.radians(2)
# frames that scatter by more about one axis were moved otherwise
MAX_REST_RAD = math.radians(0.5)
ROUNDS = 3


@at_once
@dataclass(frozen=True, kw_only=True)
class MountAxis:
    """The axis about which a mount turned a camera between F frames.

    direction (3,): unit vector in east, north, up, its upper end.  covariance (2, 2): rad2, of its errors across and up.
    in_camera (3,): the same axis in C.
    rest (F,): how far from it each frame has that direction of C, rad.
    """

    direction: np.ndarray
    covariance: np.ndarray
    in_camera: np.ndarray
    rest: np.ndarray

    def from_pole(self, latitude: float) -> np.ndarray:
        """How far (2,) its end is from the celestial pole that is up there, rad: to the right of it, and above it."""
        north = latitude >= 0
        pole = towards(np.array([0.0 if north else math.pi]), np.array([abs(latitude)]))[0]
        turn = rotation.to_vector(rotation.shortest_turn(pole, self.direction))
        return np.asarray(axes_across(pole[None])[0] @ np.cross(turn, pole))


def mount_axis(attitudes: Sequence[Attitude]) -> MountAxis:
    """The axis in east, north, up of a mount that turned a camera between frames with these attitudes (C into ENU).

    A direction m of C stays where it is: R m = n for all attitudes R.  By least squares n and m are the singular
    vectors of the mean of R with the largest singular value.  Errors that all frames share move n as they move the
    frames.  The scatter of three frames or more widens the error.
    Raises FixError if the frames turn too little, or about several axes.
    """
    if len(attitudes) < 2:
        raise FixError("one frame shows no axis: give three, with a turn of the mount between them")
    turns = np.array([a.rotation for a in attitudes])
    widest = max(float(np.linalg.norm(rotation.to_vector(t @ turns[0].T))) for t in turns)
    if widest < LEAST_TURN_RAD:
        raise FixError(
            f"the camera has turned by {math.degrees(widest):.2g} deg between the frames: turn the mount by 30 deg or "
            "more about the axis that you look for"
        )
    u, _, vt = np.linalg.svd(turns.mean(0))
    n, m = u[:, 0], vt[0]
    for _ in range(ROUNDS):
        left, right, chi2 = np.zeros((4, 4)), np.zeros(4), 0.0
        of_n, of_m = axes_across(n[None])[0], np.linalg.svd(m[None])[2][1:]
        for a in attitudes:
            seen = a.rotation @ m
            slope = np.cross(seen, of_n)
            weight = np.linalg.inv(slope @ a.unshared @ slope.T)
            design = np.hstack([np.eye(2), -of_n @ a.rotation @ of_m.T])
            off = of_n @ (seen - n)
            left += design.T @ weight @ design
            right += design.T @ weight @ off
            chi2 += off @ weight @ off
        step = np.linalg.solve(left, right)
        n, m = rotation.normalised(n + step[:2] @ of_n), rotation.normalised(m + step[2:] @ of_m)
    rest = np.linalg.norm(turns @ m - n, axis=1)
    if rest.max() > MAX_REST_RAD:
        raise FixError(
            f"the frames do not turn about one axis, one is off by {math.degrees(rest.max()):.2g} deg: clamp the other "
            "axis, and take them of one camera without touching it"
        )
    free = 2 * len(attitudes) - 4
    covariance = np.linalg.inv(left)[:2, :2] * (max(1.0, chi2 / free) if free else 1.0)
    slope = np.cross(n, axes_across(n[None])[0])
    shared = [a.covariance - a.unshared for a in attitudes]
    covariance = covariance + slope @ np.mean(shared, axis=0) @ slope.T
    sign = 1.0 if n[2] >= 0 else -1.0
    flip = np.diag([-1.0, 1.0]) if sign < 0 else np.eye(2)
    return MountAxis(direction=sign * n, covariance=flip @ covariance @ flip, in_camera=sign * m, rest=rest)


@at_once
@dataclass(frozen=True, kw_only=True)
class CircleOrientation:
    """How a horizontal circle is oriented: azimuth = zero + sense * reading.

    zero: azimuth of its zero mark, rad; sigma of it.  sense: 1 if it counts clockwise from above, else -1.
    rest (N,): azimuths seen less those by the circle, rad.
    """

    zero: float
    sigma: float
    sense: int
    rest: np.ndarray


def circle_orientation(
    azimuth: np.ndarray, own: np.ndarray, shared: np.ndarray, reading: np.ndarray
) -> CircleOrientation:
    """The orientation of a circle from azimuths (N,) of one direction fixed to what it turns, and its readings (N,), rad.

    own (N,): errors of the azimuths that differ from frame to frame.  shared (N, m): errors by m sources that are common
    to all.  What the readings scatter beyond these errors is their own.
    """

    def by(sense: int) -> CircleOrientation:
        each, weight = azimuth - sense * reading, 1 / np.square(own)
        around = rotation.half_turns(each - each[0])
        free, off = len(each) - 1, around - np.average(around, weights=weight)
        # the variance of the readings that makes chi2 what it has to be (DerSimonian and Laird 1986)
        more = max(weight @ off**2 - free, 0.0) / max(weight.sum() - weight @ weight / weight.sum(), 1e-99)
        weight = 1 / (np.square(own) + more)
        zero = float(np.average(around, weights=weight))
        common = np.average(shared, axis=0, weights=weight)
        return CircleOrientation(
            zero=rotation.full_turn(float(each[0]) + zero),
            sigma=math.sqrt(1 / weight.sum() + common @ common),
            sense=sense,
            rest=around - zero,
        )

    both = [by(1), by(-1)]
    return min(both, key=lambda c: float(np.square(c.rest).sum()))
