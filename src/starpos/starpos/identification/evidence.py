# SPDX-License-Identifier: Apache-2.0
"""Evidence of a frame's stars that a pose is right, against chance; poses verified by it, and the stars they explain.

By chance the detections are random points anywhere on the frame. If the pose is right, each detection, from the brightest
down, is one of two things. It is a false star, with a probability that follows from the share of false ones before it (a
rule of succession that starts with two right and one wrong). Or it is the j-th brightest of the catalogue's stars not yet
seen, with probability 1 / ((j + 1) (j + 2)), at that star's place to within its error.

The evidence is the ratio of the two probabilities, averaged over all possible poses. Under chance its mean is 1, so it
exceeds x in at most one of x frames of random points, at whatever detection one stops (Ville's inequality) and however
the pose was found. Here only the neighbourhood of one pose is counted, by Laplace's method. That is right to a small
factor, but all other poses are left out, so the result is on the safe side: with random points it exceeds 1 in one frame
of a hundred.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from starpos.frozen import at_once
from starpos.identification._found import Identification
from starpos.identification._frame import FrameStars
from starpos.identification._screen import BrightTable
from starpos.identification._search import Anywhere, Finder
from starpos.identification.pose import MATCH_SIGMA, SMALL_STEP, STEPS, TEST_STARS, Pose
from starpos.identification.sky import Sky
from starpos.identification.triangles import SCALE_TOLERANCE, TriangleCatalogue
from starpos.sky.catalogue import Catalogue
from starpos.units import SIGMA_PER_MAD

# Extra centroid errors (px) and their prior probabilities: none, errors of the catalogue, unknown lenses.
ERRORS_PX, LOG_SHARES = np.array([0.0, 0.3, 1.0, 3.0]), np.log([0.6, 0.2, 0.1, 0.1])
# Limits on the error of the focal length's logarithm, and their probabilities.
SCALES = (0.003, 0.5), (SCALE_TOLERANCE + 0.005, 0.5)
# Probability that a frame is mirrored.
MIRRORED = 0.1
# Width of all rotations about each axis, and of the likeliest focal lengths.
WIDTH = np.append(np.full(3, np.cbrt(8 * np.pi**2)), 2 * SCALES[0][0])
# Closer detections may be the same star, so the second says nothing new.
DOUBLE_PX = 3.0
CHANCES = {"errors_px": ERRORS_PX, "log_shares": LOG_SHARES, "double_px": DOUBLE_PX}


@at_once
@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the pose.

    log_density  of a pose, per rad3 of rotation and unit of the focal length's logarithm; -inf if the pose is impossible
    width        (4,): size of the region of possible poses, rad about C's axes and in that logarithm. It limits the
                 volume of poses where the stars of a frame constrain the pose weakly.
    """

    log_density: Callable[[Pose], float]
    width: np.ndarray

    def log_density_at(self, attitude: np.ndarray, focal_px: float, mirrored: bool) -> float:
        """Logarithm of the density at a pose in its parts."""
        return self.log_density(Pose(attitude, focal_px, mirrored))


@lru_cache(maxsize=16)
def anywhere(focal_px: float, log_share: float = 0.0) -> Prior:
    """The Prior of a frame lost in space, with a focal length of about focal_px."""
    return Prior(Anywhere(focal_px, SCALES, MIRRORED, log_share), WIDTH)


def any_scale(shortest_px: float, longest_px: float, log_share: float = 0.0) -> Prior:
    """The Prior of a frame lost in space of which only a range of focal lengths (px) is known, all sizes alike."""
    logarithms = math.log(longest_px / shortest_px)

    def log_density(pose: Pose) -> float:
        parity = MIRRORED if pose.mirrored else 1 - MIRRORED
        known = shortest_px <= pose.focal_px <= longest_px
        return log_share + math.log(parity / (8 * math.pi**2 * logarithms)) if known else -math.inf

    return Prior(log_density, np.append(WIDTH[:3], logarithms))


# Minimum number of stars of an identification.
MIN_STARS = 4
# Minimum log-odds of an identification: one try identifies at most one in 1e9 frames of random points. With all further
# tries it is 1.2 in 1e9 (search.py), and up to 14 more where other focal lengths are tried (fix/solver.py).
MIN_LOG_ODDS = np.log(1e9)
ROUNDS = 3
# A star may be GATE_SIGMA of the spread from its place, plus GATE_PX; the spread is at least MIN_SPREAD_PX.
MIN_SPREAD_PX, GATE_SIGMA, GATE_PX = 0.02, 4.0, 0.2
# Number of the brightest detections that take part.
FAINTEST_FIT = 2000
# Errors of catalogue and lens, which a centroid's own error does not include.
FLOOR_PX = 0.05
# With a larger spread of residuals the lens is distorted: all stars get the same weight, or the brightest few decide.
BENT_PX = 0.3
# Closer stars make one image.
BLEND_PX = 2.5
# Number of catalogue stars that are compared with a frame: per detection, and in addition.
PER_DETECTION, MORE_STARS = 3, 50
# Distance beyond the frame at which a star still counts as on it, and from its edge within which it may be cut (px).
EDGE_PX, INSIDE_PX = 2.0, 5.0


