# SPDX-License-Identifier: Apache-2.0
"""What tests of the chain from stars and tilt to a solution share."""

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m


def refused(solution, status):
    """The solution has no fix but this status and one sentence."""
    assert solution.status is status
    assert solution.fix is None
    assert not solution.ok
    assert solution.message
    assert "\n" not in solution.message
    return solution.message


def off_by_sigma(fix, scene):
    """Position error over the claimed sigma (Mahalanobis), heading error over its sigma."""
    phi = np.radians(scene.site.latitude_deg)
    prime, meridian = curvature_radii_m(phi)
    east = (fix.longitude - np.radians(scene.site.longitude_deg) + np.pi) % (2 * np.pi) - np.pi
    moved = np.array([east * prime * np.cos(phi), (fix.latitude - phi) * meridian])
    turned = (fix.heading - scene.heading + np.pi) % (2 * np.pi) - np.pi
    c = fix.covariance
    return np.sqrt(moved @ np.linalg.solve(c[:2, :2], moved)), abs(turned) / np.sqrt(c[2, 2])
