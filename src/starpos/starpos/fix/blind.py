# SPDX-License-Identifier: Apache-2.0
"""The pointing of a frame whose scale nobody has said."""

import time
from dataclasses import dataclass, replace

import numpy as np

from starpos.errors import StarposError
from starpos.fix.identified import identified
from starpos.fix.solution import Solution, Status
from starpos.frames.stars import Stars
from starpos.identification import FEWEST_STARS, Sky, quad_cache
from starpos.identification.blind import LARGEST_DEG, SMALLEST_DEG, STAGES, identify_blind
from starpos.identification.search import frame_stars, through
from starpos.identification.triangles import no_triangles
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue


@dataclass(frozen=True)
class BlindSolver:
    """Identifies frames of any scale, first near that of their EXIF; `stages` of the search are fewer to be quick."""

    catalogue: Catalogue
    progress: Progress = quiet
    stages: tuple[tuple[int, float], ...] = STAGES

    def prepare(self) -> None:
        """Load the quads, or build them."""
        quad_cache.cached(self.catalogue, self.progress)

    def identify(self, stars: Stars) -> Solution:
        """Names of the stars, pointing and focal length of a pinhole camera with its axis in the middle of the frame."""
        begin = time.perf_counter()
        inside = np.flatnonzero(stars.on_frame)
        seen = stars.take(inside)
        if len(seen) < FEWEST_STARS:
            message = (
                f"{stars.place}: {len(seen)} stars detected, at least {FEWEST_STARS} are needed: check clouds, focus "
                "and exposure"
            )
            return Solution.failed(stars, Status.TOO_FEW_STARS, message)
        try:
            sky = Sky.at(self.catalogue, no_triangles(), stars.mid_unix_s)
        except StarposError as e:
            return Solution.refused(stars, e)
        quads = quad_cache.cached(self.catalogue, self.progress)
        xy = np.stack([seen.x, seen.y], 1)
        size, near_px, window = (stars.width, stars.height), stars.rough_focal_px, stars.window
        match = identify_blind(xy, seen.sigma, *size, sky, quads, self.stages, near_px, window)
        if match is None:
            message = (
                f"{stars.place}: none of the sky fits its {len(seen)} stars at any scale (fields of {SMALLEST_DEG:g} to "
                f"{LARGEST_DEG:g} deg from corner to corner were tried): give the focal length if it is known, check "
                "clouds and exposure"
            )
            return replace(
                Solution.failed(stars, Status.NOT_IDENTIFIED, message), identify_s=time.perf_counter() - begin
            )
        camera, found = match
        field = frame_stars(camera.directions(seen.x, seen.y), seen.sigma, camera)
        answer = identified(seen, through(field, camera, window), sky, camera, found)
        return replace(answer.among(stars, inside), identify_s=time.perf_counter() - begin)
