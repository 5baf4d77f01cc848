# SPDX-License-Identifier: Apache-2.0
"""The observation equations of a session: what a tiltmeter reads, from the attitudes, the deflection and A3.

Up leans from the ellipsoid's normal by xi to the north and eta to the east, so in geodetic east, north, up it is along
n = (eta, xi, 1).  The tiltmeter's axes X', Y' rise by asin(A3 C n) there, where C is the camera's attitude by the stars.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.zenith.sighting import ZenithSighting

TURNS_TRIED = 360


@dataclass(frozen=True, eq=False, kw_only=True)
class LeanEstimate:
    """A deflection, lean (2,): eta, xi in rad, and A3 (3, 3)."""

    lean: np.ndarray
    a3: np.ndarray

    def moved(self, step: np.ndarray) -> "LeanEstimate":
        """The estimate after a step (5,): eta, xi, and a small rotation of A3 about S's axes."""
        return LeanEstimate(lean=self.lean + step[:2], a3=rotation.from_vector(step[2:]) @ self.a3)

    def deflection(self, latitude: float) -> np.ndarray:
        """Deflection (2,) xi, eta in rad at a geodetic latitude, by the astronomic latitude and longitude of up.

        xi is the difference of the latitudes, eta the difference of the longitudes times cos(latitude) (Heiskanen and
        Moritz 1967,
        section 5-4).  It differs from up's lean by xi eta tan(latitude), 3 mas at 80 deg for 10 arcsec of each.
        """
        east, north = self.lean
        sine, cosine = np.sin(latitude), np.cos(latitude)
        across = cosine - sine * north
        astronomic = np.arctan2(sine + cosine * north, np.hypot(east, across))
        return np.array([astronomic - latitude, np.arctan2(east, across) * cosine])


@dataclass(frozen=True, eq=False, kw_only=True)
class Lines:
    """The equations of N frames, linear about a LeanEstimate.

    off (N, 2): readings minus those that the estimate predicts, rad.
    Derivatives of the prediction: by_parameters (N, 2, 5) as in `LeanEstimate.moved`; by_camera (N, 2, 3), by a small
    rotation of the camera about C's axes; by_sky (N, 2, 3), by one of the sky about east, north, up.
    """

    off: np.ndarray
    by_parameters: np.ndarray
    by_camera: np.ndarray
    by_sky: np.ndarray

    @property
    def by_lean(self) -> np.ndarray:
        """Derivatives (N, 2, 2) by up's lean to the east and to the north."""
        return self.by_parameters[..., :2]

    @classmethod
    def at(cls, estimate: LeanEstimate, sightings: Sequence[ZenithSighting], bending: float) -> "Lines":
        """The equations about an estimate.

        bending: refraction (rad) for 1 rad of zenith distance.  The attitudes count it from the ellipsoid's normal; light
        is bent towards the plumb line, so all stars stand that share of the deflection further over.
        """
        attitude = np.array([s.enu_to_camera for s in sightings])
        shown = 1 - bending
        up = rotation.normalised(np.append(shown * estimate.lean, 1.0))
        sensor = estimate.a3 @ attitude
        there = sensor @ up
        slope = 1 / np.sqrt(1 - there[:, :2] ** 2)
        theta = np.array([s.tilt.theta[:2] for s in sightings])

        def of(turn: np.ndarray) -> np.ndarray:
            """Change (N, 2, 3) of the angles, where up moves by `turn` (N, 3, 3)."""
            return slope[..., None] * turn[:, :2]

        lean = of(sensor)[..., :2] * shown
        a3 = of(np.array([-rotation.cross_matrix(v) for v in there]))
        in_camera = attitude @ up
        camera = of(estimate.a3 @ np.array([-rotation.cross_matrix(v) for v in in_camera]))
        return cls(
            off=theta - np.arcsin(there[:, :2]),
            by_parameters=np.concatenate([lean, a3], 2),
            by_camera=camera,
            by_sky=of(sensor @ -rotation.cross_matrix(up)),
        )


def start_of(sightings: Sequence[ZenithSighting]) -> LeanEstimate:
    """An estimate from nothing: the turn of the tiltmeter about the plumb line for which all frames agree best.

    For a given turn the equations are linear in the deflection and the two tilts of A3.
    """
    attitude = np.array([s.enu_to_camera for s in sightings])
    theta = np.sin([s.tilt.theta[:2] for s in sightings])
    n = len(theta)
    # unknown: two tilts of the camera, eta, xi
    design = np.concatenate([np.broadcast_to(np.eye(2), (n, 2, 2)), attitude[:, :2, :2]], 2).reshape(2 * n, 4)
    gain = np.linalg.pinv(design)
    turns = np.arange(TURNS_TRIED) * 2 * np.pi / TURNS_TRIED
    c, s = np.cos(turns), np.sin(turns)
    # readings along the camera's axes, if A3 turns by each angle
    back = np.stack([np.outer(theta[:, 0], c) + np.outer(theta[:, 1], s),
                     np.outer(theta[:, 1], c) - np.outer(theta[:, 0], s)], 1)  # fmt: skip
    y = (back - attitude[:, :2, 2, None]).reshape(2 * n, TURNS_TRIED)
    left = y - design @ (gain @ y)
    best = int(np.argmin((left**2).sum(0)))
    across, down, eta, xi = gain @ y[:, best]
    a3 = rotation.about_axis(2, turns[best])
    # A3 takes C's x by `across` up and its y by `down`
    tilted = rotation.from_vector(a3 @ np.array([-down, across, 0.0]))
    return LeanEstimate(lean=np.array([eta, xi]), a3=tilted @ a3)
