# SPDX-License-Identifier: Apache-2.0
"""Pictures of the residuals of stars over the frame, with matplotlib."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.calibration.camera import Intrinsics, rms

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh

# more stars than this are drawn as the means of cells
MAX_ARROWS = 400
# How many stand along the longer side.
ARROW_CELLS, COLOUR_CELLS = 22, 12
# length of the key's arrow, in cells of ARROW_CELLS
USUAL_ARROW = 0.8
MIN_IN_CELL = 3


def draw(path: Path | str, fit: Intrinsics, title: str) -> None:
    """Write a picture of the residuals before and after the fit, and of their rms over the frame."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = fit.camera.width, fit.camera.height
    figure = Figure(figsize=(18, 1.5 + 5.2 * height / width), layout="constrained")
    FigureCanvasAgg(figure)
    before, after, cells = figure.subplots(1, 3)
    for axes, residual, name in (
        (before, fit.before, "camera as given"),
        (after, fit.residual, "fitted camera"),
    ):
        draw_residuals(axes, fit.xy, residual, width, height)
        axes.set_title(f"{name}: {rms(residual):.3f} px rms an axis")
    image = draw_rms(cells, fit.xy, fit.residual, width, height)
    figure.colorbar(image, ax=cells, label="rms an axis, px", shrink=0.85)
    cells.set_title("what is left, by place")
    figure.suptitle(title)
    # other formats do not show that starpos has made them
    made_by = {"Software": "starpos"} if Path(path).suffix.lower() == ".png" else None
    figure.savefig(path, dpi=90, metadata=made_by)


def draw_residuals(axes: "Axes", xy: np.ndarray, residual: np.ndarray, width: int, height: int) -> None:
    """Draw residuals (N, 2) px of stars at xy (N, 2) px as arrows over a frame, with a key for their length.

    More than MAX_ARROWS stars are drawn as the means of cells with MIN_IN_CELL or more.
    """
    if len(xy) > MAX_ARROWS:
        means = _means(xy, np.hstack([xy, residual]), ARROW_CELLS, width, height)[1].reshape(4, -1)
        filled = means[:, np.isfinite(means[0])]
        xy, residual = filled[:2].T, filled[2:].T
    usual = float(np.median(np.hypot(*residual.T))) if len(residual) else 0.0
    key = _round_number(usual) if usual > 0 else 1.0
    per_px = key / (USUAL_ARROW * max(width, height) / ARROW_CELLS)
    arrows = axes.quiver(
        *xy.T, *residual.T, angles="xy", scale_units="xy", scale=per_px, color="tab:blue", width=0.002
    )
    axes.quiverkey(arrows, 0.85, -0.13, key, f"{key:g} px", labelpos="E", color="black")
    _frame(axes, width, height)


def draw_rms(axes: "Axes", xy: np.ndarray, residual: np.ndarray, width: int, height: int) -> "QuadMesh":
    """Colour square cells of a frame by the rms of their residuals (N, 2) px; returns the image for a colour bar."""
    (rows, columns), means = _means(xy, np.square(residual).mean(1)[:, None], COLOUR_CELLS, width, height)
    image = axes.pcolormesh(columns, rows, np.sqrt(means[0]), cmap="viridis", vmin=0)
    _frame(axes, width, height)
    return image


def _means(
    xy: np.ndarray, values: np.ndarray, along: int, width: int, height: int
) -> tuple[list[np.ndarray], np.ndarray]:
    """Edges in px of the rows and columns of square cells over a frame, `along` of them on its longer side. And in each
    the means (k, rows, columns) of values (N, k) at xy (N, 2) px; NaN in cells with fewer than MIN_IN_CELL.
    """
    size = max(width, height) / along
    edges = [np.arange(np.ceil(side / size) + 1) * size - 0.5 for side in (height, width)]
    count, *sums = (np.histogram2d(xy[:, 1], xy[:, 0], bins=edges, weights=w)[0] for w in (None, *values.T))
    return edges, np.where(count < MIN_IN_CELL, np.nan, np.array(sums) / np.maximum(count, 1))


def _round_number(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above `value`."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)


def _frame(axes: "Axes", width: int, height: int) -> None:
    axes.set(
        xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x, px", ylabel="y, px", aspect="equal"
    )
