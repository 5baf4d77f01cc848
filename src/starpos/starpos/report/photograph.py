# SPDX-License-Identifier: Apache-2.0
"""The photograph of a night in which most stars were named, as it was held, with their names."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from starpos.averaging.sights import star_names
from starpos.fix.blind import SEARCH_S
from starpos.fix.searching import Sight
from starpos.frames.annotate import Identified, annotate
from starpos.frames.frame import Frame, Stars
from starpos.frames.reading import read_frame
from starpos.night.night import Night
from starpos.night.reading import Instruments
from starpos.night.work import Solving
from starpos.report.style import Picture

CIRCLED = 150
CAPTION = (
    "Circles: the brightest identified stars, with the names and V magnitudes of some, as the telephone was "
    "held. Suspicious: circles beside the stars, or all of them in one corner."
)


def named_photograph(night: Night, paths: dict[str, Path]) -> Picture | None:
    """The picture; None where no frame was identified.  paths: of the frames by their names.

    It is identified once more, as a fix leaves out overexposed stars, for which people look first.
    """
    shot = max(night.shots, key=lambda s: (len(s.names), s.stars_detected), default=None)
    if shot is None or not shot.stars_detected:
        return None
    frame = read_frame(str(paths[shot.name]))
    if not isinstance(frame, Frame):
        return None
    sight = Solving(Instruments(None, by_header=True), search_s=SEARCH_S)(frame)
    if sight.solution.star is None or not len(sight.solution.star):
        return None
    picture = cv2.imencode(".png", _drawn(frame, sight, shot.utc_unix_s))[1].tobytes()
    return Picture("photograph", f"The stars of {shot.name}", CAPTION, picture)


def _upright(frame: Frame, xy: np.ndarray) -> tuple[Frame, np.ndarray]:
    """A frame and its places (M, 2), turned by quarters so that up in it is up on the page."""
    if frame.gravity is None or frame.pattern:
        return frame, xy
    x, y, _ = frame.gravity.up
    # a quarter takes (x, y) to (y, width - 1 - x)
    quarters = int(np.argmax([-y, x, y, -x]))
    for _ in range(quarters):
        xy = np.column_stack([xy[:, 1], frame.width - 1 - xy[:, 0]])
        frame = replace(frame, pixels=np.ascontiguousarray(np.rot90(frame.pixels)), gravity=None)
    return frame, xy


def _drawn(frame: Frame, sight: Sight, utc_unix_s: float) -> np.ndarray:
    magnitudes, row = sight.solution.magnitudes, np.asarray(sight.solution.star)
    assert magnitudes is not None
    # more circles would hide the sky
    order = np.argsort(magnitudes)[:CIRCLED]
    frame, xy = _upright(frame, np.stack([sight.stars.x, sight.stars.y], -1)[row[order]])
    n = len(order)
    shown = Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=np.ones(n),
        snr=np.ones(n),
        covariance=np.tile(np.eye(2), (n, 1, 1)),
        flags=np.zeros(n, np.uint8),
        width=frame.width,
        height=frame.height,
        mid_unix_s=utc_unix_s if np.isfinite(utc_unix_s) else None,
    )
    known = {f"HIP {hip}": name for name, hip in star_names().items()}
    names = [known.get(name, name) for name in (sight.solution.names[k] for k in order)]
    return annotate(frame, shown, Identified(range(n), names, magnitudes[order].tolist()))
