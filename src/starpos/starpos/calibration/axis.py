# SPDX-License-Identifier: Apache-2.0
"""The camera's axis in the inclinometer from elevations: A3 of pointings without a roll.

Such a frame gives only the angle between the plumb line and its centre. So of A3 only the direction of that centre in S
counts, two angles: they are fitted with the zenith, which is known or not, to frames of several directions. A turn of A3
about the axis changes no elevation, and stays as it was given.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.averaging.altitudes import Circle, Directions, excess, starts
from starpos.errors import FixError
from starpos.instrument.instrument import UNKNOWN_ARCSEC, Calibration
from starpos.instrument.response import angles_at
from starpos.sky.site import Site
from starpos.units import ARCSEC

ROUNDS, SETTLED_CHI2, FIRST_DAMPING, LAST_DAMPING = 80, 1e-6, 1e-3, 1e9
# an axis that is known better than this (rad) is known
MIN_RAD = 1e-9
# number of zeniths that are tried, the ones that fit best at first
TRIED = 4
# an answer is excluded if its fit is worse by this
EXCLUDED_SIGMA = 6.0
# minimum number of directions that determine an axis, with the zenith known and unknown
FEWEST, MIN_WITHOUT_SITE = 2, 4
# how long A3 may be used
VALID_DAYS = 365.0
# the term of the circles that holds A3's error, which is fitted here
OF_A3 = "calibration"

# the circles of all frames with an A3 (3, 3)
CirclesOf = Callable[[np.ndarray], Sequence[Circle]]


@dataclass(frozen=True, kw_only=True)
class FoundAxis:
    """A3 whose axis the elevations determined.

    a3 (3, 3).  ray (3,): the frame's centre in C.  zenith (3,) in ITRS.
    covariance (2, 2) in rad2: of the axis along `across` (2, 3) in S, with the scatter of the directions.
    scatter2: variance beyond the stated, as a share of it.  directions, frames: numbers.
    """

    a3: np.ndarray
    ray: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    covariance: np.ndarray
    scatter2: float
    directions: int
    circles: Sequence[Circle]

    @property
    def stddev_arcsec(self) -> float:
        """Sigma of the axis on the worse of two axes."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]) / ARCSEC)

    def calibration(self, given: Calibration, turn_stddev_deg: float) -> Calibration:
        """The calibration, whose turn about the axis is as `given`, to turn_stddev_deg."""
        axis = self.a3 @ self.ray
        turns = np.cross(axis, self.across)
        turn = min(np.radians(turn_stddev_deg), UNKNOWN_ARCSEC[2] * ARCSEC)
        covariance = turns.T @ self.covariance @ turns + turn**2 * np.outer(axis, axis)
        up = rotation.normalised(np.sum([c.up for c in self.circles], axis=0))
        return replace(
            given.turned_to(self.a3),
            covariance_arcsec2=tuple(map(tuple, (covariance / ARCSEC**2).tolist())),
            utc_unix_s=float(np.mean([c.utc_unix_s for c in self.circles])),
            tilt_deg=tuple(np.degrees(angles_at(up, self.circles[0].axes)).tolist()),
            frames=len(self.circles),
            valid_days=VALID_DAYS,
            response=(),
            response_covariance=(),
        )

    def about(self, a3: np.ndarray) -> list[Circle]:
        """The circles with the zenith distances of another A3 (3, 3), as far as they are linear in its error here."""
        moved = self.across @ a3 @ self.ray
        return [
            replace(c, zenith_distance=c.zenith_distance + float(_slope(c, self.across) @ moved))
            for c in self.circles
        ]


def find_axis(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    site: Site | None = None,
    site_stddev_rad: float = 0.0,
    near: tuple[float, float] | None = None,
) -> FoundAxis:
    """Fit A3's axis, and the zenith unless a site is given; `given` counts as well as it is known.

    ray (3,): the frame's centre in C.  near: latitude, longitude (rad) that selects one of two answers.
    Raises FixError if the directions are too few, or leave two answers.
    """
    first = Directions.of(sorted(circles_of(given.a3), key=lambda c: c.utc_unix_s))
    number, fewest = len(first.circles), MIN_WITHOUT_SITE if site is None else FEWEST
    if number < fewest:
        raise FixError(
            f"elevations in {number} {'direction' if number == 1 else 'directions'} do not determine A3: without a roll "
            f"it takes {fewest} or more (frames of a camera that stands still are one)"
        )
    if site is not None:
        zeniths = [site.enu[2]]
    else:
        tried = sorted(starts(first), key=lambda z: float(np.median(np.abs(first.residual(z)[0]))))
        zeniths = [*_round(first), *tried[:TRIED]]
    found: list[tuple[float, FoundAxis]] = []
    for zenith in zeniths:
        one = _fitted(circles_of, given, ray, zenith, None if site is None else site_stddev_rad)
        if one is not None:
            found.append(one)
    if not found:
        raise FixError(
            "the elevations do not determine A3: check the tilts, the clock and that nothing was moved"
        )
    found.sort(key=lambda f: f[0])
    best = found[0][1]
    left = [f for chi2, f in found if chi2 - found[0][0] < EXCLUDED_SIGMA**2 * (1 + best.scatter2)]
    if near is not None:
        there = rotation.unit_vector(near[1], near[0])
        return max(left, key=lambda f: float(f.zenith @ there))
    if max(np.linalg.norm(f.zenith - best.zenith) for f in left) > 2 * EXCLUDED_SIGMA * _wide(best):
        raise FixError(
            "the elevations leave two places and two A3: turn the camera to directions of other altitudes too, state A3 "
            "better, or say where it is with --near LAT LON"
        )
    return best


