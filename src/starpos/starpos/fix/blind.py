# SPDX-License-Identifier: Apache-2.0
"""The pointing of a frame of unknown scale and lens."""

import math
import time
from dataclasses import dataclass, replace

import numpy as np

from starpos.errors import StarposError
from starpos.fix.checks import why_noise
from starpos.fix.solution import Solution, Status, solution_of
from starpos.frames.frame import Stars
from starpos.identification import MIN_STARS, Identification, Sky, blind
from starpos.identification.blind import (
    LARGEST_DEG,
    NARROWEST_DEG,
    SMALLEST_DEG,
    STAGES,
    WIDEST_DEG,
    disc_radius_px,
    identify_blind,
    identify_fisheye,
)
from starpos.identification.quads import cached_quads
from starpos.identification.search import field_of
from starpos.instrument.camera import Camera
from starpos.progress import CpuLimit, Progress, quiet
from starpos.sky.catalogue import Catalogue

# A lens whose frame's diagonal is a smaller multiple of its focal length is no fisheye: 1.4 for 26 mm on full format.
MAX_FISHEYE_DIAGONAL = 2.2
# CPU time, s, of the search for one frame.
SEARCH_S = 20.0


@dataclass(frozen=True)
class BlindSolver:
    """Identifies frames of any scale, including fisheyes; if EXIF states a scale or a fisheye, it tries that first.

    stages, fisheye_stages: of the search; fewer are quicker.
    search_s: CPU time after which the search of a frame ends.
    """

    catalogue: Catalogue
    progress: Progress = quiet
    stages: tuple[tuple[int, float], ...] = STAGES
    fisheye_stages: tuple[int, ...] = blind.FISHEYE_STAGES
    search_s: float = SEARCH_S

    def prepare(self) -> None:
        """Load the quads, or build them."""
        cached_quads(self.catalogue, self.progress)

    def identify(self, stars: Stars) -> Solution:
        """Names of the stars, pointing, focal length and lens of a camera with its axis near the middle of the frame."""
        begin = time.perf_counter()
        inside = np.flatnonzero(stars.on_frame)
        seen = stars.select(inside)
        if len(seen) < MIN_STARS:
            message = (
                f"{stars.place}: {len(seen)} stars detected, at least {MIN_STARS} are needed: check clouds, focus "
                "and exposure"
            )
            return Solution.failed(stars, Status.TOO_FEW_STARS, message)
        if noise := why_noise(stars):
            return Solution.failed(stars, Status.NOT_IDENTIFIED, noise)
        try:
            sky = Sky.at(self.catalogue, None, stars.mid_unix_s)
        except StarposError as e:
            return Solution.refused(stars, e)
        # building them takes no time of the search
        self.prepare()
        limit = CpuLimit.of(self.search_s)
        match = self._match(seen, sky, limit)
        if match is None:
            return replace(
                Solution.failed(stars, Status.NOT_IDENTIFIED, _why(seen, self.search_s, limit)),
                identify_s=time.perf_counter() - begin,
            )
        camera, found = match
        field = field_of(camera.directions(seen.x, seen.y), seen.sigma, camera, seen.window)
        return solution_of(seen, field, sky, camera, found, begin).among(stars, inside)

    def _match(self, seen: Stars, sky: Sky, limit: CpuLimit) -> tuple[Camera, Identification] | None:
        """A camera and its identification of stars: of a pinhole, else of a fisheye, first where it looks like one."""
        quads = cached_quads(self.catalogue, self.progress)
        xy = np.stack([seen.x, seen.y], 1)
        about = xy, seen.sigma, seen.width, seen.height, sky, quads
        near_px = seen.rough_focal_px

        def by_fisheye() -> tuple[Camera, Identification] | None:
            return identify_fisheye(*about, self.fisheye_stages, near_px, limit, self.progress)

        def by_pinhole() -> tuple[Camera, Identification] | None:
            return identify_blind(*about, self.stages, near_px, seen.window, limit, self.progress)

        ways = (by_pinhole, by_fisheye)
        # stars in a disc are of a fisheye, unless EXIF states a longer lens: a vignette or a roof may shape them, too
        narrow = near_px is not None and near_px > math.hypot(seen.width, seen.height) / MAX_FISHEYE_DIAGONAL
        if seen.fisheye or (not narrow and disc_radius_px(xy, seen.width, seen.height) is not None):
            ways = (by_fisheye, by_pinhole)
        return ways[0]() or ways[1]()


def _why(seen: Stars, search_s: float, limit: CpuLimit) -> str:
    """A sentence that says why stars were not identified, and what to do."""
    tried = (
        f"fields of {SMALLEST_DEG:g} to {LARGEST_DEG:g} deg from corner to corner, fisheyes of {NARROWEST_DEG:g} to "
        f"{WIDEST_DEG:g} deg"
    )
    if limit.reached:
        what = (
            f"in {search_s:g} s of CPU no part of the sky was found to match its {len(seen)} stars at any "
            f"scale ({tried}): "
            "give more time (--search-time) or the focal length"
        )
    else:
        what = (
            f"no part of the sky matches its {len(seen)} stars at any scale ({tried}, were tried): give the "
            f"focal length if it "
            "is known, check clouds and exposure"
        )
    if disc_radius_px(np.stack([seen.x, seen.y], 1), seen.width, seen.height) is not None:
        what += "; the stars lie in a disc, as those of a fisheye do: give its focal length with --lens equidistant"
    elif seen.fisheye:
        what += "; its EXIF calls the lens a fisheye: give its focal length with --lens equidistant"
    return f"{seen.place}: {what}"
