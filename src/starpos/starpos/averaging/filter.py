# SPDX-License-Identifier: Apache-2.0
"""A Kalman filter over the place and heading of an instrument at rest, and over the errors that its fixes share.

A calibration error that turns with the instrument is separated from the place; one that does not turn stays in the
answer.  A zero that wanders also wanders in the filter.  The filter's size is constant, and its answer equals
generalised least squares over all fixes at once (test_average.py).  It keeps a covariance per source of error, so that
the average has a budget.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, meridian_turn, place_of_zenith, zenith_of
from starpos.fix.fix import Fix
from starpos.fix.terms import EACH_POSE, ErrorTerm, correlation
from starpos.frozen import at_once
from starpos.rotation import full_turn, half_turn

# of east, north in m and heading in rad: brings them to similar sizes
UNIT = np.array([1.0, 1.0, 1e-6])
# a fix further off than this pulls no harder
HUBER_SIGMA = 4.0
# a step of the place may leave the plane by this share of the place's sigma
MAX_BENT = 0.2
# tangent of the latitude beyond which parallels count as no more curved
STEEPEST = 30.0


@at_once
@dataclass(frozen=True)
class Plane:
    """The tangent plane at a fix, whose east and north are used for all fixes near it.

    zenith (3,), axes (2, 3): up, and east and north, in ITRS.  radii (2,): of the prime vertical and the meridian, m.
    heading (rad): of the fix; headings count from it.
    """

    zenith: np.ndarray
    axes: np.ndarray
    radii: np.ndarray
    heading: float

    @classmethod
    def at(cls, f: Fix) -> "Plane":
        """The plane at a fix."""
        axes, radii = enu_axes(f.latitude, f.longitude), np.array(curvature_radii_m(f.latitude))
        return cls(axes[2], axes[:2], radii, f.heading)

    def convergence(self, latitude: float, longitude: float) -> float:
        """Azimuth (rad) in this plane of the north of a place (rad)."""
        return float(np.arctan2(*(self.axes @ enu_axes(latitude, longitude)[1])))

    def across(self, latitude: float, longitude: float) -> np.ndarray:
        """East, north (2,) in m of a place (rad)."""
        return self.axes @ (zenith_of(latitude, longitude) - self.zenith) * self.radii

    def coordinates(self, f: Fix) -> np.ndarray:
        """East, north, heading (3,) of a fix relative to the plane, in UNIT."""
        moved = self.across(f.latitude, f.longitude)
        heading = f.heading + self.convergence(f.latitude, f.longitude) - self.heading
        return np.array([*moved, half_turn(heading)]) / UNIT

    def turn(self, f: Fix) -> np.ndarray:
        """What takes the first three rows of an error factor of a fix from its axes into the plane's, in UNIT: (3, 3)."""
        angle = self.convergence(f.latitude, f.longitude)
        c, s = np.cos(angle), np.sin(angle)
        # an error of the longitude turns the north from which the heading counts
        prime, _ = curvature_radii_m(f.latitude)
        north_turns = meridian_turn(f.latitude) / prime
        return np.array([[c, s, 0.0], [-s, c, 0.0], [-north_turns, 0.0, 1.0]]) / UNIT[:, None]

    def local(self, latitude: float, factor: np.ndarray) -> np.ndarray:
        """A factor (3, m) in UNIT, as m and rad, with the heading from the north at its own place; reverses `turn`."""
        prime, _ = curvature_radii_m(latitude)
        factor = factor * UNIT[:, None]
        return factor + np.outer([0.0, 0.0, meridian_turn(latitude) / prime], factor[0])

    def place(self, east_north_m: np.ndarray) -> tuple[float, float]:
        """Latitude, longitude (rad) of a point of the plane."""
        across = east_north_m / self.radii
        zenith = np.sqrt(max(1 - across @ across, 0.0)) * self.zenith + across @ self.axes
        return place_of_zenith(zenith)


