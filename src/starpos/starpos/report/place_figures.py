# SPDX-License-Identifier: Apache-2.0
"""Figures of the place: stability of the frames, their scatter, the error budget, and the errors of several nights."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.night.night import Night, ReportedPlace
from starpos.report import measures
from starpos.report.measures import Stability
from starpos.report.style import BLUE, GREEN, GREY, ORANGE, RED, SKY, figures_of, number_axis, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# more points than this are drawn small, with a band instead of bars
MANY = 150
# A scatter that reaches farther is drawn in km.
FAR_M = 10_000.0
# In m or arcsec.
SMALLEST_SHOWN = 1e-3
DEFLECTION = "deflection (geodetic only)"


def draw_stability(figure: "Figure", s: Stability) -> None:
    """Draw three panels: latitude, longitude and heading in arcsec against the frame's number."""
    panels = figure.subplots(3, 1, sharex=True)
    names = ("latitude", "longitude", "north")
    for k, (axes, name, paper) in enumerate(zip(panels, names, measures.PAPER_STABILITY, strict=True)):
        plain(axes)
        axes.axhline(0, color=GREY, lw=0.8)
        if k == 2 and not s.heading_from:
            axes.text(0.5, 0.5, "the instrument turned between the frames:\ntheir headings have no mean",
                      ha="center", va="center", transform=axes.transAxes, color=GREY)  # fmt: skip
            axes.set(yticks=[], ylabel="north")
            continue
        value, sigma = s.arcsec[:, k], s.sigma[:, k]
        _with_errors(axes, s.number, value, sigma)
        if k < 2 and s.outlier.any():
            axes.plot(
                s.number[s.outlier], value[s.outlier], "X", color=RED, ms=8, mec="white", label="outlier"
            )
            axes.legend(loc="upper right", fontsize=8, framealpha=0.9)
        if k == 2 and s.heading_from == "truth":
            axes.set_title(
                f"north, less the truth: mean absolute {figures_of(s.mean_absolute[k])}″", fontsize=10
            )
        else:
            found = f"{name}: mean absolute deviation {figures_of(s.mean_absolute[k])}″"
            axes.set_title(f"{found} (the paper's {figures_of(paper)}″)", fontsize=10)
        axes.set_ylabel("arcsec")
    number_axis(panels[-1], s.number)
    panels[-1].set_xlabel("frame number")


def _with_errors(axes: "Axes", x: np.ndarray, value: np.ndarray, sigma: np.ndarray) -> None:
    """Draw points with bars of 1 sigma, or with a band if there are many."""
    many = len(x) > MANY
    if many:
        axes.fill_between(x, -sigma, sigma, color=SKY, alpha=0.3, lw=0, label="1 sigma")
        axes.plot(x, value, ".", color=BLUE, ms=3)
    else:
        axes.errorbar(x, value, sigma, fmt="o", color=BLUE, ms=3.5, ecolor=SKY, elinewidth=1.2, capsize=0)
    reach = max(1.06 * (np.abs(value) + (0 if many else sigma)).max(), 1.6 * np.median(sigma), 1e-3)
    axes.set_ylim(-reach, reach)


def draw_scatter(figure: "Figure", night: Night) -> None:
    """Draw the fixes in m about the average, the ellipses of one frame's own errors and of the average's."""
    axes = figure.subplots()
    latitude, longitude = measures.middle(night)
    points = measures.around(night, latitude, longitude)
    own = np.mean([p.own[:2, :2] for p in night.places], axis=0)
    plain(axes)
    reach = [np.abs(points).max(), 2.45 * np.sqrt(np.linalg.eigvalsh(own)[-1])]
    _ellipses(axes, own, SKY, "one frame, its own errors", fill=True)
    small = 5 if len(points) <= MANY else 2.5
    axes.plot(*points.T, "o", color=BLUE, ms=small, mec="white", mew=0.4, label="frames", zorder=3)
    if night.combined and len(points) > 1:
        whole = night.combined.covariance[:2, :2]
        _ellipses(axes, whole, ORANGE, "average, all errors", fill=False)
        axes.plot(0, 0, "D", color=ORANGE, ms=7, mec="black", mew=0.6, label="average", zorder=4)
        reach.append(2.45 * np.sqrt(np.linalg.eigvalsh(whole)[-1]))
    if night.truth:
        true = measures.offset_m(night.truth, latitude, longitude)
        axes.plot(*true, "P", color=GREEN, ms=11, mec="black", mew=0.6, label="truth", zorder=5)
        reach.append(np.abs(true).max())
    limit = 1.12 * max(*reach, 0.01)
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
    axes.set_aspect("equal")
    _name_lengths(axes, limit)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=9, frameon=False)


def _name_lengths(axes: "Axes", limit_m: float) -> None:
    """Label axes in m, in km where metres would need a power of ten."""
    far = limit_m > FAR_M
    for axis, name in ((axes.xaxis, "east"), (axes.yaxis, "north")):
        axis.set_major_formatter(lambda metres, _: f"{metres / 1000 if far else metres:g}")
        axis.set_label_text(f"{name}, {'km' if far else 'm'}")


