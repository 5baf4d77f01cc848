# SPDX-License-Identifier: Apache-2.0
"""The camera's axis in the inclinometer from elevations alone, at a known place or together with it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.averaging.altitudes import (
    EXCLUDED_SIGMA,
    MAX_OUTLIERS,
    MIN_JUDGED,
    OUTLIER_SIGMA,
    Directions,
    excess,
    starts,
    usual_sigma,
)
from starpos.earth.ellipsoid import enu_at_zenith
from starpos.earth.place import Place
from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError
from starpos.fix.circle import MIN_SINE, Circle
from starpos.frozen import at_once
from starpos.instrument.inclinometer import angles_at
from starpos.instrument.instrument import UNKNOWN_ARCSEC, VALID_DAYS, Calibration
from starpos.units import ARCSEC

# rounds of refractions and errors that follow A3, until it moves by less (rad)
RELINEARISED, SAME_AXIS_RAD = 8, 1e-7
SETTLED = 1e-12
# residual in sigma of an axis that some frames cannot have
IMPOSSIBLE = 1e12
# an axis that is known better than this (rad) is known
MIN_RAD = 1e-9
# zeniths of one answer are this near (rad), however well the axis is known
SAME_RAD = 1e-6
# number of zeniths that are tried, the ones that fit best at first
TRIED = 4
# minimum number of directions that determine an axis, with the zenith known and unknown
FEWEST, MIN_WITHOUT_SITE = 2, 4
# the term of the circles that holds A3's error, which is fitted here
OF_A3 = "calibration"

# the circles of all frames with an A3 (3, 3)
CirclesOf = Callable[[np.ndarray], Sequence[Circle]]


@at_once
@dataclass(frozen=True, kw_only=True)
class FoundAxis:
    """A3 whose axis the elevations determined.

    a3 (3, 3).  ray (3,): the frame's centre in C.  zenith (3,) in ITRS.
    covariance (2, 2) in rad2: of the axis along `across` (2, 3) in S, with the scatter of the directions.
    chi2: of the fit; scatter2: variance beyond the stated, as a share of it.
    directions: their number; off (D,): their residuals in sigma.
    left_out: number of frames of directions that contradict the others, which are not in `circles`.
    """

    a3: np.ndarray
    ray: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    covariance: np.ndarray
    scatter2: float
    directions: int
    off: np.ndarray
    chi2: float
    circles: Sequence[Circle]
    left_out: int = 0

    def sigma_from(self, given: Calibration) -> float:
        """Distance of the axis from where a calibration has it, in sigma of both."""
        off = self.across @ (self.a3 - given.a3) @ self.ray
        known = _known(given, self.a3 @ self.ray, self.across)
        return float(np.sqrt(off @ np.linalg.solve(known + self.covariance, off)))

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
    site: Place | None = None,
    near: tuple[float, float] | None = None,
) -> FoundAxis:
    """Fit A3's axis, and the zenith unless a site is given; `given` counts as well as it is known.

    ray (3,): the frame's centre in C.  near: latitude, longitude (rad) that selects one of two answers.
    Raises FixError if the directions are too few, or leave two answers.
    """
    found = _axes(circles_of, given, ray, site)
    wrong = _contradicting(found[0], given, site)
    if wrong:

        def agreeing(a3: np.ndarray) -> list[Circle]:
            return [c for c in circles_of(a3) if c.utc_unix_s not in wrong]

        found = [replace(f, left_out=len(wrong)) for f in _axes(agreeing, given, ray, site)]
    best = found[0]
    left = [f for f in found if f.chi2 - best.chi2 < EXCLUDED_SIGMA**2 * (1 + best.scatter2)]
    if near is not None:
        there = rotation.unit_vector(near[1], near[0])
        return max(left, key=lambda f: float(f.zenith @ there))
    same = 2 * EXCLUDED_SIGMA * max(best.stddev_arcsec * ARCSEC, SAME_RAD)
    if max(np.linalg.norm(f.zenith - best.zenith) for f in left) > same:
        raise FixError(
            "the elevations leave two places and two A3: turn the camera to directions of other altitudes too, state A3 "
            "better, or say where it is with --near LAT LON"
        )
    return best


def _axes(circles_of: CirclesOf, given: Calibration, ray: np.ndarray, site: Place | None) -> list[FoundAxis]:
    """The answers, the one that fits best first; FixError without any, or for too few directions."""
    first = Directions.of(circles_of(given.a3))
    number, fewest = len(first.circles), MIN_WITHOUT_SITE if site is None else FEWEST
    if number < fewest:
        raise FixError(
            f"elevations in {number} {'direction' if number == 1 else 'directions'} do not determine A3: without a roll "
            f"it takes {fewest} or more (frames of a camera that stands still are one)"
        )
    if site is not None:
        zeniths = [site.plumb_axes[2]]
    else:
        tried = sorted(starts(first), key=lambda z: float(np.median(np.abs(first.residual(z)[0]))))
        zeniths = [*_round(first), *tried[:TRIED]]
    found = [_fitted(circles_of, given, ray, zenith, site) for zenith in zeniths]
    if not any(found):
        raise FixError(
            "the elevations do not determine A3: check the tilts, the clock and that nothing was moved"
        )
    return sorted((f for f in found if f is not None), key=lambda f: f.chi2)


def _contradicting(best: FoundAxis, given: Calibration, site: Place | None) -> set[float]:
    """Times of the frames whose directions contradict the others; none if they are too few to judge, or too many.

    They are judged from the least sum of residuals instead of squares, which a blunder does not pull towards itself
    (Bloomfield and Steiger, Least Absolute Deviations, 1983).
    """
    number, free = best.directions, best.directions - (2 if site is not None else 4)
    if number < MIN_JUDGED or best.off.max() < OUTLIER_SIGMA:
        return set()
    robust = _solved(best.a3, best.zenith, best.circles, given, best.ray, site, robust=True)
    if robust is None:
        return set()
    wrong = np.flatnonzero(robust.off > OUTLIER_SIGMA * max(usual_sigma(robust.off, free), 1.0))
    if len(wrong) > MAX_OUTLIERS * number:
        return set()
    return {c.utc_unix_s for k in wrong for c in Directions.of(best.circles).circles[k]}


def _known(given: Calibration, axis: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Covariance (2, 2) in rad2 with which a calibration knows an axis (3,) along `across` (2, 3)."""
    turns = np.cross(axis, across)
    return turns @ given.covariance @ turns.T + MIN_RAD**2 * np.eye(2)


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


