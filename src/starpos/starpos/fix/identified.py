# SPDX-License-Identifier: Apache-2.0
"""The solution of a frame whose stars are identified: names, pointing, and what is suspicious about them."""

import math
import time

import numpy as np

from starpos.fix.solution import TWO_SKIES, UNEXPLAINED, Attitude, Solution
from starpos.frames.stars import Stars
from starpos.identification import Identification, Sky, wide
from starpos.identification._frame import FrameStars
from starpos.identification.explained import Explained, explained_by
from starpos.identification.two_skies import two_skies
from starpos.instrument.camera import Camera
from starpos.units import ARCSEC


def solution_of(
    stars: Stars,
    field: FrameStars | wide.WideField,
    sky: Sky,
    camera: Camera,
    found: Identification,
    begin_s: float,
) -> Solution:
    """The solution of stars that are identified: a success without a fix.

    field: the stars as they were searched.
    begin_s: when their search began, by time.perf_counter.
    """
    warnings, explained = suspicions(stars, field, sky, found)
    names, magnitudes = sky.catalogue.labels(found.catalogue)
    return Solution.of(
        stars,
        names=names,
        star=found.star,
        magnitudes=magnitudes,
        attitude=attitude_of(found, sky, camera, np.stack([stars.x, stars.y], -1)[found.star]),
        warnings=warnings,
        explained=explained,
        found=found,
        identify_s=time.perf_counter() - begin_s,
    )


def suspicions(
    stars: Stars, field: FrameStars | wide.WideField, sky: Sky, found: Identification
) -> tuple[tuple[str, ...], Explained]:
    """Sorted names of suspicions about the stars' identification, and how much it explains.

    For a fisheye, the part with most identified stars is judged.
    """
    flux = stars.flux
    if isinstance(field, wide.WideField):
        part, found = wide.part_of(field, sky, found)
        field, flux = part.field, flux[part.row]
    explained = explained_by(found, field)
    names = (TWO_SKIES,) * two_skies(field, flux, sky, found, explained) + (UNEXPLAINED,) * (
        not explained.enough
    )
    return names, explained


def attitude_of(found: Identification, sky: Sky, camera: Camera, xy: np.ndarray) -> Attitude:
    """Pointing of the frame's centre; of a mirrored frame, after it was turned the right way up.

    xy (M, 2): places of the identified stars, px.
    """
    scale = found.focal_scale
    spread_px = math.sqrt(np.square(xy - xy.mean(0)).sum())
    if camera.is_ideal:
        across, down, row = camera.centre_from_axis
        centre, above = (across, down, scale), (across, down - row, scale)
    else:
        # a mirrored fisheye's attitude is given for its picture flipped about the axis, which need not be the middle
        turned = found.mirrored and wide.is_wide(camera)
        x, y = camera.centre_px
        centre, above = camera.scaled(scale).directions([x, x], [y, y + 1.0 if turned else y - 1.0])
        if turned:
            centre, above = wide.FLIP @ centre, wide.FLIP @ above
    ra, dec, roll = found.pointing(centre, above, sky.velocity)
    return Attitude(
        ra=ra,
        dec=dec,
        roll=roll,
        focal_px=camera.fx * scale,
        focal_stddev_px=camera.fx * scale * found.residual_px / spread_px,
        residual_arcsec=found.residual_px / (scale * math.sqrt(camera.fx * camera.fy)) / ARCSEC,
        log_odds=found.log_odds,
        mirrored=found.mirrored,
        model=camera.model,
    )