RULES = {
    "rounds": ROUNDS,
    "fewest_stars": MIN_STARS,
    "steps": STEPS,
    "small_step": SMALL_STEP,
    "floor_px": FLOOR_PX,
    "sigma_per_mad": SIGMA_PER_MAD,
    "least_spread_px": MIN_SPREAD_PX,
    "gate_sigma": GATE_SIGMA,
    "gate_px": GATE_PX,
    "edge_px": EDGE_PX,
    "inside_px": INSIDE_PX,
    "blend_px": BLEND_PX,
    "per_detection": PER_DETECTION,
    "more_stars": MORE_STARS,
    "most_stars": FAINTEST_FIT,
    "bent_px": BENT_PX,
}
LIMITS = {
    "first_stars": (4, 5, 7),
    "match_sigma": MATCH_SIGMA,
    "log_false": math.log(0.35),
    "worth_a_fit": 4.0,
    "most_stars": 440,
    "loose_px": 1.0,
    "most_candidates": 25_000,
    "most_looked_at": 25,
    "most_looked_up": 10_000,
    "most_in_crowd": 60_000,
    "most_supported": 40,
}


@lru_cache(maxsize=4)
def finder_of(catalogue: Catalogue, triangles: TriangleCatalogue | None) -> Finder:
    """The compiled judge and search of a sky's stars at any date."""
    stars = Sky(catalogue, triangles).stars
    if triangles is None:
        return Finder(stars, None, None, RULES, CHANCES, LIMITS)
    bright = BrightTable(stars, triangles.star, triangles.rank, triangles.cell_start)
    return Finder(stars, triangles.compiled, bright, RULES, CHANCES, LIMITS)


@at_once
@dataclass(frozen=True)
class OnFrame:
    """S catalogue stars on a frame, brightest first.

    index       (S,): rows of the star catalogue
    directions  (S, 3)
    blend_px    (S,): how far fainter stars that make one image with them may move it
    """

    index: np.ndarray
    directions: np.ndarray
    blend_px: np.ndarray

    @classmethod
    def of(cls, field: FrameStars, sky: Sky, pose: Pose, most_detections: int) -> "OnFrame":
        """The stars that the field's brightest detections may be, at most `most_detections` of them."""
        found = sky.stars.on_frame(
            field,
            pose.mirrored,
            pose.attitude,
            pose.focal_px,
            sky.years,
            sky.velocity,
            EDGE_PX,
            PER_DETECTION * min(len(field), most_detections) + MORE_STARS,
            BLEND_PX,
        )
        return cls(*found)

    def rows(self, which: np.ndarray) -> "OnFrame":
        """The stars of a mask (S,)."""
        return OnFrame(self.index[which], self.directions[which], self.blend_px[which])


def verify_pose(
    field: FrameStars,
    sky: Sky,
    near_pose: Pose,
    radius_px: np.ndarray,
    prior: Prior,
    enough: float = MIN_LOG_ODDS,
) -> Identification | None:
    """Identify a frame's stars, starting from those within radius_px (N,) of their places by a pose near the right one.

    None unless the evidence is beyond doubt: log-odds of `enough`.
    """
    finder = finder_of(sky.catalogue, sky.triangles)
    judge = finder.judge(field, sky.years, sky.velocity, prior, enough)
    return judge.identified(near_pose.attitude, near_pose.focal_px, near_pose.mirrored, radius_px)


# Minimum number of catalogue stars looked for, if the frame has as many.
MIN_DUE = 8
# Minimum share of the bright detections that are identified, and of the bright stars due that are seen. One of the two is
# enough: if most stars due are seen, the other detections are false stars.
MIN_EXPLAINED, MIN_SHARE_SEEN = 0.5, 0.6


@at_once
@dataclass(frozen=True)
class Explained:
    """Counts of what an identification explains.

    explained, bright  catalogue stars among the brightest detections, and the number of these detections
    seen, due          detections among the brightest catalogue stars on the frame, and the number of these stars
    """

    explained: int
    bright: int
    seen: int
    due: int

    @property
    def enough(self) -> bool:
        """Whether the frame is explained."""
        return self.explained >= MIN_EXPLAINED * self.bright or self.seen >= MIN_SHARE_SEEN * self.due


def explained_by(found: Identification, field: FrameStars) -> Explained:
    """How much of a frame's stars an identification explains.

    As many of the brightest catalogue stars are due as bright detections are explained: where these are the brightest
    stars of the sky, nearly all are seen, however faint the frame goes; where they are chance, few are.
    """
    bright = min(len(field), TEST_STARS)
    number, seen, due = found.explains(bright, MIN_DUE)
    return Explained(number, bright, seen, due)
