# SPDX-License-Identifier: Apache-2.0
"""Identify a fisheye's frame with unknown lens model and scale, from parts of the frame outwards.

An assumed lens and focal length give directions to the stars in a part of the frame, and a pinhole that looks there
would see them like any other frame. Quads of the brightest of them give poses of the part, which are judged by the
same evidence as any other. Then the lens extends the answer to the whole frame.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.budget import ENDLESS, Budget
from starpos.identification import wide
from starpos.identification._frame import FrameStars
from starpos.identification.blind import ROUGHLY
from starpos.identification.evidence import any_scale
from starpos.identification.full import MIN_STARS, Identification, verify_pose
from starpos.identification.outwards import outwards
from starpos.identification.pose import Poses
from starpos.identification.quad_poses import Matches, QuadPoses, most_agreed
from starpos.identification.quads import QuadCatalogue
from starpos.identification.search import SECOND_TRY
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera
from starpos.instrument.lens import EQUIDISTANT
from starpos.progress import Progress, quiet

# What lenses do, as coefficients k1 .. k4 of the angle's powers: r = f t, 2 f sin(t / 2), 2 f tan(t / 2).
LENSES = (
    (0.0, 0.0, 0.0, 0.0),
    (-1 / 24, 1 / 1920, -1 / 322560, 0.0),
    (1 / 12, 1 / 120, 17 / 20160, 31 / 362880),
)
# Diameters of pictures that are tried, deg.
NARROWEST_DEG, WIDEST_DEG = 60.0, 200.0
# A step of the focal length either way: what it changes the shape of a part by is within the errors.
STEP = 0.02
# Frames are scaled to this radius of the picture (px); the error of stars (px) allows for the assumed lens.
RADIUS_PX, ERROR_PX = 500.0, 0.6
# The brightest stars of a part that make quads, in turn; and how many poses of each part are judged.
STAGES, MAX_JUDGED = (12, 18), 60
# Parts look at the middle, and in AROUND directions at OFF_RAD from it. MIN_SEEN is the minimum share of a part
# that shows sky, counted on a grid of GRID x GRID points.
OFF_RAD, AROUND, MIN_SEEN, GRID = math.radians(40), 6, 0.6, 9
_TURNS = [
    np.eye(3),
    *(
        rotation.from_vector(OFF_RAD * np.array([math.cos(a), math.sin(a), 0.0]))
        for a in 2 * np.pi * np.arange(AROUND) / AROUND
    ),
]
# Stars lie in a disc if chance would leave the corners empty as seldom as this, and these have such a share of the frame.
LOG_CHANCE, MIN_OUTSIDE = math.log(1e-3), 0.1
# The radius of a picture over the frame's shorter side is at least this.
MIN_RADIUS = 0.25
# Stars outside the disc, over all: lettering, hot pixels.
MAX_OUTSIDE = 0.03


def disc_radius_px(xy: np.ndarray, width: int, height: int) -> float | None:
    """The radius of a disc about a frame's middle that contains its stars xy (N, 2), if the corners are empty; or None.

    It is the radius of the stars: the picture of a fisheye may reach farther.
    """
    if len(xy) < MIN_STARS:
        return None
    away = np.sort(np.hypot(*(xy - np.array([width - 1, height - 1]) / 2).T))
    outside = int(MAX_OUTSIDE * len(away))
    radius_px = float(away[-1 - outside])
    beyond = _share_beyond(radius_px, width, height)
    inside = len(away) - outside
    ways = math.lgamma(len(away) + 1) - math.lgamma(outside + 1) - math.lgamma(inside + 1)
    by_chance = beyond > MIN_OUTSIDE and ways + inside * math.log1p(-beyond) > LOG_CHANCE
    round_enough = beyond > MIN_OUTSIDE and radius_px > MIN_RADIUS * min(width, height)
    return radius_px if round_enough and not by_chance else None


def _share_beyond(radius_px: float, width: int, height: int) -> float:
    """The share of a frame's area that is farther from its middle."""
    x, y = (
        np.arange(n + 0.5, size, n) - size / 2 for n, size in ((width / 64, width), (height / 64, height))
    )
    return float(np.mean(x[:, None] ** 2 + y**2 > radius_px**2))


@dataclass(frozen=True)
class _Picture:
    """N stars at pixels xy (N, 2), with errors (N,) px, of a frame of that size, and the radius of its picture in px."""

    xy: np.ndarray
    sigma_px: np.ndarray
    width: int
    height: int
    radius_px: float

    def seen_by(self, focal_px: float, lens: tuple[float, ...]) -> wide.WideField:
        """The stars as a lens sees them, its axis in the middle of the frame."""
        camera = replace(
            Camera.from_focal(self.width, self.height, focal_px, EQUIDISTANT), distortion=tuple(lens)
        )
        return wide.WideField(camera.directions(*self.xy.T), self.sigma_px, camera)


@dataclass(frozen=True)
class _Guess:
    """A supposed lens, a part of the frame as it sees it, the stars of that part, and poses of it."""

    focal_px: float
    lens: tuple[float, ...]
    part: wide.Part
    field: FrameStars
    found: QuadPoses


