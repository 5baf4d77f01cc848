# SPDX-License-Identifier: Apache-2.0
"""A frame for people: scaled down and stretched, its stars circled, the identified ones named, a caption below."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import cv2
import numpy as np

from starpos.frames.frame import Frame
from starpos.frames.stars import Stars

SHOWN_PX = 1600  # of a frame's longer side, at most
WHITE_PERCENTILE, WHITE_SIGMAS = 99.95, 30.0  # white is the higher of the two
DOT_SIGMA_PX = 0.7  # of a star that the reduction has made smaller than a pixel
COARSEST_SAMPLE = 1 << 18  # pixels that are enough to tell black and white
NOISE_LAG = (
    12  # between values whose difference is noise: further than a star is wide, nearer than the sky changes
)
RADII_PX = (3.0, 9.0)  # of a circle; smaller where there are many
NAMED, NAME_PX2 = 40, 12000  # names at most, and the part of the picture that each may want
CIRCLE, KEPT = 1, 2  # what may be written over if need be, and what never is
FONT, SCALE, LINE_PX, MARGIN_PX = cv2.FONT_HERSHEY_SIMPLEX, 0.45, 18, 6
SUBPIXEL = 4  # bits of OpenCV's fixed point
DETECTED, IDENTIFIED, FLAGGED = (200, 160, 90), (110, 230, 110), (60, 150, 255)  # BGR
TEXT, BAND, OUTLINE = (225, 225, 225), (32, 32, 32), (0, 0, 0)


@dataclass(frozen=True, eq=False)
class Identified:
    """Which of a frame's stars are known, brightest first: rows of its Stars, names, V magnitudes (NaN: unknown)."""

    star: Sequence[int] = ()
    names: Sequence[str] = ()
    magnitudes: Sequence[float] = ()


def annotate(
    frame: Frame, stars: Stars, identified: Identified = Identified(), remarks: Sequence[str] = ()
) -> np.ndarray:
    """A picture of a frame, (h + caption, w, 3) uint8, BGR; the frame's (x, y) is at ((x, y) + 0.5) / n - 0.5 in it.

    n is a whole number (`shrink`). Every star is circled, in the colour in which the caption counts its kind; the
    brightest identified ones that have room are named. The caption: time, counts, remarks.
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
    """How many pixels of the frame, along x and along y, one of its picture holds.

    Even for a colour mosaic: each then holds as many of every colour, and no chequers are left.
    """
    n = -(-max(frame.width, frame.height) // SHOWN_PX)
    return n + n % 2 if frame.pattern else n


def _shown(pixels: np.ndarray, n: int) -> np.ndarray:
    """The mean of each n x n pixels (what is left over at right and below is cut), from background to white."""
    height, width = (max(1, side // n) for side in pixels.shape[:2])
    light = cv2.resize(pixels[: height * n, : width * n], (width, height), interpolation=cv2.INTER_AREA)
    if n > 1:
        light = cv2.GaussianBlur(light, (0, 0), DOT_SIGMA_PX)
    sample = light[:: -(-light.size // COARSEST_SAMPLE)].ravel().astype(int)
    sigma = max(np.median(np.abs(sample - np.roll(sample, NOISE_LAG))) / 0.954, 0.5)
    dark, bright, white = np.percentile(sample, (5, 95, WHITE_PERCENTILE))
    black = dark + 1.64 * sigma  # the background where it is darkest: moonlight and dusk are to be seen
    white = max(white, bright + WHITE_SIGMAS * sigma)
    levels = np.arange(np.iinfo(light.dtype).max + 1)
    grey = np.sqrt(np.clip((levels - black) / (white - black), 0, 1))  # lifts the faint ones
    shown = (255 * grey).astype(np.uint8)[light]
    return shown if shown.ndim == 3 else cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)


def _circle(picture, centre, radius: float, colour) -> None:
    x, y, r = (round(v * (1 << SUBPIXEL)) for v in (*centre, radius))
    cv2.circle(picture, (x, y), r, colour, 1, cv2.LINE_AA, SUBPIXEL)


def _label(picture, taken: np.ndarray, centre, radius: float, text: str, colour) -> None:
    """Write a text where it covers least, beside, above or below a star, and take its room; else not at all."""
    (width, ascent), descent = cv2.getTextSize(text, FONT, SCALE, 1)
    x, y = centre
    away = radius + 4
    best, least = None, np.inf
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
        covered = np.inf if (room == KEPT).any() else np.count_nonzero(room)
        if covered < least:
            best, least = (room, (left, base)), covered
    if best is None:
        return
    room, origin = best
    room[:] = KEPT
    cv2.putText(picture, text, origin, FONT, SCALE, OUTLINE, 3, cv2.LINE_AA)
    cv2.putText(picture, text, origin, FONT, SCALE, colour, 1, cv2.LINE_AA)


def _caption(width: int, parts) -> np.ndarray:
    """The parts, each a text and its colour, on as many lines as they need."""
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
    """px"""
    return cv2.getTextSize(text, FONT, SCALE, 1)[0][0]


def _time(unix_s: float | None) -> str:
    if unix_s is None:
        return "no time"
    return datetime.fromtimestamp(unix_s, timezone.utc).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] + " UTC"
