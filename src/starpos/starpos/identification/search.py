# SPDX-License-Identifier: Apache-2.0
"""The search: priors first, then lost in space, from few bright stars to more, from good centroids to poor ones.

If too few stars are detected to decide, a second look at the frame itself searches for light where fainter stars should
be. A pose that its stars make likely, but not likely enough, says where the catalogue's other stars are. Each of these
places is compared with those around it, where a star is as likely to be if the pose is wrong. The evidence is the ratio
of the probabilities of that comparison. So its mean is at most 1 if the pose is wrong, for any noise of the frame. It
looks only where nothing was detected, so it multiplies with the evidence of the detections.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import chain

import numpy as np

from starpos.errors import InstrumentError
from starpos.frames.frame import Window
from starpos.identification import fisheye
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import (
    MIN_LOG_ODDS,
    MIN_STARS,
    Identification,
    OnFrame,
    anywhere,
    finder_of,
    verify_pose,
)
from starpos.identification.pose import CROWD_STARS, TEST_STARS, Pose, stars_at
from starpos.identification.prior import AimPrior, PlumbPrior, PointingPrior
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera

# (number of brightest stars, their error in px); the last stages are for lenses with distortion.
STAGES = (5, 0.3), (7, 0.3), (10, 0.3), (14, 0.3), (20, 0.3), (9, 2.5), (8, 6.0)
# The share of the probability that priors have, and a header's pointing with or without others.
NEAR, AIMED = 0.5, 0.9

# Triangles of the brightest stars, and the error in px, where a crowd of them is false.
CROWD_STAGES = (60, 0.3), (140, 0.1)
# Cells along each side of a frame, of each of which the brightest star is taken if this leaves less than that share of
# the brightest: else these are spread evenly already. Half of the cells decide. Such a second try needs more evidence.
CELLS, MAX_EVEN, SECOND_TRY = 10, 0.65, math.log(10)

Priors = Sequence[PointingPrior | PlumbPrior | AimPrior]
Stages = Sequence[tuple[int, float]]


def field_of(
    directions: np.ndarray, sigma_px: np.ndarray, camera: Camera, window: Window | None = None
) -> FrameStars | fisheye.WideField:
    """The stars in directions (N, 3) in C, errors (N,) px, as `identify` takes them from this camera.

    window: the part of the frame that shows something, as `Stars` has it.
    """
    if fisheye.is_wide(camera):
        return fisheye.WideField(directions, sigma_px, camera)
    return through(stars_at(camera, directions, sigma_px), camera, window)


def through(field: FrameStars, camera: Camera, window: Window | None) -> FrameStars:
    """The field of a camera's frame of which only a window shows something, if it has one."""
    if window is None:
        return field
    left, top, right, bottom = window
    # a lens bends the sides
    x, y = np.meshgrid(np.linspace(left, right, 3) - 0.5, np.linspace(top, bottom, 3) - 0.5)
    try:
        v = camera.directions(x.ravel(), y.ravel())
    except InstrumentError:
        # the lens is known where stars are, not at every side: as if all of the frame showed something
        return field
    xy = v[:, :2] / v[:, 2:] * camera.fx
    low, high = xy.min(0), xy.max(0)
    # where the window ends with the frame, the field ends where it did
    low[[left <= 0, top <= 0]] = -np.inf
    high[[right >= camera.width, bottom >= camera.height]] = np.inf
    share = (right - left) * (bottom - top) / (camera.width * camera.height)
    return field.within(low, high, share)


def identify(field: FrameStars | fisheye.WideField, sky: Sky, priors: Priors = ()) -> Identification | None:
    """Identify the stars of a frame, refraction removed; the focal length may be off by SCALE_TOLERANCE.

    priors: where to look first.  None if no part of the sky fits beyond doubt.
    """
    if isinstance(field, fisheye.WideField):
        return _by_parts(field, sky, priors, identify)
    return next(identifications(field, sky, priors), None)


def identifications(
    field: FrameStars, sky: Sky, priors: Priors, enough: float = MIN_LOG_ODDS
) -> Iterator[Identification]:
    """Identifications of a frame in the order in which they are tried.

    First all of `near_or_lost`, then, in any order, those for a crowd of false stars among the brightest. Then
    both for evenly spread stars, if the brightest are not spread evenly.
    """
    if len(field) < MIN_STARS:
        return iter(())
    # not one generator for all: to end one in the middle takes as long as a look at the sky's triangles
    return chain(
        near_or_lost(field, sky, priors, STAGES, enough), _crowded_or_uneven(field, sky, priors, enough)
    )