def _wide(found: FoundAxis) -> float:
    """How far (rad) a zenith may be from another that is the same answer."""
    return float(max(np.sqrt(np.linalg.eigvalsh(found.covariance)[-1]), 1e-6))


def _round(part: Directions) -> list[np.ndarray]:
    """Zeniths (3,) about which all directions lie on a circle, as they do where the sensor leans alike in all."""
    axes = np.array([group[0].itrs for group in part.circles])
    if len(axes) < 3:
        return []
    normal = np.linalg.svd(axes - axes.mean(0))[2][-1]
    return [normal, -normal]


def _slope(circle: Circle, across: np.ndarray) -> np.ndarray:
    """Change (2,) of a circle's measured zenith distance by a move of the axis along `across` (2, 3) in S."""
    return -(across @ circle.up) / max(np.sin(circle.zenith_distance), 1e-9)


@dataclass(frozen=True, kw_only=True)
class _Normal:
    """The least-squares problem at an A3 (3, 3) and a zenith (3,): its unknowns are the axis, and perhaps the zenith."""

    a3: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    matrix: np.ndarray
    pull: np.ndarray
    prior: np.ndarray
    chi2: float
    part: Directions
    circles: Sequence[Circle]


def _fitted(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    zenith: np.ndarray,
    zenith_sigma: float | None,
) -> tuple[float, FoundAxis] | None:
    """The answer near a zenith, by Levenberg and Marquardt's method, with its chi-square; None if it does not converge.

    Axis and zenith together lie in a narrow, bent valley where the sensor leans about alike in all directions.
    """
    damping, now = FIRST_DAMPING, _normal(circles_of, given, ray, given.a3, zenith, zenith_sigma)
    if now is None:
        return None
    for _ in range(ROUNDS):
        damped = now.matrix + damping * np.diag(np.diag(now.matrix))
        step = -np.linalg.solve(damped, now.pull)
        moved = rotation.normalised(now.a3 @ ray + step[:2] @ now.across)
        a3 = rotation.shortest_turn(now.a3 @ ray, moved) @ now.a3
        there = now.zenith
        if zenith_sigma is None:
            there = rotation.normalised(there + step[2:] @ now.part.east_north(there))
        tried = _normal(circles_of, given, ray, a3, there, zenith_sigma)
        if tried is None or tried.chi2 > now.chi2:
            damping *= 10
            if damping > LAST_DAMPING:
                break
            continue
        gain, now, damping = now.chi2 - tried.chi2, tried, damping / 10
        if gain < SETTLED_CHI2:
            break
    spread = np.linalg.inv(now.matrix)
    told = len(spread) - float(np.trace(now.prior @ spread[:2, :2]))
    number = len(now.part.circles)
    scatter2 = excess(now.chi2, int(number - np.floor(told + 1e-6)))
    answer = FoundAxis(
        a3=now.a3,
        ray=ray,
        zenith=now.zenith,
        across=now.across,
        covariance=spread[:2, :2] * (1 + scatter2),
        scatter2=scatter2,
        directions=number,
        circles=now.circles,
    )
    return now.chi2, answer


def _normal(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    a3: np.ndarray,
    zenith: np.ndarray,
    zenith_sigma: float | None,
) -> _Normal | None:
    """Linearise at an A3 and a zenith; None for an axis that some frames cannot have.

    zenith_sigma: None if the zenith is unknown.
    """
    circles = sorted(circles_of(a3), key=lambda c: c.utc_unix_s)
    if len(circles) < len(circles_of(given.a3)):
        return None
    part, axis = Directions.of(circles), a3 @ ray
    left, of_zenith = part.residual(zenith)
    across = np.linalg.svd(axis[None])[2][1:]
    of_axis = -np.array([np.mean([_slope(c, across) for c in g], axis=0) for g in part.circles])
    stated = np.sum([c for name, c in part.sources.items() if name != OF_A3], axis=0)
    slope = of_axis
    if zenith_sigma is None:
        slope = np.hstack([of_axis, of_zenith])
    else:
        stated = stated + zenith_sigma**2 * of_zenith @ of_zenith.T
    # how far the axis is from where it was given, in units of what is known of it
    turns = np.cross(axis, across)
    about = np.asarray(given.covariance_arcsec2, float) * ARCSEC**2
    prior = np.linalg.inv(turns @ about @ turns.T + MIN_RAD**2 * np.eye(2))
    off = across @ (axis - given.a3 @ ray)
    weighted = np.linalg.solve(stated, np.column_stack([left, slope]))
    matrix, pull = slope.T @ weighted[:, 1:], slope.T @ weighted[:, 0]
    matrix[:2, :2] += prior
    pull[:2] += prior @ off
    return _Normal(
        a3=a3,
        zenith=zenith,
        across=across,
        matrix=matrix,
        pull=pull,
        prior=prior,
        chi2=float(left @ weighted[:, 0] + off @ prior @ off),
        part=part,
        circles=circles,
    )
