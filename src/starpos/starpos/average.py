# SPDX-License-Identifier: Apache-2.0
"""Many frames of one place made into one fix: what is new in every frame averages, a common error stays.

Generalised least squares over all frames with their full covariance: a calibration error that turns with the instrument
is told apart from the place, one that does not stays in the answer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammainccinv

from starpos.budget import ErrorTerm, symmetric_root
from starpos.earth import curvature_radii_m
from starpos.errors import FixError
from starpos.fix import Fix
from starpos.rotation import full_turn

SAME_HEADING_SIGMA = 5.0
IMPROBABLE = 1e-9  # of frames that differ as much by chance: they are not of one place
TILT = "tilt"
HIGHEST_LATITUDE = np.radians(89.9995)  # 56 m from the pole


@dataclass(frozen=True)
class Average:
    """The combined position (rad) with its budget; heading NaN where the instrument turned between frames."""

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    terms: tuple[ErrorTerm, ...]
    frames: int

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) of east m, north m, heading rad; NaN in the heading's row and column where there is none."""
        c = sum(t.covariance for t in self.terms)[:3, :3].copy()
        if np.isnan(self.heading):
            c[2, :] = c[:, 2] = np.nan
        return c


def average(fixes: Sequence[Fix]) -> Average:
    """The weighted mean of at least one fix; the same frame given twice counts once.

    Frames that took the same inclinometer readings share the errors of these.  Raises FixError where the positions
    differ by more than their errors allow: they are not of one place.
    """
    fixes = list({(f.utc_unix_s, f.latitude, f.longitude): f for f in fixes}.values())
    plane = _Plane.about(fixes)
    seen = np.array([plane.seen(f) for f in fixes])  # (N, 3): east, north m, heading rad
    factors = [[plane.turned(f, f.terms[k].factor) for f in fixes] for k in range(len(fixes[0].terms))]
    shared = _sharing_readings(fixes)
    own = np.array([_own_covariance(plane, f, shared[k]) for k, f in enumerate(fixes)])
    at_pole = max(abs(f.latitude) for f in fixes) > HIGHEST_LATITUDE  # where a heading means nothing
    turned = at_pole or _heading_spread(seen[:, 2], own[:, 2, 2]) > SAME_HEADING_SIGMA
    rows = 2 if turned else 3
    unit = np.array([1.0, 1.0, 1e-6])[:rows]  # m and rad, brought to like sizes
    names = [t.name for t in fixes[0].terms]
    columns = [np.concatenate([f[:rows] / unit[:, None] for f in factors[k]])
               for k, t in enumerate(fixes[0].terms) if t.common]  # fmt: skip
    tilts = factors[names.index(TILT)]
    for group in sorted(set(shared.tolist()) - {-1}):
        columns.append(
            np.concatenate([f[:rows] / unit[:, None] * (shared[k] == group) for k, f in enumerate(tilts)])
        )
    blocks = own[:, :rows, :rows]
    gain, misfit = _least_squares(seen[:, :rows] / unit, blocks / np.outer(unit, unit), np.hstack(columns))
    freedom = rows * (len(fixes) - 1)
    if freedom and misfit > 2 * gammainccinv(freedom / 2, IMPROBABLE):
        apart = np.ptp(seen[:, :2], axis=0).max()
        raise FixError(
            f"the positions of {len(fixes)} frames lie up to {apart:.0f} m apart, more than their errors allow: "
            "they are not of one place, or the mount or the clock slipped; solve them apart"
        )
    mean = np.einsum("nij,nj->i", gain, seen[:, :rows] / unit) * unit
    latitude, longitude = plane.place(mean)
    terms = tuple(
        ErrorTerm(t.name, plane.local(latitude, _propagated(gain, factors[k], unit, t, shared)), t.common)
        for k, t in enumerate(fixes[0].terms)
    )
    heading = float("nan")
    if not turned:
        heading = full_turn(mean[2] + plane.heading - plane.convergence(latitude, longitude))
    return Average(
        float(np.mean([f.utc_unix_s for f in fixes])), latitude, longitude, heading, terms, len(fixes)
    )


@dataclass(frozen=True)
class _Plane:
    """The tangent plane at the middle of the fixes, where their east and north are made one."""

    zenith: np.ndarray
    axes: np.ndarray  # (2, 3): east and north in ITRS
    radii: np.ndarray  # prime vertical, meridian; m
    heading: float  # of the first fix, against these axes

    @classmethod
    def about(cls, fixes: Sequence[Fix]) -> "_Plane":
        zenith = np.mean([_zenith(f) for f in fixes], axis=0)
        zenith /= np.linalg.norm(zenith)
        latitude, longitude = _latitude_longitude(zenith)
        plane = cls(zenith, _axes(latitude, longitude), np.array(curvature_radii_m(latitude)), 0.0)
        first = fixes[0].heading + plane.convergence(fixes[0].latitude, fixes[0].longitude)
        return cls(plane.zenith, plane.axes, plane.radii, first)

    def convergence(self, latitude: float, longitude: float) -> float:
        """Azimuth of a place's own north against this plane's."""
        return float(np.arctan2(*(self.axes @ _axes(latitude, longitude)[1])))

    def seen(self, f: Fix) -> np.ndarray:
        """East, north (m) of the plane's middle, heading (rad) against the first fix's."""
        moved = self.axes @ (_zenith(f) - self.zenith) * self.radii
        return np.array([*moved, _turn(f.heading + self.convergence(f.latitude, f.longitude) - self.heading)])

    def turned(self, f: Fix, factor: np.ndarray) -> np.ndarray:
        """The first three rows of an error factor, brought from the fix's axes into these."""
        turn = self.convergence(f.latitude, f.longitude)
        c, s = np.cos(turn), np.sin(turn)
        east, north, heading = factor[:3]
        # the fix's north turns with its longitude, and its heading was taken from there
        prime, _ = curvature_radii_m(f.latitude)
        heading = heading - np.tan(f.latitude) / prime * east
        return np.stack([c * east + s * north, c * north - s * east, heading])

    def local(self, latitude: float, factor: np.ndarray) -> np.ndarray:
        """A factor (3, m) of the mean with the heading against the mean's own north again."""
        prime, _ = curvature_radii_m(latitude)
        return factor + np.outer([0.0, 0.0, np.tan(latitude) / prime], factor[0])

    def place(self, mean: np.ndarray) -> tuple[float, float]:
        zenith = self.zenith + (mean[:2] / self.radii) @ self.axes
        return _latitude_longitude(zenith / np.linalg.norm(zenith))


