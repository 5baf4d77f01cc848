# SPDX-License-Identifier: Apache-2.0
"""Pictures of a result, with matplotlib: the scatter of fixes with its error ellipse, and the annotated frame."""

from collections.abc import Sequence

import numpy as np

STRETCH = (80.0, 99.95)  # percentiles of the frame shown from black to white
SHOWN_PX = 1600  # of a frame's longer side


def draw(
    path, fixes_m: np.ndarray, covariance_m2: np.ndarray, title: str, pixels, stars_px, names: Sequence[str]
) -> None:
    """Write a PNG of two panels.

    fixes_m (N, 2): east and north of the truth; covariance_m2 (2, 2) of one fix; pixels (h, w): the frame;
    stars_px (M, 2): x, y of its identified stars, brightest first, with their names.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 6.4))
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    figure.subplots_adjust(left=0.06, right=0.985, bottom=0.09, top=0.88, wspace=0.14)
    scatter(left, fixes_m, covariance_m2)
    annotated_frame(right, pixels, stars_px, names)
    figure.suptitle(title)
    figure.savefig(path, dpi=90)


def scatter(axes, fixes_m: np.ndarray, covariance_m2: np.ndarray) -> None:
    """Fixes around the truth, their mean, and the claimed ellipses of one fix at 1 and 2 sigma around the truth."""
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(covariance_m2)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    for k, alpha in ((2, 0.12), (1, 0.22)):
        height, width = 2 * k * np.sqrt(values)
        axes.add_patch(Ellipse((0, 0), width, height, angle=angle, color="tab:blue", alpha=alpha, lw=0))
    axes.plot(*fixes_m.T, "o", color="tab:blue", ms=5, label="fixes")
    axes.plot(*fixes_m.mean(0), "D", color="tab:orange", ms=8, label="their mean")
    axes.plot(0, 0, "+", color="black", ms=16, mew=2, label="truth")
    reach = 1.15 * max(2 * np.sqrt(values[1]), np.abs(fixes_m).max())
    axes.set(
        xlim=(-reach, reach),
        ylim=(-reach, reach),
        xlabel="east of the truth, m",
        ylabel="north of the truth, m",
    )
    axes.set_title("fixes, claimed error of one (1 and 2 sigma)")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper right")


def annotated_frame(
    axes, pixels: np.ndarray, stars_px: np.ndarray, names: Sequence[str], named: int = 12
) -> None:
    """The frame, stretched, with its identified stars circled and the brightest named."""
    import cv2

    height, width = pixels.shape[:2]
    shrink = max(1, max(height, width) // SHOWN_PX)
    # smoothed against noise, then the brightest pixel around each kept: stars survive the reduction as dots
    smooth = cv2.GaussianBlur(pixels, (0, 0), 1.5)
    small = cv2.dilate(smooth, np.ones((3 * shrink, 3 * shrink), np.uint8))[::shrink, ::shrink]
    black, white = np.percentile(small, STRETCH)
    axes.imshow(
        small,
        cmap="gray",
        vmin=black,
        vmax=max(white, black + 1),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
    )
    x, y = np.asarray(stars_px, float).reshape(-1, 2).T
    axes.plot(x, y, "o", mfc="none", mec="tab:green", ms=11, mew=0.8)
    for star_x, star_y, name in list(zip(x, y, names, strict=True))[:named]:
        axes.annotate(
            name,
            (star_x, star_y),
            (6, 6),
            textcoords="offset points",
            color="tab:orange",
            fontsize=8,
            clip_on=True,
        )
    axes.set(xlabel="x, px", ylabel="y, px", title=f"a frame and its {len(x)} identified stars")
