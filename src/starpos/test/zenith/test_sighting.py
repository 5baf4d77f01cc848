# SPDX-License-Identifier: Apache-2.0
"""What the stars of one frame say of their centroids."""

import numpy as np
import pytest

from starpos.zenith.sighting import centroids_of


def test_a_star_of_unknown_motion_does_not_hide_the_scatter_of_the_centroids(rng):
    # px: centroids scatter by three times what they state, and one star may be anywhere within a pixel
    stated = np.broadcast_to(np.eye(2) * 0.03**2, (120, 2, 2))
    placed = np.full(120, 0.02)
    placed[7] = 1.2
    residual = rng.normal(0, 1, (120, 2)) * np.hypot(0.095, placed)[:, None]
    found = centroids_of(residual, stated, placed, 1 - 2 / 120)
    assert np.sqrt(found[:, 0, 0]) == pytest.approx(np.full(120, 0.095), rel=0.15)
