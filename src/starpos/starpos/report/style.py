# SPDX-License-Identifier: Apache-2.0
"""Look of the figures: their size and colours, and PNG files without any global state of matplotlib."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from starpos import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, DPI = 7.2, 130
# of Okabe and Ito, whom colour-blind readers can follow too
BLUE, ORANGE, GREEN, RED, SKY, PURPLE, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#6e6e6e"
)  # fmt: skip
MADE_BY = f"starpos {__version__} report"


def new_figure(height_in: float) -> "Figure":
    """An empty figure of the common width."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained", facecolor="white")


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure as PNG; name: of its file, without suffix; title, caption: plain text."""

    name: str
    title: str
    caption: str
    png: bytes


def mark_simulated(figure: "Figure") -> None:
    """Write into the corner of a figure that no camera took its frames."""
    figure.text(0.005, 0.004, "simulated", ha="left", va="bottom", fontsize=8, color=GREY)


def png_of(figure: "Figure") -> bytes:
    """The figure as PNG, with starpos named as the software that made it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=DPI, metadata={"Software": MADE_BY})
    return out.getvalue()


def plain(axes: "Axes") -> None:
    """Give axes a light grid and only the left and bottom lines of the frame."""
    axes.grid(alpha=0.25, lw=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)


def number_axis(axes: "Axes", numbers: Sequence[int] | np.ndarray) -> None:
    """Put whole numbers along x, with room at both ends."""
    from matplotlib.ticker import MaxNLocator

    low, high = min(numbers), max(numbers)
    margin = max(0.5, 0.03 * (high - low))
    axes.set_xlim(low - margin, high + margin)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=10, integer=True, min_n_ticks=1))


def figures_of(value: float, digits: int = 3) -> str:
    """A number with a few significant digits, and with an exponent only if it is very large or small."""
    if not np.isfinite(value):
        return "unknown"
    if value == 0:
        return "0"
    decimals = digits - 1 - int(np.floor(np.log10(abs(value))))
    return f"{value:.{max(0, decimals)}f}" if -3 < decimals < 8 else f"{value:.{digits - 1}e}"
