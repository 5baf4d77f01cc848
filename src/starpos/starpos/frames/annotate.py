# SPDX-License-Identifier: Apache-2.0
"""A picture of a frame for people: scaled down and stretched, stars circled, identified ones named, with a caption."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import cv2
import numpy as np

from starpos.frames.frame import Frame, Stars

# Blue, green, red.
Colour = tuple[int, int, int]

# Length of the picture's longer side, at most.
SHOWN_PX = 1600
# White is the higher of this percentile and this number of sigma above the background.
WHITE_PERCENTILE, WHITE_SIGMAS = 99.95, 30.0
# A scaled-down picture is blurred by this, so that a star smaller than its pixels is still seen.
DOT_SIGMA_PX = 0.7
# Number of pixels that is enough to find black and white.
COARSEST_SAMPLE = 1 << 18
# Two values this far apart differ by noise only: the distance is larger than a star, and the sky changes more slowly.
NOISE_LAG = 12
# Smallest and largest radius of a circle; many stars get small ones.
RADII_PX = (3.0, 9.0)
# Maximum number of names, and area of the picture per name, px2.
NAMED, NAME_PX2 = 40, 12000
# Marks of pixels with a circle, which a name may cover, and of pixels that no name may cover.
CIRCLE, KEPT = 1, 2
FONT, SCALE, LINE_PX, MARGIN_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.45, 18, 6
# Bits of the fraction in OpenCV's fixed-point coordinates.
SUBPIXEL = 4
DETECTED, IDENTIFIED, FLAGGED = (200, 160, 90), (110, 230, 110), (60, 150, 255)
TEXT, BAND, OUTLINE = (225, 225, 225), (32, 32, 32), (0, 0, 0)


@dataclass(frozen=True, eq=False)
class Identified:
    """The identified stars of a frame, brightest first: rows of its Stars, names, V magnitudes (NaN: unknown)."""

    star: Sequence[int] = ()
    names: Sequence[str] = ()
    magnitudes: Sequence[float] = ()


def annotate(
    frame: Frame, stars: Stars, identified: Identified = Identified(), remarks: Sequence[str] = ()
) -> np.ndarray:
    """Draw a frame: an array (h + caption, w, 3) uint8, BGR.

    The frame's point (x, y) is at ((x, y) + 0.5) / n - 0.5 in it, with n from `shrink`. Every star is circled, in the
    colour of its kind in the caption. The brightest identified stars are named where there is room. The caption holds
    the time, the numbers of stars and the remarks.
    """
    n = shrink(frame)
    picture = _shown(frame.pixels, n)
    height, width = picture.shape[:2]
    centres = ((np.stack([stars.x, stars.y], -1) + 0.5) / n - 0.5).tolist()
    known = np.zeros(len(stars), bool)
    known[np.asarray(identified.star, int)] = True
    colours = [
        FLAGGED if f else IDENTIFIED if k else DETECTED for f, k in zip(stars.flags, known, strict=True)
    ]
    radius = float(np.clip(0.25 * np.sqrt(width * height / max(1, len(stars))), *RADII_PX))
    taken = np.zeros((height, width), np.uint8)
    for centre, colour in zip(centres, colours, strict=True):
        _circle(picture, centre, radius, colour)
        cv2.circle(taken, tuple(map(round, centre)), round(radius), CIRCLE, -1)
    named = list(zip(identified.star, identified.names, identified.magnitudes, strict=True))
    named = named[: min(NAMED, width * height // NAME_PX2)]
    for row, _, _ in named:
        cv2.circle(taken, tuple(map(round, centres[row])), round(radius), KEPT, -1)
    for row, name, magnitude in named:
        text = name if np.isnan(magnitude) else f"{name}  {magnitude:.1f}"
        _label(picture, taken, centres[row], radius, text, colours[row])
    parts = [
        (_time(stars.mid_unix_s), TEXT),
        (f"{len(stars)} stars", DETECTED),
        (f"{np.count_nonzero(known)} identified", IDENTIFIED),
        (f"{np.count_nonzero(stars.flags)} flagged", FLAGGED),
        *((remark, TEXT) for remark in remarks),
    ]
    return np.vstack([picture, _caption(width, parts)])


def shrink(frame: Frame) -> int:
    """Pixels of the frame, along x and along y, in one pixel of its picture.

    The number is even for a colour mosaic: then each pixel of the picture holds every colour equally often.
    """
    n = -(-max(frame.width, frame.height) // SHOWN_PX)
    return n + n % 2 if frame.pattern else n


def _shown(pixels: np.ndarray, n: int) -> np.ndarray:
    """The means of n x n pixels, stretched from background to white; a rest at the right and below is cut off."""
    height, width = (max(1, side // n) for side in pixels.shape[:2])
    light = cv2.resize(pixels[: height * n, : width * n], (width, height), interpolation=cv2.INTER_AREA)
    if n > 1:
        light = cv2.GaussianBlur(light, (0, 0), DOT_SIGMA_PX)
    sample = light[:: -(-light.size // COARSEST_SAMPLE)].ravel().astype(int)
    sigma = max(float(np.median(np.abs(sample - np.roll(sample, NOISE_LAG)))) / 0.954, 0.5)
    dark, bright, white = np.percentile(sample, (5, 95, WHITE_PERCENTILE))
    # the background where it is darkest, so that moonlight and dusk are seen
    black = dark + 1.64 * sigma
    white = max(white, bright + WHITE_SIGMAS * sigma)
    levels = np.arange(256 if light.dtype == np.uint8 else 65536)
    # the root makes faint stars brighter
    grey = np.sqrt(np.clip((levels - black) / (white - black), 0, 1))
    shown = (255 * grey).astype(np.uint8)[light]
    return shown if shown.ndim == 3 else cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)


def _circle(picture: np.ndarray, centre: Sequence[float], radius: float, colour: Colour) -> None:
    x, y, r = (round(v * (1 << SUBPIXEL)) for v in (*centre, radius))
    cv2.circle(picture, (x, y), r, colour, 1, cv2.LINE_AA, SUBPIXEL)


def _label(
    picture: np.ndarray, taken: np.ndarray, centre: Sequence[float], radius: float, text: str, colour: Colour
) -> None:
    """Write a text next to, above or below a star, where it covers least, and mark its pixels, if there is room."""
    (width, ascent), descent = cv2.getTextSize(text, FONT, SCALE, 1)
    x, y = centre
    away = radius + 4
    best, least = None, math.inf
    for left, base in (
        (x + away, y + ascent / 2),
        (x - away - width, y + ascent / 2),
        (x - width / 2, y - away - descent),
        (x - width / 2, y + away + ascent),
    ):
        left, base = round(left), round(base)
        top, right, bottom = base - ascent - 1, left + width, base + descent
        if left < 0 or top < 0 or right > taken.shape[1] or bottom > taken.shape[0]:
            continue
        room = taken[top:bottom, left:right]
        covered = math.inf if (room == KEPT).any() else float(np.count_nonzero(room))
        if covered < least:
            best, least = (room, (left, base)), covered
    if best is None:
        return
    room, origin = best
    room[:] = KEPT
    # a thicker text is longer in OpenCV 5: the outline is the same text, shifted
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        shifted = origin[0] + dx, origin[1] + dy
        cv2.putText(picture, text, shifted, FONT, SCALE, OUTLINE, 1, cv2.LINE_AA)
    cv2.putText(picture, text, origin, FONT, SCALE, colour, 1, cv2.LINE_AA)


def _caption(width: int, parts: Sequence[tuple[str, Colour]]) -> np.ndarray:
    """A picture of the parts, each a text and its colour, on as many lines as they need."""
    space = _length("x x") - _length("xx")
    placed, x, line = [], MARGIN_PX, 0
    for text, colour in parts:
        for word in text.split():
            length = _length(word)
            if x > MARGIN_PX and x + length + MARGIN_PX > width:
                x, line = MARGIN_PX, line + 1
            placed.append((word, (x, (line + 1) * LINE_PX - MARGIN_PX // 2), colour))
            x += length + space
        x += 3 * space
    band = np.full(((line + 1) * LINE_PX + MARGIN_PX, width, 3), BAND, np.uint8)
    for word, origin, colour in placed:
        cv2.putText(band, word, origin, FONT, SCALE, colour, 1, cv2.LINE_AA)
    return band


def _length(text: str) -> int:
    """Length of a text in px."""
    return cv2.getTextSize(text, FONT, SCALE, 1)[0][0]


def _time(unix_s: float | None) -> str:
    """The caption's time."""
    if unix_s is None:
        return "no time"
    return datetime.fromtimestamp(unix_s, timezone.utc).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] + " UTC"
