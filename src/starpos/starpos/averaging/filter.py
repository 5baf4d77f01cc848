# SPDX-License-Identifier: Apache-2.0
"""The place of a standing instrument as its fixes come in: a Kalman filter over place, heading and what the fixes share.

A calibration error that turns with the instrument is told apart from the place, one that does not stays in the answer; a
zero that wanders does so in the filter too.  Its size is constant, and its answer is that of generalised least squares
over all fixes at once (test_average.py).  The covariance is kept by source, so that the budget of the mean comes with it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, zenith_of
from starpos.fix.budget import ErrorTerm, correlation, symmetric_root
from starpos.fix.fix import Fix
from starpos.rotation import full_turn, half_turn

UNIT = np.array([1.0, 1.0, 1e-6])  # m and rad, brought to like sizes
HUBER_SIGMA = 4.0  # a fix further off pulls no harder
MOST_BENT = 0.2  # of the claim: by how much a step of the place may leave the plane
STEEPEST = 30.0  # tangent of the latitude from which on parallels count as bent no more


@dataclass(frozen=True)
class Plane:
    """The tangent plane at a fix, where east and north of its neighbours are made one."""

    zenith: np.ndarray
    axes: np.ndarray  # (2, 3): east and north in ITRS
    radii: np.ndarray  # prime vertical, meridian; m
    heading: float  # of the fix, against these axes

    @classmethod
    def at(cls, f: Fix) -> "Plane":
        axes = _axes(f.latitude, f.longitude)
        return cls(
            zenith_of(f.latitude, f.longitude), axes, np.array(curvature_radii_m(f.latitude)), f.heading
        )

    def convergence(self, latitude: float, longitude: float) -> float:
        """Azimuth of a place's own north against this plane's."""
        return float(np.arctan2(*(self.axes @ _axes(latitude, longitude)[1])))

    def across(self, latitude: float, longitude: float) -> np.ndarray:
        """East, north in m (2,) of a place."""
        return self.axes @ (zenith_of(latitude, longitude) - self.zenith) * self.radii

    def seen(self, f: Fix) -> np.ndarray:
        """East, north, heading (3,) of a fix against the plane's own, in UNIT."""
        moved = self.across(f.latitude, f.longitude)
        heading = f.heading + self.convergence(f.latitude, f.longitude) - self.heading
        return np.array([*moved, half_turn(heading)]) / UNIT

    def turned(self, f: Fix, factor: np.ndarray) -> np.ndarray:
        """The first three rows of an error factor, brought from the fix's axes into these; in UNIT."""
        turn = self.convergence(f.latitude, f.longitude)
        c, s = np.cos(turn), np.sin(turn)
        east, north, heading = factor[:3]
        # the fix's north turns with its longitude, and its heading was taken from there
        prime, _ = curvature_radii_m(f.latitude)
        heading = heading - np.tan(f.latitude) / prime * east
        return np.stack([c * east + s * north, c * north - s * east, heading]) / UNIT[:, None]

    def local(self, latitude: float, factor: np.ndarray) -> np.ndarray:
        """A factor (3, m) in UNIT as m and rad, with the heading against its place's own north again."""
        prime, _ = curvature_radii_m(latitude)
        factor = factor * UNIT[:, None]
        return factor + np.outer([0.0, 0.0, np.tan(latitude) / prime], factor[0])

    def place(self, east_north_m: np.ndarray) -> tuple[float, float]:
        """Latitude, longitude (rad)."""
        across = east_north_m / self.radii
        zenith = np.sqrt(max(1 - across @ across, 0.0)) * self.zenith + across @ self.axes
        return float(np.arctan2(zenith[2], np.hypot(*zenith[:2]))), float(np.arctan2(zenith[1], zenith[0]))


