# SPDX-License-Identifier: Apache-2.0
"""Figures of the frames: their health in time, and the residuals of all over one frame."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.night.night import Night, Shot
from starpos.report.style import BLUE, GREEN, ORANGE, PURPLE, RED, plain
from starpos.utc import utc_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_health(figure: "Figure", night: Night) -> None:
    """Draw stars, residual, tilt and working time of every frame against time."""
    shots = night.shots
    at, label = _times(shots)
    panels = figure.subplots(4, 1, sharex=True)
    mark, size = ("o", 3.5) if len(shots) <= 150 else (".", 2.5)
    points: dict[str, Any] = {"ms": size, "ls": "none", "marker": mark}
    panels[0].plot(
        at,
        [s.stars_detected for s in shots],
        color=ORANGE,
        label="detected",
        **points | {"ms": 1.8 * size, "mfc": "none"},
    )
    panels[0].plot(at, [s.stars_matched for s in shots], color=BLUE, label="in the fix", **points)
    panels[0].set_ylabel("stars")
    panels[0].set_ylim(0, 1.15 * max(1, *(s.stars_detected for s in shots)))
    _legend(panels[0])
    residual = np.array([s.residual_arcsec for s in shots])
    panels[1].plot(at, residual, color=BLUE, **points)
    panels[1].set_ylabel("residual,\narcsec")
    panels[1].set_ylim(0, 1.2 * np.nanmax(np.append(residual, 1e-3)))
    tilt = np.degrees([s.tilt for s in shots]) * 3600
    known = np.isfinite(tilt).all(1)
    mean = tilt[known].mean(0) if known.any() else np.zeros(2)
    for k, (axis, colour) in enumerate((("x", GREEN), ("y", PURPLE))):
        panels[2].plot(
            at, tilt[:, k] - mean[k], color=colour, label=f"{axis} about {mean[k] / 3600:+.4f}°", **points
        )
    panels[2].set_ylabel("tilt,\narcsec")
    _legend(panels[2])
    seconds = np.array([[s.identify_s, s.fix_s] for s in shots]) * 1e3
    panels[3].plot(at, seconds[:, 0], color=ORANGE, label="identification", **points)
    panels[3].plot(at, seconds[:, 1], color=BLUE, label="fix", **points)
    panels[3].set_ylabel("time, ms")
    panels[3].set_ylim(0, 1.2 * np.nanmax(np.append(seconds, 1.0)))
    _legend(panels[3])
    failed = [t for t, s in zip(at, shots, strict=True) if s.place is None]
    for axes in panels:
        plain(axes)
        if failed:
            axes.plot(failed, np.full(len(failed), 0.03), "x", color=RED, ms=6, mew=1.6, clip_on=False,
                      transform=axes.get_xaxis_transform(), label="no fix")  # fmt: skip
    if failed:
        _legend(panels[0])
    panels[-1].set_xlabel(label)
    figure.align_ylabels(panels)


def _legend(axes: "Axes") -> None:
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def _times(shots: Sequence[Shot]) -> tuple[list[float], str]:
    """Position of each frame on the time axis, and the axis' label: minutes, or numbers if a time is unknown."""
    times = np.array([s.utc_unix_s for s in shots])
    if not np.isfinite(times).all():
        return list(range(1, len(shots) + 1)), "frame number"
    first = times.min()
    begin = utc_text(first)[:19].replace("T", " ")
    return ((times - first) / 60).tolist(), f"minutes after {begin} UTC"


def overlaid(night: Night) -> tuple[np.ndarray, np.ndarray, tuple[int, int]] | None:
    """Places xy and residual_px (N, 2) of the stars of all fixes with the first fix's frame size, and that size.

    None if no fix has residuals.
    """
    shots = [s for _, s in night.fixed if s.size and len(s.residual_px)]
    if not shots or shots[0].size is None:
        return None
    size = shots[0].size
    alike = [s for s in shots if s.size == size]
    return np.concatenate([s.xy for s in alike]), np.concatenate([s.residual_px for s in alike]), size