def _ellipses(axes: "Axes", covariance: np.ndarray, colour: str, label: str, fill: bool) -> None:
    """Draw the ellipses of a covariance (2, 2) that hold 39 % (1 sigma) and 95 %."""
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(covariance)
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    for squared, style, alpha, share in (
        (measures.INSIDE_95, "--", 0.18, "95 %"),
        (measures.INSIDE_1_SIGMA, "-", 0.3, "39 %"),
    ):
        height, width = 2 * np.sqrt(squared * np.maximum(values, 0))
        how: dict[str, Any] = (
            {"fc": colour, "ec": "none", "alpha": alpha} if fill else {"fc": "none", "ec": colour}
        )
        axes.add_patch(
            Ellipse((0, 0), width, height, angle=angle, ls=style, lw=1.6, label=f"{label}, {share}", **how)
        )


def draw_budget(figure: "Figure", night: Night) -> None:
    """Draw bars of 1 sigma of each source, for one frame and for the average, with the largest on top."""
    one = _shares(night.places[0], night)
    places = [("one frame", one, SKY)]
    if night.combined and len(night.fixed) > 1:
        places.append((f"average of {len(night.fixed)}", _shares(night.combined, night), BLUE))
    # An average may have sources that one frame has not, such as the frames' scatter.
    largest = {n: np.hypot(*share[:2]) for _, shares, _ in places for n, share in shares.items()}
    names = sorted(largest, key=lambda n: largest[n])
    panels = figure.subplots(1, 3, sharey=True)
    height = 0.8 / len(places)
    for k, (axes, title) in enumerate(zip(panels, ("east, m", "north, m", "heading, arcsec"), strict=True)):
        plain(axes)
        axes.grid(axis="y", visible=False)
        values = [[shares.get(n, np.zeros(3))[k] for n in names] for _, shares, _ in places]
        top = np.nanmax(values, initial=1e-9)
        # the axis begins three decades below the smaller of frame and average: an unknown A3 would hide all other bars
        highest = [np.nanmax(row, initial=1e-9) for row in values]
        low = max(min(highest) * 1e-3, min((v for row in values for v in row if v > 0), default=top) / 2)
        for j, ((label, _, colour), row) in enumerate(zip(places, values, strict=True)):
            at = np.arange(len(names)) + (len(places) / 2 - 0.5 - j) * height
            axes.barh(at, np.maximum(np.nan_to_num(row), low), height, color=colour, label=label)
            for y, value in zip(at, row, strict=True):
                axes.text(
                    max(np.nan_to_num(value), low) * 1.15,
                    y,
                    _short(value),
                    va="center",
                    fontsize=7,
                    color="#333333",
                )
        axes.set_xscale("log")
        axes.set_xlim(low, top * 12)
        axes.set_xlabel(title)
    panels[0].set_yticks(np.arange(len(names)), [n.replace(" (", "\n(") for n in names])
    panels[1].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=9, frameon=False)


def _short(value: float) -> str:
    if np.isnan(value):
        return "none"
    return "0" if value == 0 else figures_of(value, 2) if value >= SMALLEST_SHOWN else f"< {SMALLEST_SHOWN:g}"


def _shares(place: ReportedPlace, night: Night) -> dict[str, np.ndarray]:
    """1 sigma (3,) of each source: east m, north m, heading arcsec; the latter is NaN if there is no heading."""
    unit = np.array([1, 1, 1 / measures.ARCSEC])
    shares = {t.name: np.sqrt(np.diag(t.covariance)[:3]) * unit for t in place.terms}
    deflection = place.on_ground(night.vertical).deflection_covariance
    shares = {name: share for name, share in shares.items() if share.max() >= SMALLEST_SHOWN}
    shares[DEFLECTION] = np.sqrt(np.diag(deflection)) * unit
    if np.isnan(place.heading):
        shares = {name: np.array([*share[:2], np.nan]) for name, share in shares.items()}
    return shares


def draw_nights(figure: "Figure", nights: Sequence[tuple[int, Night]]) -> None:
    """Draw the errors of latitude and longitude in arcsec of numbered nights; at least one with a place and a truth."""
    known = [(k, n.combined, n.truth) for k, n in nights if n.combined and n.truth]
    number = [k for k, _, _ in known]
    error = np.array([measures.error_arcsec(place, truth) for _, place, truth in known])
    sigma = np.array([measures.sigma_arcsec(place) for _, place, _ in known])
    panels = figure.subplots(2, 1, sharex=True)
    for k, (axes, name, paper) in enumerate(
        zip(panels, ("latitude", "longitude"), measures.PAPER_NIGHTS, strict=True)
    ):
        plain(axes)
        axes.axhline(0, color=GREY, lw=0.8)
        axes.axhspan(-paper, paper, color=GREY, alpha=0.1, lw=0, label="the paper's mean absolute error")
        axes.errorbar(number, error[:, k], sigma[:, k], fmt="o", color=BLUE, ms=5, ecolor=SKY, elinewidth=1.5)
        reach = 1.15 * max(paper, (np.abs(error[:, k]) + sigma[:, k]).max())
        mean = figures_of(np.abs(error[:, k]).mean())
        axes.set_title(f"{name}: mean absolute error {mean}″ (the paper's {paper:.1f}″)", fontsize=10)
        axes.set(ylim=(-reach, reach), ylabel="arcsec")
    panels[0].legend(loc="upper right", fontsize=8, framealpha=0.9)
    number_axis(panels[-1], number)
    panels[-1].set_xlabel("night")