def _root(covariance: np.ndarray) -> np.ndarray:
    """A root of a covariance (3, 3) in m and rad."""
    unit = np.array([1.0, 1.0, 1e-6])
    return symmetric_root(covariance / np.outer(unit, unit)) * unit[:, None]


def _own_covariance(plane: _Plane, f: Fix, group: int) -> np.ndarray:
    """(3, 3) of the errors that are new in this frame; its tilt is not where it shares readings with another."""
    own = [t for t in f.terms if not t.common and not (t.name == TILT and group >= 0)]
    factors = [plane.turned(f, t.factor) for t in own]
    return sum(factor @ factor.T for factor in factors)


def _sharing_readings(fixes: Sequence[Fix]) -> np.ndarray:
    """For each fix the number of the group that shares inclinometer readings with it, -1 where none does (N,)."""
    group, of_reading = np.arange(len(fixes)), {}
    for k, f in enumerate(fixes):
        for moment in f.tilt_times:
            first = of_reading.setdefault(moment, k)
            group[group == group[k]] = group[first]
    _, inverse, count = np.unique(group, return_inverse=True, return_counts=True)
    return np.where(count[inverse] > 1, inverse, -1)


def _heading_spread(heading: np.ndarray, variance: np.ndarray) -> float:
    sigma = np.sqrt(variance + np.median(variance) * 1e-12 + 1e-24)
    weight = sigma**-2 / np.sum(sigma**-2)
    return float(np.max(np.abs(heading - weight @ heading) / sigma))


def _least_squares(y: np.ndarray, own: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean of y (N, r) with errors own (N, r, r) of each and factors common (N r, m) of all: gains (N, r, r), chi-square.

    By Woodbury's identity, so that a thousand frames are no thousand-square matrix.
    """
    n, r = y.shape
    common = common.reshape(n, r, -1)
    weight = np.linalg.inv(own)
    weighted = weight @ common  # (N, r, m)
    inner = np.linalg.inv(np.eye(common.shape[2]) + np.einsum("nrm,nrk->mk", common, weighted))

    def weigh(v):  # (N, r, k): inverse covariance times v
        return weight @ v - weighted @ (inner @ np.einsum("nrm,nrk->mk", weighted, v))

    ones = np.broadcast_to(np.eye(r), (n, r, r))
    w = weigh(ones)
    gain = np.einsum("ij,njk->nik", np.linalg.inv(w.sum(0)), w.swapaxes(1, 2))
    rest = y - np.einsum("nij,nj->i", gain, y)
    return gain, float(np.sum(rest[..., None] * weigh(rest[..., None])))


def _propagated(gain, factors, unit, term: ErrorTerm, shared: np.ndarray) -> np.ndarray:
    """A term's factor (3, m) of the mean: its errors add up where it is common, or within a group of shared readings."""
    r = len(unit)
    moved = [gain[n] @ (f[:r] / unit[:, None]) * unit[:, None] for n, f in enumerate(factors)]
    if term.common:
        factor = sum(moved)
        return np.vstack([factor, np.zeros((3 - r, factor.shape[1]))])
    alone = np.arange(len(moved))
    groups = np.where(shared >= 0, -1 - shared, alone) if term.name == TILT else alone
    sums = [sum(moved[n] for n in np.flatnonzero(groups == g)) for g in np.unique(groups)]
    covariance = np.zeros((3, 3))
    covariance[:r, :r] = sum(s @ s.T for s in sums)
    return _root(covariance)


def _zenith(f: Fix) -> np.ndarray:
    c = np.cos(f.latitude)
    return np.array([c * np.cos(f.longitude), c * np.sin(f.longitude), np.sin(f.latitude)])


def _latitude_longitude(zenith: np.ndarray) -> tuple[float, float]:
    return float(np.arctan2(zenith[2], np.hypot(*zenith[:2]))), float(np.arctan2(zenith[1], zenith[0]))


def _axes(latitude: float, longitude: float) -> np.ndarray:
    """East and north (2, 3) in ITRS."""
    cl, sl, cp, sp = np.cos(longitude), np.sin(longitude), np.cos(latitude), np.sin(latitude)
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp]])


def _turn(angle: float) -> float:
    """An angle in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