@dataclass(frozen=True, kw_only=True)
class PlaceFilter:
    """What the fixes so far say.

    state (n,): east, north, heading in UNIT, then the errors that fixes share, in units of their own; known (3,): which
    of the first three are; sources (T, n, n): covariance of the state's error by each of the T terms of a fix; keys: of
    each term's shared error, the frames it holds for; columns: its place in the state.
    """

    plane: Plane
    names: tuple[str, ...]
    columns: tuple[slice, ...]
    keys: tuple[tuple, ...]
    state: np.ndarray
    known: np.ndarray
    sources: np.ndarray
    utc_unix_s: float  # of the last fix

    @classmethod
    def before(cls, f: Fix) -> "PlaceFilter":
        """Nothing known yet, in a plane at the first fix and ready for fixes with terms like its."""
        columns, n = [], 3
        for t in f.terms:
            width = 0 if t.shared is None else t.factor.shape[1]
            columns.append(slice(n, n + width))
            n += width
        names, sources = tuple(t.name for t in f.terms), np.zeros((len(f.terms), n, n))
        return cls(
            plane=Plane.at(f),
            names=names,
            columns=tuple(columns),
            keys=((),) * len(names),
            state=np.zeros(n),
            known=np.zeros(3, bool),
            sources=sources,
            utc_unix_s=f.utc_unix_s,
        )

    def forget(self, unknown: tuple[bool, bool, bool]) -> "PlaceFilter":
        """The same, with east, north or heading unknown."""
        which, sources = np.flatnonzero(unknown), self.sources.copy()
        sources[:, which, :] = sources[:, :, which] = 0.0
        return replace(self, sources=sources, known=self.known & ~np.array(unknown))

    def heading_unknown(self) -> "PlaceFilter":
        """The same place, the instrument turned."""
        return self.forget((False, False, True))

    def elsewhere(self, f: Fix) -> "PlaceFilter":
        """The same instrument, with all that is known of its errors, at an unknown place in the plane of a fix."""
        return replace(self.forget((True, True, True)), plane=Plane.at(f))

    def add(self, f: Fix, pose: Fix) -> tuple["PlaceFilter", float]:
        """With one more fix, and how many sigma that was from what was expected of it.  pose: the first of its pose."""
        now, own = self._at(f)
        shared, noise = np.zeros((3, len(now.state))), np.zeros((len(own), 3, 3))
        for k, t in enumerate(f.terms):
            like = pose if t.posed else f
            factor = self.plane.turned(like, like.terms[k].factor)
            if own[k]:
                noise[k] = t.variance * factor @ factor.T
            else:
                shared[:, now.columns[k]] = factor
        seen, sigmas = self.plane.seen(f), 0.0
        known, which = self.known, np.flatnonzero(self.known)
        kept, brought = (
            np.eye(len(now.state)),
            np.zeros((len(now.state), 3)),
        )  # of the state's error, and of the fix's
        state = now.state
        if known.any():
            told = shared[known]
            told[np.arange(len(which)), which] = 1.0
            across = now.sources.sum(0) @ told.T
            rest = seen[known] - told @ state
            if known[2]:
                rest[-1] = half_turn(rest[-1] * UNIT[2]) / UNIT[2]
            spread, own_spread = told @ across, noise.sum(0)[np.ix_(known, known)]
            sigmas = float(np.sqrt(rest @ np.linalg.solve(spread + own_spread, rest)))
            noise *= max(1.0, sigmas / HUBER_SIGMA)
            gain = np.linalg.solve(spread + own_spread * max(1.0, sigmas / HUBER_SIGMA), across.T).T
            kept -= gain @ told
            brought[:, known] = gain
            state = state + gain @ rest
        for k in np.flatnonzero(
            ~known
        ):  # what was not known is now what the fix says, less the shared errors
            state[k] = seen[k] - shared[k] @ state
            kept[k] = -shared[k] @ kept
            brought[k] = np.eye(3)[k] - shared[k] @ brought
        sources = kept @ now.sources @ kept.T + brought @ noise @ brought.T
        sources = (sources + sources.swapaxes(1, 2)) / 2
        return replace(now, state=state, sources=sources, known=np.ones(3, bool)), sigmas

    def straight_from(self, before: "PlaceFilter") -> bool:
        """Whether the way from an earlier place to this one is as straight as this one's claim takes it for.

        A clock's error goes along the parallel, which leaves the plane with the square of the way: 20 m in 16 km.
        """
        if not before.known[:2].all():
            return True
        step = self.state[:2] - before.state[:2]
        latitude, _ = before.plane.place(before.state[:2])
        bent = step @ step / (2 * before.plane.radii[1]) * (1 + min(abs(np.tan(latitude)), STEEPEST))
        least = np.linalg.eigvalsh(self.sources.sum(0)[:2, :2])[0]
        return bool(bent <= MOST_BENT * np.sqrt(max(least, 0.0)))

    def _at(self, f: Fix) -> tuple["PlaceFilter", np.ndarray]:
        """The shared errors as they are at the time of a fix; and which of its terms are all its own (T,)."""
        if tuple(t.name for t in f.terms) != self.names:
            raise ValueError("fixes with other error terms: they are not of one program")
        state, sources, keys = self.state.copy(), self.sources.copy(), list(self.keys)
        own = np.array([t.shared is None for t in f.terms])
        for k, t in enumerate(f.terms):
            if own[k]:
                continue
            at, alike = self.columns[k], correlation(keys[k], t.shared)
            state[at] *= alike
            sources[:, at, :] *= alike
            sources[:, :, at] *= alike
            walked = t.walk_s * abs(f.utc_unix_s - self.utc_unix_s) if alike else 0.0
            sources[k, at, at] += np.eye(at.stop - at.start) * (t.variance * (1 - alike**2) + walked)
            keys[k] = t.shared
        later = max(self.utc_unix_s, f.utc_unix_s)
        return replace(self, state=state, sources=sources, keys=tuple(keys), utc_unix_s=later), own

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude, longitude, heading (rad; NaN where nothing is known of it since the camera was touched)."""
        latitude, longitude = self.plane.place(self.state[:2] * UNIT[:2])
        if not self.known[2]:
            return latitude, longitude, float("nan")
        heading = self.state[2] * UNIT[2] + self.plane.heading - self.plane.convergence(latitude, longitude)
        return latitude, longitude, full_turn(heading)

    def terms(self, like: Sequence[ErrorTerm]) -> tuple[ErrorTerm, ...]:
        """The budget of `place`, with factors (3, 3)."""
        latitude, _ = self.plane.place(self.state[:2] * UNIT[:2])
        return tuple(
            ErrorTerm(t.name, self.plane.local(latitude, symmetric_root(source[:3, :3])), shared=t.shared)
            for t, source in zip(like, self.sources, strict=True)
        )

    def sigmas_apart(self, part: "PlaceFilter") -> float:
        """How far the place of `part`, which had some of these fixes only, is from this one, in sigma."""
        apart = self.plane.across(*part.place[:2]) - self.state[:2]
        # what a part errs beyond the whole is independent of it
        beyond = (part.sources.sum(0) - self.sources.sum(0))[:2, :2]
        values, vectors = np.linalg.eigh(beyond)
        values = np.maximum(values, 1e-3 * np.trace(part.sources.sum(0)[:2, :2]))
        return float(np.sqrt(np.sum((apart @ vectors) ** 2 / values)))


def _axes(latitude: float, longitude: float) -> np.ndarray:
    """East and north (2, 3) in ITRS."""
    cl, sl, cp, sp = np.cos(longitude), np.sin(longitude), np.cos(latitude), np.sin(latitude)
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp]])
