# SPDX-License-Identifier: Apache-2.0
"""What a session itself says of its stars' catalogue places.

Stars stand in many frames, so a frame's stars show how far each is from its place in the others.  So their places are
adjusted, as overlapping plates are (Eichhorn 1960, Astron. Nachr. 285, 233), with the catalogue's errors as what is known
before; and their scatter shows how large the catalogue's errors are here, by maximum likelihood.  What is common to all
stars of the session remains as uncertain as such errors leave it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.zenith.sighting import ZenithSighting

# factor by which the catalogue's errors may be smaller or larger than stated
MAX_FACTOR = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class StarPlaces:
    """Corrections of S stars' places along the axes of ICRS, in units of their sigmas in the catalogue.

    stars (S,): rows of the catalogue.  rows: for each frame, which of the S stars are its (N,).  correction (S, 3).
    root (3 S, 3 S): lower triangular, of the weights that the corrections have.
    factor: size of the catalogue's errors over what it states.
    """

    stars: np.ndarray
    rows: tuple[np.ndarray, ...]
    correction: np.ndarray
    root: np.ndarray
    factor: float

    @classmethod
    def of(cls, sightings: Sequence[ZenithSighting]) -> "StarPlaces":
        """The corrections that all frames agree on best."""
        # slow to import
        from scipy.linalg import cho_solve, cholesky

        names, inverse = np.unique(np.concatenate([s.stars for s in sightings]), return_inverse=True)
        rows = tuple(np.split(inverse, np.cumsum([len(s.stars) for s in sightings])[:-1]))
        number = len(names)
        own, right = np.zeros((number, 3, 3)), np.zeros((number, 3))
        # a frame's attitude and scale take up what its stars have in common
        taken = np.zeros((len(sightings), 4, number, 3))
        for k, (row, s) in enumerate(zip(rows, sightings, strict=True)):
            taken[k][:, row] = s.star_common
            own[row] += s.star_weight
            right[row] += s.star_pull
        common = taken.reshape(-1, 3 * number)
        flat, pull = -common.T @ common, right.ravel()
        blocks, each = flat.reshape(number, 3, number, 3), np.arange(number)
        blocks[each, :, each] += own
        factor = _factor(flat, pull)
        root = cholesky(flat + np.eye(len(flat)) / factor**2, lower=True)
        correction = cho_solve((root, True), pull).reshape(-1, 3)
        return cls(stars=names, rows=rows, correction=correction, root=root, factor=factor)

    def applied(self, sightings: Sequence[ZenithSighting]) -> list[ZenithSighting]:
        """The sightings with the attitudes that the corrected places give."""
        return [
            replace(s, enu_to_camera=rotation.from_vector(-self._turn(k, s)) @ s.enu_to_camera)
            for k, s in zip(self.rows, sightings, strict=True)
        ]

    def _turn(self, rows: np.ndarray, s: ZenithSighting) -> np.ndarray:
        return np.einsum("inj,nj->i", s.by_star, self.correction[rows])

    def columns(self, by_camera: np.ndarray, sightings: Sequence[ZenithSighting]) -> np.ndarray:
        """Errors of 1 sigma (N, 2, 3 S) of the readings, by what remains unknown of the places.

        by_camera (N, 2, 3): derivatives of the readings by a small rotation of the camera.
        """
        # slow to import
        from scipy.linalg import solve_triangular

        whole = np.zeros((len(sightings), 2, len(self.correction), 3))
        for k, (rows, s) in enumerate(zip(self.rows, sightings, strict=True)):
            whole[k][:, rows] = np.einsum("ai,inj->anj", by_camera[k], s.by_star)
        flat = whole.reshape(2 * len(sightings), -1)
        return solve_triangular(self.root, flat.T, lower=True).T.reshape(len(sightings), 2, -1)


def _factor(weights: np.ndarray, pull: np.ndarray) -> float:
    """The size of the catalogue's errors, over what it states, that makes the residuals likeliest.

    weights (M, M), pull (M,): normal equations of the stars' displacements in units of their stated sigmas.
    """
    # slow to import
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import minimize_scalar

    def cost(log_factor: float) -> float:
        prior = np.exp(-2 * log_factor)
        root = cholesky(weights + prior * np.eye(len(pull)), lower=True)
        half = solve_triangular(root, pull, lower=True)
        size = len(pull) * 2 * log_factor + 2 * float(np.log(np.diag(root)).sum())
        # a log-normal of a factor of 2 about what is stated, for sessions of few stars
        return size - float(half @ half) + (log_factor / np.log(2)) ** 2

    most = float(np.log(MAX_FACTOR))
    found = minimize_scalar(cost, bounds=(-most, most), method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x))