@at_once
@dataclass(frozen=True, kw_only=True)
class PlaceFilter:
    """State of the filter after the fixes so far.

    state (n,): east, north, heading in UNIT, then the errors that fixes share, in units of their own.
    known (3,): mask of the known ones among east, north, heading.
    sources (T, n, n): covariance of the state that comes from each of the T terms of a fix.
    names, columns, keys: names of the terms, positions of their shared errors in the state, and `shared` of the last fix.
    utc_unix_s: time of the last fix.
    """

    plane: Plane
    names: tuple[str, ...]
    columns: tuple[slice, ...]
    keys: tuple[tuple, ...]
    state: np.ndarray
    known: np.ndarray
    sources: np.ndarray
    utc_unix_s: float

    @classmethod
    def before(cls, f: Fix) -> "PlaceFilter":
        """A filter that knows nothing, in the plane of the first fix and ready for fixes with the same terms."""
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
        """The filter with east, north or heading unknown."""
        which, sources = np.flatnonzero(unknown), self.sources.copy()
        sources[:, which, :] = sources[:, :, which] = 0.0
        return replace(self, sources=sources, known=self.known & ~np.array(unknown))

    def elsewhere(self, f: Fix) -> "PlaceFilter":
        """The filter at an unknown place in the plane of a fix, with all that is known of the instrument's errors."""
        return replace(self.forget((True, True, True)), plane=Plane.at(f))

    def updated(self, f: Fix, pose: Fix) -> tuple["PlaceFilter", float]:
        """The filter with one more fix, and by how many sigma the fix differed from what was expected.

        pose: the first fix since the camera was touched.  Raises ValueError if the fix has other error terms.
        """
        now, own = self._at(f, pose)
        shared, noise = np.zeros((3, len(now.state))), np.zeros((len(own), 3, 3))
        turn, pose_turn = self.plane.turn(f), self.plane.turn(pose)
        for k, t in enumerate(f.terms):
            factor = pose_turn @ pose.terms[k].factor[:3] if t.constant_within_pose else turn @ t.factor[:3]
            if own[k]:
                noise[k] = t.variance * factor @ factor.T
            else:
                shared[:, now.columns[k]] = factor
        seen, sigmas = self.plane.coordinates(f), 0.0
        known, which = self.known, np.flatnonzero(self.known)
        # the state's new error is kept @ its old error + brought @ the fix's own error
        kept, brought = np.eye(len(now.state)), np.zeros((len(now.state), 3))
        state = now.state
        if known.any():
            design = shared[known]
            design[np.arange(len(which)), which] = 1.0
            across = now.sources.sum(0) @ design.T
            innovation = seen[known] - design @ state
            if known[2]:
                innovation[-1] = half_turn(innovation[-1] * UNIT[2]) / UNIT[2]
            predicted, own_noise = design @ across, noise.sum(0)[np.ix_(known, known)]
            sigmas = float(np.sqrt(innovation @ np.linalg.solve(predicted + own_noise, innovation)))
            noise *= max(1.0, sigmas / HUBER_SIGMA)
            gain = np.linalg.solve(predicted + own_noise * max(1.0, sigmas / HUBER_SIGMA), across.T).T
            kept -= gain @ design
            brought[:, known] = gain
            state = state + gain @ innovation
        # an unknown element is set to the fix, less the shared errors
        for row in np.flatnonzero(~known):
            state[row] = seen[row] - shared[row] @ state
            kept[row] = -shared[row] @ kept
            brought[row] = np.eye(3)[row] - shared[row] @ brought
        sources = kept @ now.sources @ kept.T + brought @ noise @ brought.T
        sources = (sources + sources.swapaxes(1, 2)) / 2
        return replace(now, state=state, sources=sources, known=np.ones(3, bool)), sigmas

    def straight_from(self, before: "PlaceFilter") -> bool:
        """Whether the step from an earlier place to this one is short enough for the plane.

        An error of the clock moves the place along its parallel, which leaves the plane with the square of the step: by
        20 m in 16 km.  That has to be small compared with this place's sigma.
        """
        if not before.known[:2].all():
            return True
        step = self.state[:2] - before.state[:2]
        latitude, _ = before.plane.place(before.state[:2])
        bent = step @ step / (2 * before.plane.radii[1]) * (1 + min(abs(np.tan(latitude)), STEEPEST))
        least = np.linalg.eigvalsh(self.sources.sum(0)[:2, :2])[0]
        return bool(bent <= MAX_BENT * np.sqrt(max(least, 0.0)))

    def _at(self, f: Fix, pose: Fix) -> tuple["PlaceFilter", np.ndarray]:
        """The filter at the time of a fix, before it is added; and a mask (T,) of the terms whose error is new in it.

        Raises ValueError if the fix has other terms.
        """
        if tuple(t.name for t in f.terms) != self.names:
            raise ValueError("fixes have different error terms: they were not made by one program")
        keys, own = list(self.keys), np.array([t.shared is None for t in f.terms])
        # what is left of each shared error, and the variance that it gains
        left, gained = np.ones(len(self.state)), np.zeros((len(keys), len(self.state)))
        for k, t in enumerate(f.terms):
            if t.shared is None:
                continue
            shared = (pose.utc_unix_s,) if t.shared == EACH_POSE else t.shared
            at, alike = self.columns[k], correlation(keys[k], shared)
            walked = t.walk_s * abs(f.utc_unix_s - self.utc_unix_s) if alike else 0.0
            left[at], gained[k, at] = alike, t.variance * (1 - alike**2) + walked
            keys[k] = shared
        sources = self.sources * (left[:, None] * left)
        np.einsum("kii->ki", sources)[:] += gained
        later = max(self.utc_unix_s, f.utc_unix_s)
        now = replace(self, state=self.state * left, sources=sources, keys=tuple(keys), utc_unix_s=later)
        return now, own

    @property
    def place(self) -> tuple[float, float, float]:
        """Latitude, longitude, heading (rad); the heading is NaN if it is unknown since the camera was touched."""
        latitude, longitude = self.plane.place(self.state[:2] * UNIT[:2])
        if not self.known[2]:
            return latitude, longitude, float("nan")
        heading = self.state[2] * UNIT[2] + self.plane.heading - self.plane.convergence(latitude, longitude)
        return latitude, longitude, full_turn(heading)

    @property
    def east_north_m(self) -> np.ndarray:
        """East, north (2,) in m of the place in the plane."""
        return self.state[:2] * UNIT[:2]

    def terms(self, like: Sequence[ErrorTerm]) -> tuple[ErrorTerm, ...]:
        """The budget of `place`, with factors (3, 3); names and keys as in the terms `like`."""
        latitude, _ = self.plane.place(self.state[:2] * UNIT[:2])
        return tuple(
            ErrorTerm(
                t.name,
                self.plane.local(latitude, symmetric_root(source[:3, :3])),
                shared=t.shared,
                origin=t.origin,
            )
            for t, source in zip(like, self.sources, strict=True)
        )

    def sigmas_apart(self, part: "PlaceFilter") -> float:
        """Distance in sigma between this place and the place of `part`, a filter of some of the same fixes."""
        apart = self.plane.across(*part.place[:2]) - self.state[:2]
        # the difference of a part and the whole is independent of the whole, so their covariances subtract
        beyond = (part.sources.sum(0) - self.sources.sum(0))[:2, :2]
        values, vectors = np.linalg.eigh(beyond)
        values = np.maximum(values, 1e-3 * np.trace(part.sources.sum(0)[:2, :2]))
        return float(np.sqrt(np.sum((apart @ vectors) ** 2 / values)))
