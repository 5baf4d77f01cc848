# SPDX-License-Identifier: Apache-2.0
"""The photograph of a night in which most stars were named, as it was held, with their names."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from starpos.frames.annotate import Identified, annotate
from starpos.frames.frame import Frame, Stars
from starpos.frames.reading import read_frame
from starpos.night.night import Night, Shot
from starpos.report.style import Picture

CIRCLED = 150
CAPTION = (
    "Circles: the brightest identified stars, with the names and V magnitudes of some, as the telephone was "
    "held. Suspicious: circles beside the stars, or all of them in one corner."
)


def named_photograph(night: Night, paths: dict[str, Path]) -> Picture | None:
    """The picture; None where no frame was identified.  paths: of the frames by their names."""
    shot = max((s for s in night.shots if s.names), key=lambda s: len(s.names), default=None)
    if shot is None:
        return None
    frame = read_frame(str(paths[shot.name]))
    if not isinstance(frame, Frame):
        return None
    picture = cv2.imencode(".png", _drawn(*_upright(frame, shot.xy), shot))[1].tobytes()
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


def _drawn(frame: Frame, xy: np.ndarray, shot: Shot) -> np.ndarray:
    # more circles would hide the sky
    order = np.argsort(shot.magnitudes)[:CIRCLED]
    n = len(order)
    stars = Stars(
        x=xy[order, 0],
        y=xy[order, 1],
        flux=np.ones(n),
        snr=np.ones(n),
        covariance=np.tile(np.eye(2), (n, 1, 1)),
        flags=np.zeros(n, np.uint8),
        width=frame.width,
        height=frame.height,
        mid_unix_s=shot.utc_unix_s if np.isfinite(shot.utc_unix_s) else None,
    )
    return annotate(
        frame, stars, Identified(range(n), [shot.names[k] for k in order], shot.magnitudes[order].tolist())
    )