def identify_fisheye(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    width: int,
    height: int,
    sky: Sky,
    quads: QuadCatalogue,
    stages: Sequence[int] = STAGES,
    near_px: float | None = None,
    budget: Budget = ENDLESS,
    progress: Progress = quiet,
) -> tuple[Camera, Identification] | None:
    """Identify stars at pixels xy (N, 2), brightest first, with errors (N,) px, of a fisheye with its axis in the middle.

    stages: numbers of the brightest stars of a part that make quads.  near_px: a focal length that it may have.
    budget: CPU time after which the search ends.

    Returns a camera that is near the true one, and the identification; None without one beyond doubt.
    """
    if len(xy) < MIN_STARS:
        return None
    disc_px = disc_radius_px(xy, width, height)
    radius_px = disc_px or math.hypot(width, height) / 2
    picture = _Picture(xy, sigma_px, width, height, radius_px)
    spans = [_focal_range(lens, radius_px, near_px) for lens in LENSES]
    prior = any_scale(
        0.95 * min(low for low, _ in spans) * RADIUS_PX / radius_px,
        1.05 * max(high for _, high in spans) * RADIUS_PX / radius_px,
    )
    # the evidence that a frame needs, raised for the number of parts and lenses tried
    need = wide.enough(len(_TURNS) * len(LENSES)) + SECOND_TRY
    work = [(stars, k) for stars in stages for k in range(len(_TURNS))]
    best: tuple[Camera, Identification] | None = None
    for done, (stars, k) in enumerate(work):
        progress("searching fisheyes", done / len(work))
        guesses = list(_guesses(picture, spans, _TURNS[k], stars, sky, quads, budget))
        for guess, row in _most_agreed(guesses):
            if budget.spent:
                return best
            pose, radius = guess.found.poses[row], guess.found.radius_px(guess.field, row, ERROR_PX)
            found = verify_pose(guess.field, sky, pose, radius, prior, need)
            if found is None or (best is not None and found.log_odds <= best[1].log_odds):
                continue
            whole = outwards(picture.seen_by(guess.focal_px, guess.lens), sky, guess.part, found)
            if whole is not None and whole.borne_out:
                return whole.camera, whole.found
            # off the middle, a wrong lens would turn the axis elsewhere
            if whole is not None and k == 0:
                best = whole.camera, whole.found
    return best


def _focal_range(lens: tuple[float, ...], radius_px: float, near_px: float | None) -> tuple[float, float]:
    """The focal lengths (px) with which a lens makes a picture of that radius; only ones near near_px, if given."""
    angles = (math.radians(deg / 2) for deg in (WIDEST_DEG, NARROWEST_DEG))
    low, high = (radius_px / (t * (1 + sum(k * t ** (2 * n) for n, k in enumerate(lens, 1)))) for t in angles)
    if near_px is None or not low < near_px < high:
        return low, high
    return max(low, near_px / ROUGHLY), min(high, near_px * ROUGHLY)


def _guesses(
    picture: _Picture,
    spans: Sequence[tuple[float, float]],
    turn: np.ndarray,
    stars: int,
    sky: Sky,
    quads: QuadCatalogue,
    budget: Budget,
) -> Iterator[_Guess]:
    """Yield what each lens and focal length makes of a part of the picture."""
    for lens, (shortest, longest) in zip(LENSES, spans, strict=True):
        for focal_px in np.geomspace(
            shortest, longest, math.ceil(math.log(longest / shortest) / (2 * STEP)) + 1
        ):
            if budget.spent:
                return
            part, field = _part(picture, float(focal_px), lens, turn)
            if field is None or len(field) < MIN_STARS:
                continue
            matches = Matches.of(field, quads, min(stars, len(field)), ERROR_PX, field.focal_px, STEP)
            scales = field.focal_px * (1 - STEP), field.focal_px * (1 + STEP)
            found = QuadPoses.of(field, sky, matches, ERROR_PX, scales)
            if len(found.poses):
                yield _Guess(float(focal_px), lens, part, field, found)


def _part(
    picture: _Picture, focal_px: float, lens: tuple[float, ...], turn: np.ndarray
) -> tuple[wide.Part, FrameStars | None]:
    """A part of the picture and its stars, as if the picture had RADIUS_PX; None where too little of it shows sky."""
    seen, shrink = picture.seen_by(focal_px, lens), picture.radius_px / RADIUS_PX
    width, height = (round(size / shrink) for size in (picture.width, picture.height))
    pinhole = wide.pinhole_of(Camera.from_focal(width, height, focal_px / shrink, EQUIDISTANT))
    part = wide.part_at(replace(seen, sigma_px=seen.sigma_px / shrink), pinhole, turn)
    share = _share_seen(picture, seen.camera, pinhole, turn)
    if share < MIN_SEEN:
        return part, None
    return part, part.field.but(area_px2=share * part.field.area_px2)


def _share_seen(picture: _Picture, camera: Camera, pinhole: Camera, turn: np.ndarray) -> float:
    """The share of a part's frame that lies in the picture."""
    x, y = np.meshgrid(*(np.linspace(0, size - 1, GRID) for size in (pinhole.width, pinhole.height)))
    xy = camera.project(pinhole.directions(x.ravel(), y.ravel()) @ turn)
    with np.errstate(invalid="ignore"):
        on = ((xy > -0.5) & (xy < [picture.width - 0.5, picture.height - 0.5])).all(1)
        on &= np.hypot(*(xy - [camera.cx, camera.cy]).T) < picture.radius_px
    return float(on.mean())


def _most_agreed(guesses: Sequence[_Guess]) -> Iterator[tuple[_Guess, int]]:
    """Yield guesses and rows of their poses, those with most votes of all guesses first."""
    if not guesses:
        return
    poses = Poses(
        *(
            np.concatenate([getattr(g.found.poses, name) for g in guesses])
            for name in ("attitude", "focal_px", "mirrored")
        )
    )
    first = np.cumsum([0, *(len(g.found.poses) for g in guesses)])
    half_diagonal_px = float(np.hypot(*guesses[0].field.half))
    for k in most_agreed(poses, half_diagonal_px, MAX_JUDGED):
        owner = int(np.searchsorted(first, k, side="right")) - 1
        yield guesses[owner], k - int(first[owner])
