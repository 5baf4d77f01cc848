# SPDX-License-Identifier: Apache-2.0
"""Many frames of one standing instrument made into one fix: what is new in every frame averages, a common error stays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.budget import ErrorTerm, symmetric_root
from starpos.earth import curvature_radii_m
from starpos.fix import Fix

SAME_HEADING_SIGMA = 5.0


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
    """The weighted mean of at least one fix; each is weighted by the errors it does not share with the others."""
    first = fixes[0]
    prime, meridian = curvature_radii_m(first.latitude)
    cos_phi = np.cos(first.latitude)
    turn = np.array([[_turn(f.longitude - first.longitude), f.latitude - first.latitude] for f in fixes])
    moved = turn * [prime * cos_phi, meridian]
    heading = np.array([_turn(f.heading - first.heading) for f in fixes])
    own = np.array([sum(t.covariance for t in f.terms if not t.common)[:3, :3] for f in fixes])
    own[:, 2, 2] += 1e-24
    weight = np.linalg.inv(own[:, :2, :2])
    weight = (
        np.linalg.solve(weight.sum(0), weight.swapaxes(0, 1).reshape(2, -1)).reshape(2, -1, 2).swapaxes(0, 1)
    )
    east, north = np.einsum("kij,kj->i", weight, moved)
    heading_weight = 1 / own[:, 2, 2]
    heading_weight /= heading_weight.sum()
    mean_heading = heading_weight @ heading
    scatter = np.abs(heading - mean_heading) / np.sqrt(own[:, 2, 2])
    turned = scatter.max() > SAME_HEADING_SIGMA
    gain = np.zeros((len(fixes), 6, 6))  # what one frame's error does to the mean
    gain[:, :2, :2] = weight
    gain[:, 2:, 2:] = heading_weight[:, None, None] * np.eye(4)
    terms = []
    for k, term in enumerate(first.terms):
        factors = [gain[n] @ f.terms[k].factor for n, f in enumerate(fixes)]
        if term.common and len({f.shape for f in factors}) == 1:
            factor = sum(factors)
        else:
            factor = symmetric_root(sum(f @ f.T for f in factors))
        terms.append(ErrorTerm(term.name, factor, term.common))
    return Average(
        float(np.mean([f.utc_unix_s for f in fixes])),
        first.latitude + north / meridian,
        _turn(first.longitude + east / max(prime * cos_phi, 1.0)),
        float("nan") if turned else float((first.heading + mean_heading) % (2 * np.pi)),
        tuple(terms),
        len(fixes),
    )


def _turn(angle: float) -> float:
    """An angle in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
