# SPDX-License-Identifier: Apache-2.0
"""Advice on how an instrument lets GNSS teach more."""

import numpy as np

from starpos.gnss.filter import LINEAR_TURN_RAD
from starpos.gnss.states import Learned

# Correlation of A3 and the deflection above which they are not separated.
ALIKE = 0.8
# Fewer poses average the inclinometer's errors badly.
FEW_POSES = 6


def what_would_tell_more(learned: Learned) -> str:
    """Say in a sentence what would teach most; '' if nothing stands out."""
    at, covariance = learned.layout, learned.covariance
    _, turn = learned.a3_stddev_rad
    if turn > LINEAR_TURN_RAD:
        return f"lean it otherwise at each pose: A3's turn about the plumb line is known to {np.degrees(turn):.2g} deg"
    if _correlation(covariance, at.a3, at.constant) > ALIKE:
        return "turn it to other headings: at one heading A3 cannot be separated from the deflection"
    if learned.poses < FEW_POSES:
        return "let it stand at more poses, newly turned"
    return ""


def _correlation(covariance: np.ndarray, a: slice, b: slice) -> float:
    """Largest correlation of any combination of some states with any of others; 0 where one of them is known."""
    of_a, of_b = covariance[a, a], covariance[b, b]
    if min(np.linalg.eigvalsh(of_a)[0], np.linalg.eigvalsh(of_b)[0]) <= 0:
        return 0.0
    root_a, root_b = np.linalg.cholesky(of_a), np.linalg.cholesky(of_b)
    whitened = np.linalg.solve(root_a, np.linalg.solve(root_b, covariance[b, a]).T)
    return float(np.linalg.svd(whitened, compute_uv=False)[0])
