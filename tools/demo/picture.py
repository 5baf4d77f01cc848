# SPDX-License-Identifier: Apache-2.0
"""Pictures of a result, with matplotlib: the scatter of fixes with its error ellipse, and the annotated frame."""

import numpy as np


def draw(
    path, fixes_m: np.ndarray, covariance_m2: np.ndarray, title: str, frame: np.ndarray, about: str
) -> None:
    """Write a PNG of two panels.

    fixes_m (N, 2): east and north of the truth; covariance_m2 (2, 2) of one fix; frame (h, w, 3): a picture of it as
    `annotate` makes it, BGR, with a title.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 6.4))
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    figure.subplots_adjust(left=0.06, right=0.985, bottom=0.09, top=0.88, wspace=0.14)
    scatter(left, fixes_m, covariance_m2)
    right.imshow(frame[..., ::-1])
    right.set(title=about, xticks=[], yticks=[])
    figure.suptitle(title)
    figure.savefig(path, dpi=90)


def scatter(axes, fixes_m: np.ndarray, covariance_m2: np.ndarray) -> None:
    """Draw the fixes and their mean around the truth, and the claimed ellipses of one fix at 1 and 2 sigma."""
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