def _crowded_or_uneven(
    field: FrameStars, sky: Sky, priors: Priors, enough: float
) -> Iterator[Identification]:
    """Yield what `identifications` does after `near_or_lost`."""
    yield from _crowded(field, sky, priors, enough, CROWD_STARS)
    rows = second_try(field)
    # only one star is taken from a cell, which leaves less area for the others
    left_px2 = field.area_px2 - 4 * float(field.half.prod()) / 2
    if rows is not None and left_px2 > 0:
        even, enough = field.of_rows(rows).but(area_px2=left_px2), enough + SECOND_TRY
        for found in chain(
            near_or_lost(even, sky, (), STAGES, enough), _crowded(even, sky, (), enough, CELLS**2 // 2)
        ):
            yield found.but(star=rows[found.star])


def _crowded(
    field: FrameStars, sky: Sky, priors: Priors, enough: float, crowd: int
) -> Iterator[Identification]:
    """Yield what the `crowd` brightest stars of a field show if nearly all of them are false."""
    # a second stage is for more stars
    stages = CROWD_STAGES[: 1 + (len(field) > CROWD_STAGES[0][0])]
    crowded = field.but(tested=crowd)
    yield from near_or_lost(crowded, sky, priors, stages, enough, crowded=True)


def second_try(field: FrameStars) -> np.ndarray | None:
    """Rows of the stars that are tried where the brightest crowd in few cells; None where they are spread already."""
    rows = evenly_spread(field)
    uneven = np.count_nonzero(rows < TEST_STARS) < MAX_EVEN * min(len(field), TEST_STARS)
    return rows if uneven and len(rows) >= MIN_STARS else None


def evenly_spread(field: FrameStars) -> np.ndarray:
    """Rows of the brightest star of each of CELLS x CELLS cells of a field, brightest first.

    The lights of a town, a trail or a line of text lie in few cells.
    """
    place = 0.5 + 0.5 * (field.xy[0] - field.middle) / field.half
    column, row = np.clip((CELLS * place).astype(int), 0, CELLS - 1).T
    return np.sort(np.unique(CELLS * row + column, return_index=True)[1])


def near_or_lost(
    field: FrameStars,
    sky: Sky,
    priors: Priors,
    stages: Stages,
    enough: float = MIN_LOG_ODDS,
    crowded: bool = False,
) -> Iterator[Identification]:
    """Identifications with log-odds of `enough`: by the priors, then lost in space by `stages`.

    The priors have the share NEAR or AIMED of the probability, if there are any.
    crowded: only triangles that others support are looked at, but all of those.
    """
    if not priors:
        return _lost(field, sky, 0.0, enough, stages, crowded)
    return _near_or_lost(field, sky, priors, stages, enough, crowded)


def _near_or_lost(
    field: FrameStars, sky: Sky, priors: Priors, stages: Stages, enough: float, crowded: bool
) -> Iterator[Identification]:
    """Yield what the priors identify, and then, where that is asked for, what is identified without them."""
    yield from _near(field, sky, priors, enough)
    yield from _lost(field, sky, math.log(1 - _share(priors)), enough, stages, crowded)


def _lost(
    field: FrameStars, sky: Sky, log_share: float, enough: float, stages: Stages, crowded: bool
) -> Iterator[Identification]:
    """Identifications lost in space, which has that share of the probability."""
    if sky.triangles is None:
        return iter(())
    prior, finder = anywhere(field.focal_px, log_share), finder_of(sky.catalogue, sky.triangles)
    return finder.lost(field, sky.years, sky.velocity, prior, enough, stages, crowded)


def identify_near(field: FrameStars | fisheye.WideField, sky: Sky, priors: Priors) -> Identification | None:
    """What the priors alone identify, such as a pose that is known already; nothing is searched elsewhere."""
    if isinstance(field, fisheye.WideField):
        return _by_parts(field, sky, priors, identify_near)
    if len(field) < MIN_STARS:
        return None
    tries = (_near(stars, sky, priors, MIN_LOG_ODDS) for stars in (field, field.but(tested=CROWD_STARS)))
    return next(chain.from_iterable(tries), None)


def _share(priors: Priors) -> float:
    return AIMED if any(isinstance(prior, AimPrior) for prior in priors) else NEAR


def _near(field: FrameStars, sky: Sky, priors: Priors, enough: float) -> Iterator[Identification]:
    """Yield what is identified by the priors."""
    log_share = math.log(_share(priors) / max(len(priors), 1))
    for prior in priors:
        for pose, radius_px, known in prior.attempts(field, sky, log_share):
            if found := verify_pose(field, sky, pose, radius_px, known, enough):
                yield found


def _by_parts(
    field: fisheye.WideField,
    sky: Sky,
    priors: Priors,
    identified: Callable[[FrameStars, Sky, Priors], Identification | None],
) -> Identification | None:
    """Identify a part of a fisheye's frame, then all of it."""
    parts = fisheye.parts(field)
    for part in parts:
        found = identified(part.field, sky, part.turned(priors))
        if found and found.log_odds >= fisheye.enough(len(parts)):
            return fisheye.everywhere(sky, part, found)
    return None


# What a frame shows at pixels x, y (N,), in sigma of a normal distribution by rank, and the SNR; NaN where it cannot say.
Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
# Log-odds from which a pose is looked at, and those that accept it with what the look finds. For random points the
# largest evidence of the detections exceeds y in 1 of y frames. So its product with the look's exceeds x in
# (1 + log(x / y)) / x of the frames, with y the evidence from which one looks: 0.1 in 1e9 frames. The first try adds 1 in
# 1e9, the evenly spread stars (SECOND_TRY in search.py) 0.1: all tries with one list of stars are wrong in 1.2 in 1e9.
MIN_LOG_ODDS_TO_LOOK, MIN_LOG_ODDS_WITH_LOOK = 5.0, 26.2
MAX_LOOKS = 20
# Places nearer to a detection add no information; places nearer to a brighter catalogue star show that star's light.
DETECTED_PX, NEAR_PX = 8.0, 6.0
# Brightness of stars over the prediction from identified ones (common to all), probability that a star is missing, and
# maximum and minimum expected signal in sigma. Brighter detections add no evidence; fainter stars are not looked for.
BRIGHTNESS, MISSING, HIGHEST, LOWEST = np.array([0.25, 0.5, 0.8, 1.2]), 0.25, 2.5, 0.5


def second_look(
    field: FrameStars, sky: Sky, priors: Priors, camera: Camera, look: Look
) -> Identification | None:
    """Identify a frame whose stars are too few, by the light at the places of others.

    field, priors  as `identify` takes them; the field is in the camera's pixels, without refraction
    """
    seen: set[tuple[bytes, bytes]] = set()
    for found in near_or_lost(field, sky, priors, STAGES, MIN_LOG_ODDS_TO_LOOK):
        pairs = found.star.tobytes(), found.catalogue.tobytes()
        if pairs in seen:
            continue
        seen.add(pairs)
        log_odds = found.log_odds + _log_ratio(field, sky, camera, found, look)
        if log_odds >= MIN_LOG_ODDS_WITH_LOOK:
            return found.but(log_odds=log_odds)
        if len(seen) == MAX_LOOKS:
            break
    return None


def _log_ratio(field: FrameStars, sky: Sky, camera: Camera, found: Identification, look: Look) -> float:
    """The logarithm of the evidence for an identification by what was not detected."""
    pose = Pose.of(field, found)
    due = OnFrame.of(field, sky, pose, TEST_STARS)
    xy, detected = pose.project(due.directions), field.xy[int(found.mirrored)]
    alone = np.linalg.norm(xy[:, None] - detected, axis=2).min(1) > DETECTED_PX
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    # rows are sorted: the brighter ones come first
    alone &= ~np.tril(apart < NEAR_PX, -1).any(1)
    _, snr = look(*_pixels(sky.directions(found.catalogue), camera, found))
    lights = (snr * 10 ** (0.4 * sky.catalogue.vmag(found.catalogue)))[~np.isnan(snr)]
    light = np.median(lights) if len(lights) else 0.0
    expected = light * 10 ** (-0.4 * sky.catalogue.vmag(due.index))
    rows = np.flatnonzero(alone & (expected * BRIGHTNESS.max() > LOWEST))
    height, _ = look(*_pixels(due.directions[rows], camera, found))
    said = ~np.isnan(height)
    return log_ratio(height[said], expected[rows[said]])


def log_ratio(height: np.ndarray, expected: np.ndarray) -> float:
    """The logarithm of how much likelier heights (N,), in sigma, are with stars of the expected heights than without."""
    high = np.minimum(BRIGHTNESS[:, None] * expected, HIGHEST)
    ratio = MISSING + (1 - MISSING) * np.exp(high * height - high**2 / 2)
    return float(np.logaddexp.reduce(np.log(ratio).sum(1)) - np.log(len(BRIGHTNESS)))


def _pixels(w: np.ndarray, camera: Camera, found: Identification) -> tuple[np.ndarray, np.ndarray]:
    """Pixels x, y (N,) on the camera's frame of `Sky`'s directions w (N, 3)."""
    x, y = camera.scaled(found.focal_scale).project(w @ found.attitude.T).T
    return x, camera.height - 1 - y if found.mirrored else y
