# SPDX-License-Identifier: Apache-2.0
"""Lists of the catalogue's stars about a place in Cygnus, with no time and no level, for the tests of identification."""

from typing import Any

import numpy as np

from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.rotation import unit_vector
from starpos.sky.catalogue import Catalogue

RA_DEG, DEC_DEG = 295.77, 49.79


def stars_of_cygnus(
    catalogue: Catalogue,
    rng: np.random.Generator,
    camera: Camera,
    limit_mag: float,
    noise_px: float,
    *,
    roll_deg: float = 0.0,
    width: float | None = None,
    **about: Any,
) -> Stars:
    """The stars that a camera sees with its centre at RA_DEG, DEC_DEG, brightest first.

    noise_px: of the places.  width: px from the left within which there are stars; None: all.
    about: more fields of Stars.
    """
    ra, dec, roll = np.radians([RA_DEG, DEC_DEG, roll_deg])
    axis, north = unit_vector(ra, dec), unit_vector(ra, dec + np.pi / 2)
    down = -np.cos(roll) * north - np.sin(roll) * np.cross(north, axis)
    attitude = np.stack([np.cross(down, axis), down, axis])
    index = catalogue.cone(axis, camera.half_diagonal_rad, limit_mag)
    index = index[np.argsort(catalogue.vmag(index))]
    xy = camera.project(catalogue.directions(index) @ attitude.T) + rng.normal(0, noise_px, (len(index), 2))
    last = np.array([(camera.width if width is None else width) - 1, camera.height - 1])
    xy = xy[((xy > 0) & (xy < last)).all(1)]
    n = len(xy)
    given: dict[str, Any] = {
        "flux": np.arange(n, 0, -1.0),
        "snr": np.full(n, 20.0),
        "covariance": np.broadcast_to(0.01 * np.eye(2), (n, 2, 2)),
        "flags": np.zeros(n),
        "width": camera.width,
        "height": camera.height,
    }
    return Stars(x=xy[:, 0], y=xy[:, 1], **given | about)
