# SPDX-License-Identifier: Apache-2.0
"""Identify a frame of which nothing is known, not even the scale or the lens: by quads of its brightest stars.

Scales are tried in steps so small that a pinhole's projection shows in no shape. Quads of the frame that look like
quads of the sky give poses. Those on which most agree are judged by the same evidence as any other, but every scale was
possible before. Where the focal length is roughly known, scales near it come first, which is quick. An answer that is
not sure is kept while the search goes on, in case there is a better one.

Of a fisheye, an assumed lens and focal length give directions to the stars in a part of the frame, and a pinhole that
looks there would see them like any other frame. Quads of the brightest of them give poses of the part, which are judged
by the same evidence as any other. Then the lens extends the answer to the whole frame.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, product
from typing import TypeVar

import numpy as np

from starpos import rotation
from starpos.frames.frame import Window
from starpos.identification import fisheye
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import (
    MIN_EXPLAINED,
    MIN_LOG_ODDS,
    MIN_STARS,
    Identification,
    any_scale,
    explained_by,
    verify_pose,
)
from starpos.identification.fisheye import outwards
from starpos.identification.pose import Pose, stars_at
from starpos.identification.quads import Matches, QuadCatalogue, QuadPoses, matches
from starpos.identification.search import SECOND_TRY, second_try, through
from starpos.identification.sky import Sky
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.progress import UNLIMITED, CpuLimit, Progress, quiet

# Fields from corner to corner that are tried, deg.
SMALLEST_DEG, LARGEST_DEG = 0.6, 100.0
# A focal length that is roughly known may be off by this factor. With it wider fields are tried too, as telephones have
# them: up to this many deg.
ROUGHLY, LARGEST_TOLD_DEG = 1.2, 130.0
# (number of brightest stars, their error in px)
STAGES = (10, 0.4), (15, 0.4), (21, 0.4), (12, 2.0)
# A step of the focal length is at most this; and so small that it changes the shape of no quad by more than that.
LARGEST_STEP, BENT = 0.1, 0.003
# Poses judged in each stage: the ones with most votes.
MAX_JUDGED = 40
# Log-odds of an answer that ends the search though most bright detections are not its stars.
SURE = 6 * MIN_LOG_ODDS
# Threads of a search; how many focal lengths are tried between two looks at the time.
THREADS, AT_ONCE = 2, 8
Item = TypeVar("Item")
Result = TypeVar("Result")


def identify_blind(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    width: int,
    height: int,
    sky: Sky,
    quads: QuadCatalogue,
    stages: Sequence[tuple[int, float]] = STAGES,
    near_px: float | None = None,
    window: Window | None = None,
    limit: CpuLimit = UNLIMITED,
    progress: Progress = quiet,
) -> tuple[Camera, Identification] | None:
    """Identify stars at pixels xy (N, 2), brightest first, of a pinhole camera of unknown focal length.

    near_px: a likely focal length, with which the search begins; it has half of the probability.
    window: the part of the frame that shows something, as `Stars` has it; None: all of it.
    limit: CPU time after which the search ends; what it has found until then counts.

    Returns the camera, whose focal length `Identification.focal_scale` refines, and the identification; None without
    an identification beyond doubt.
    """
    if len(xy) < MIN_STARS:
        return None
    half_diagonal_px = np.hypot(width, height) / 2
    told, shortest, longest = (
        half_diagonal_px / np.tan(np.radians(d / 2)) for d in (LARGEST_TOLD_DEG, LARGEST_DEG, SMALLEST_DEG)
    )
    spans = [(shortest, longest)]
    if near_px is not None and told < near_px < longest:
        spans.insert(0, (max(told, near_px / ROUGHLY), min(longest, near_px * ROUGHLY)))
    camera = Camera.from_focal(width, height, shortest)
    frame = stars_at(camera, xy, sigma_px)
    # stars that are searched, their share of the frame's area, and the log-odds that they need
    tries = [(np.arange(len(xy)), 1.0, MIN_LOG_ODDS)]
    if (even := second_try(through(frame, camera, window))) is not None:
        # only one star is taken from a cell, which leaves less area for the others
        tries.append((even, 0.5, MIN_LOG_ODDS + SECOND_TRY))
    # the quick stages of all tries come before the slow ones of any
    work = [
        (t, stage, span)
        for k in range(len(stages))
        for t in tries
        for stage, span in product(stages_of(stages, len(t[0]))[k : k + 1], spans)
    ]
    best: tuple[Camera, Identification] | None = None
    for k, ((rows, share, enough), (stars, error_px), (low, high)) in enumerate(work):
        progress("searching all scales", k / len(work))
        prior = any_scale(low, high, -math.log(len(spans)))
        for pose, radius_px in _poses(frame.of_rows(rows), sky, quads, (low, high), stars, error_px, limit):
            camera = Camera.from_focal(width, height, pose.focal_px)
            seen = through(stars_at(camera, xy[rows], sigma_px[rows]), camera, window)
            seen = seen.but(area_px2=share * seen.area_px2)
            found = verify_pose(seen, sky, pose, radius_px, prior, enough)
            if found and (best is None or found.log_odds > best[1].log_odds):
                best = camera, found.but(star=rows[found.star])
                if is_sure(found, seen):
                    return best
        if limit.reached:
            break
    return best


def stages_of(stages: Sequence[tuple[int, float]], stars: int) -> list[tuple[int, float]]:
    """The stages for a frame with this number of stars, without duplicates."""
    return list(dict.fromkeys((min(number, stars), error_px) for number, error_px in stages))


def is_sure(found: Identification, field: FrameStars) -> bool:
    """Whether no better answer needs to be looked for."""
    explained = explained_by(found, field)
    return explained.explained >= MIN_EXPLAINED * explained.bright or (
        explained.enough and found.log_odds >= SURE
    )


def _poses(
    field: FrameStars,
    sky: Sky,
    quads: QuadCatalogue,
    focal_range: tuple[float, float],
    stars: int,
    error_px: float,
    limit: CpuLimit,
) -> Iterator[tuple[Pose, np.ndarray]]:
    """Yield poses, those first on which most quads agree, and the distance (N,) px by which each star may be off."""
    half_diagonal_px = float(np.hypot(*field.half))

    def alike_at(scale: tuple[float, float]) -> Matches:
        return matches(field, quads, stars, error_px, *scale)

    alike = _side_by_side(alike_at, list(focal_lengths(half_diagonal_px, *focal_range)), limit)
    if limit.reached:
        return
    found = QuadPoses.of(field, sky, alike, error_px, focal_range)
    for k in found.most_agreed(half_diagonal_px, MAX_JUDGED):
        if limit.reached:
            return
        yield found[k], found.radius_px(field, k, error_px)


def _side_by_side(work: Callable[[Item], Result], items: Sequence[Item], limit: CpuLimit) -> list[Result]:
    """The results of some work on items, in their order, of all if the limit is not reached.

    Compiled loops and numpy's run side by side.
    """
    # slow to import, and seldom needed
    from concurrent.futures import ThreadPoolExecutor

    def some(first: int) -> list[Result]:
        return [] if limit.reached else [work(item) for item in items[first : first + AT_ONCE]]

    with ThreadPoolExecutor(THREADS) as threads:
        return list(chain.from_iterable(threads.map(some, range(0, len(items), AT_ONCE))))


def focal_lengths(half_diagonal_px: float, shortest: float, longest: float) -> Iterator[tuple[float, float]]:
    """Yield focal lengths (px) and by which share the true one may differ from each."""
    focal = shortest
    while focal < longest:
        step = min(LARGEST_STEP, BENT / (half_diagonal_px / focal) ** 2)
        yield focal * (1 + step), step
        focal *= (1 + step) ** 2


# What lenses do, as coefficients k1 .. k4 of the angle's powers: r = f t, 2 f sin(t / 2), 2 f tan(t / 2).
LENSES = (
    (0.0, 0.0, 0.0, 0.0),
    (-1 / 24, 1 / 1920, -1 / 322560, 0.0),
    (1 / 12, 1 / 120, 17 / 20160, 31 / 362880),
)
# Diameters of pictures that are tried, deg.
NARROWEST_DEG, WIDEST_DEG = 60.0, 200.0
# A step of the focal length either way: what it changes the shape of a part by is within the errors.
FISHEYE_STEP = 0.02
# Frames are scaled to this radius of the picture (px); the error of stars (px) allows for the assumed lens.
RADIUS_PX, FISHEYE_ERROR_PX = 500.0, 0.6
# The brightest stars of a part that make quads, in turn; and how many poses of each part are judged.
FISHEYE_STAGES, FISHEYE_JUDGED = (12, 18), 60
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


def identify_fisheye(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    width: int,
    height: int,
    sky: Sky,
    quads: QuadCatalogue,
    stages: Sequence[int] = FISHEYE_STAGES,
    near_px: float | None = None,
    limit: CpuLimit = UNLIMITED,
    progress: Progress = quiet,
) -> tuple[Camera, Identification] | None:
    """Identify stars at pixels xy (N, 2), brightest first, with errors (N,) px, of a fisheye with its axis in the middle.

    stages: numbers of the brightest stars of a part that make quads.  near_px: a focal length that it may have.
    limit: CPU time after which the search ends.

    Returns a camera that is near the true one, and the identification; None without one beyond doubt.
    """
    if len(xy) < MIN_STARS:
        return None
    disc_px = disc_radius_px(xy, width, height)
    radius_px = disc_px or math.hypot(width, height) / 2

    def seen_by(focal_px: float, lens: tuple[float, ...]) -> fisheye.WideField:
        """The stars as a lens sees them, its axis in the middle of the frame."""
        camera = replace(Camera.from_focal(width, height, focal_px, EQUIDISTANT), distortion=lens)
        return fisheye.WideField(camera.directions(*xy.T), sigma_px, camera)

    spans = [_focal_range(lens, radius_px, near_px) for lens in LENSES]
    wholes = [
        seen_by(focal_px, lens)
        for lens, (shortest, longest) in zip(LENSES, spans, strict=True)
        for focal_px in np.geomspace(
            shortest, longest, math.ceil(math.log(longest / shortest) / (2 * FISHEYE_STEP)) + 1
        ).tolist()
    ]
    prior = any_scale(
        0.95 * min(low for low, _ in spans) * RADIUS_PX / radius_px,
        1.05 * max(high for _, high in spans) * RADIUS_PX / radius_px,
    )
    # the evidence that a frame needs, raised for the number of parts and lenses tried
    need = fisheye.enough(len(_TURNS) * len(LENSES)) + SECOND_TRY
    parts: list[list[fisheye.Part]] = []
    work = [(stars, k) for stars in stages for k in range(len(_TURNS))]
    best: tuple[Camera, Identification] | None = None
    for done, (stars, k) in enumerate(work):
        progress("searching fisheyes", done / len(work))
        if k == len(parts):
            parts.append(_parts(wholes, radius_px, _TURNS[k], limit))
        guesses = _guesses(parts[k], stars, sky, quads, limit)
        for guess, poses, row in _most_agreed(guesses):
            if limit.reached:
                return best
            pose, radius = poses[row], poses.radius_px(guess.field, row, FISHEYE_ERROR_PX)
            found = verify_pose(guess.field, sky, pose, radius, prior, need)
            if found is None or (best is not None and found.log_odds <= best[1].log_odds):
                continue
            whole = outwards(sky, guess, found)
            if whole is not None and whole[2]:
                return whole[:2]
            # off the middle, a wrong lens would turn the axis elsewhere
            if whole is not None and k == 0:
                best = whole[:2]
    return best


def _focal_range(lens: tuple[float, ...], radius_px: float, near_px: float | None) -> tuple[float, float]:
    """The focal lengths (px) with which a lens makes a picture of that radius; only ones near near_px, if given."""
    angles = (math.radians(deg / 2) for deg in (WIDEST_DEG, NARROWEST_DEG))
    low, high = (radius_px / (t * (1 + sum(k * t ** (2 * n) for n, k in enumerate(lens, 1)))) for t in angles)
    if near_px is None or not low < near_px < high:
        return low, high
    return max(low, near_px / ROUGHLY), min(high, near_px * ROUGHLY)


def _parts(
    wholes: Sequence[fisheye.WideField], radius_px: float, turn: np.ndarray, limit: CpuLimit
) -> list[fisheye.Part]:
    """A part of a picture of that radius as each lens sees it, as if it had RADIUS_PX; where sky and stars are enough."""
    shrink = radius_px / RADIUS_PX

    def part_of(whole: fisheye.WideField) -> fisheye.Part | None:
        width, height = (round(size / shrink) for size in (whole.camera.width, whole.camera.height))
        pinhole = fisheye.pinhole_of(Camera.from_focal(width, height, whole.camera.fx / shrink, EQUIDISTANT))
        share = _share_seen(whole.camera, radius_px, pinhole, turn)
        if share < MIN_SEEN:
            return None
        part = fisheye.part_at(whole, pinhole, turn, shrink)
        enough = len(part.field) >= MIN_STARS
        return replace(part, field=part.field.but(area_px2=share * part.field.area_px2)) if enough else None

    return [part for part in _side_by_side(part_of, wholes, limit) if part is not None]


def _guesses(
    parts: Sequence[fisheye.Part], stars: int, sky: Sky, quads: QuadCatalogue, limit: CpuLimit
) -> list[tuple[fisheye.Part, QuadPoses]]:
    """The poses that the brightest stars of each part give, where there are any."""

    def poses_of(part: fisheye.Part) -> QuadPoses:
        field = part.field
        alike = matches(field, quads, min(stars, len(field)), FISHEYE_ERROR_PX, field.focal_px, FISHEYE_STEP)
        scales = field.focal_px * (1 - FISHEYE_STEP), field.focal_px * (1 + FISHEYE_STEP)
        return QuadPoses.of(field, sky, [alike], FISHEYE_ERROR_PX, scales)

    found = _side_by_side(poses_of, parts, limit)
    return [(part, poses) for part, poses in zip(parts, found, strict=False) if len(poses)]


def _share_seen(camera: Camera, radius_px: float, pinhole: Camera, turn: np.ndarray) -> float:
    """The share of a part's frame that lies in a camera's picture of that radius."""
    x, y = np.meshgrid(*(np.linspace(0, size - 1, GRID) for size in (pinhole.width, pinhole.height)))
    xy = camera.project(pinhole.directions(x.ravel(), y.ravel()) @ turn)
    with np.errstate(invalid="ignore"):
        on = ((xy > -0.5) & (xy < [camera.width - 0.5, camera.height - 0.5])).all(1)
        on &= np.hypot(*(xy - [camera.cx, camera.cy]).T) < radius_px
    return float(on.mean())


def _most_agreed(
    guesses: Sequence[tuple[fisheye.Part, QuadPoses]],
) -> Iterator[tuple[fisheye.Part, QuadPoses, int]]:
    """Yield parts, their poses and a row of these, those with most votes of all parts first."""
    if not guesses:
        return
    first = np.cumsum([0, *(len(poses) for _, poses in guesses)])
    half_diagonal_px = float(np.hypot(*guesses[0][0].field.half))
    for k in QuadPoses.together([poses for _, poses in guesses]).most_agreed(
        half_diagonal_px, FISHEYE_JUDGED
    ):
        owner = int(np.searchsorted(first, k, side="right")) - 1
        yield *guesses[owner], k - int(first[owner])
