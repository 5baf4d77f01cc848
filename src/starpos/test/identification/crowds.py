# SPDX-License-Identifier: Apache-2.0
"""Fields of the paper's camera under a crowd of false stars."""

import numpy as np

from starpos.identification import identify
from starpos.identification.pose import stars_at
from starpos.instrument.camera import Camera

# the paper's field, pixels binned by four
CAMERA, LIMIT = Camera.from_focal(1404, 936, 23437.5), 8.8
SIGMA_PX = 0.05


def stars_on(sky, attitude, rng):
    """Pixels (N, 2) of the catalogue's stars on the frame, brightest first."""
    index = sky.catalogue.cone(attitude[2], CAMERA.half_diagonal_rad * 1.05, LIMIT)
    xy = CAMERA.project(sky.directions(index) @ attitude.T)
    on = (xy >= 0).all(1) & (xy <= [CAMERA.width - 1, CAMERA.height - 1]).all(1)
    return xy[on] + rng.normal(0, SIGMA_PX, (on.sum(), 2))


def under(crowd, xy, rng):
    return np.concatenate([rng.uniform(0, [CAMERA.width - 1, CAMERA.height - 1], (crowd, 2)), xy])


def identified(xy, sigma_px, camera, sky, priors=()):
    """What stars at pixels xy (N, 2), brightest first, of an ideal camera are identified as."""
    return identify(stars_at(camera, xy, sigma_px), sky, priors)