def _solved(
    a3: np.ndarray,
    zenith: np.ndarray,
    circles: Sequence[Circle],
    given: Calibration,
    ray: np.ndarray,
    site: Place | None,
    robust: bool = False,
) -> FoundAxis | None:
    """The least chi-square near an A3 (3, 3) and a zenith; None for an axis that some frames cannot have.

    circles: about that A3; their refraction and errors stay as they are while the axis moves a little.
    robust: by the sum of the residuals rather than of their squares.
    Axis and zenith together lie in a narrow, bent valley where the sensor leans about alike in all directions.
    """
    from scipy.optimize import least_squares

    part, up = Directions.of(circles), np.array([c.up for c in circles])
    start = rotation.normalised(a3 @ ray)
    bent = np.array([c.zenith_distance for c in circles]) - rotation.angle(up, start)
    across, along = np.linalg.svd(start[None])[2][1:], enu_at_zenith(zenith)[:2]
    stated, known = part.without(OF_A3), _known(given, start, across)
    if site is not None:
        of_zenith = part.residual(zenith, rotation.angle(up, start) + bent)[1]
        stated = stated + site.plumb_stddev**2 * of_zenith @ of_zenith.T
    sigma = np.sqrt(np.diag(stated))
    each = np.diag(np.diag(stated)) if robust else stated
    white, prior = (np.linalg.inv(np.linalg.cholesky(c)) for c in (each, known))

    def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        there = zenith + x[2:] @ along[: len(x) - 2]
        return rotation.normalised(start + x[:2] @ across), rotation.normalised(there)

    def left(x: np.ndarray) -> np.ndarray:
        axis, there = moved(x)
        return part.residual(there, rotation.angle(up, axis) + bent)[0]

    def residual(x: np.ndarray) -> np.ndarray:
        seen = rotation.angle(up, moved(x)[0])
        if np.sin(seen).min() < MIN_SINE or np.cos(seen).min() < MIN_COS_ZENITH:
            return np.full(len(white) + 2, IMPOSSIBLE)
        # how far the axis is from where it was given, in units of what is known of it
        off = across @ (moved(x)[0] - given.a3 @ ray)
        return np.append(white @ left(x), prior @ off)

    origin = np.zeros(4 if site is None else 2)
    if residual(origin)[0] == IMPOSSIBLE:
        return None
    how = {"method": "trf", "loss": "soft_l1"} if robust else {"method": "lm"}
    found = least_squares(residual, origin, x_scale="jac", xtol=SETTLED, ftol=SETTLED, **how)
    # at the border of what the frames can have, the slopes are of no residuals
    if np.abs(found.jac).max() > IMPOSSIBLE:
        return None
    axis, there = moved(found.x)
    if np.linalg.matrix_rank(found.jac / np.maximum(np.linalg.norm(found.jac, axis=0), 1e-9)) < len(origin):
        return None
    spread = np.linalg.inv(found.jac.T @ found.jac)
    # by the elevations rather than what was known
    told = len(origin) - float(np.trace(np.linalg.solve(known, spread[:2, :2])))
    chi2, number = 2 * float(found.cost), len(stated)
    scatter2 = excess(chi2, int(number - np.floor(told + 1e-6)))
    return FoundAxis(
        a3=rotation.shortest_turn(start, axis) @ a3,
        ray=ray,
        zenith=there,
        across=across,
        covariance=spread[:2, :2] * (1 + scatter2),
        scatter2=scatter2,
        directions=number,
        off=np.abs(left(found.x)) / sigma,
        chi2=chi2,
        circles=circles,
    )


def _fitted(
    circles_of: CirclesOf, given: Calibration, ray: np.ndarray, zenith: np.ndarray, site: Place | None
) -> FoundAxis | None:
    """The answer near a zenith; None if it does not converge."""
    a3, frames, now = given.a3, 0, None
    for _ in range(RELINEARISED):
        circles = sorted(circles_of(a3), key=lambda c: c.utc_unix_s)
        # some frames cannot have that axis
        if len(circles) < frames:
            return None
        frames, before = len(circles), a3
        now = _solved(a3, zenith, circles, given, ray, site)
        if now is None:
            return None
        a3, zenith = now.a3, now.zenith
        if np.linalg.norm((a3 - before) @ ray) < SAME_AXIS_RAD:
            break
    return now
