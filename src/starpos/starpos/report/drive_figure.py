# SPDX-License-Identifier: Apache-2.0
"""A drive with GNSS: both places, how far apart they are and what the guard said, and what GNSS had taught by then."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starpos.gnss.place import GnssPlace
from starpos.gnss.solving import Watched
from starpos.gnss.watch import GnssStatus
from starpos.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plain
from starpos.units import ARCSEC, HOUR_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    GnssStatus.LEARNING: GREY,
    GnssStatus.AGREES: GREEN,
    GnssStatus.DOUBTFUL: ORANGE,
    GnssStatus.DISAGREES: RED,
}


def compared_of(answers: Sequence[Watched]) -> list[Watched]:
    """The answers to frames with a GNSS place, in the order of their times."""
    timed = [a for a in answers if a.compared is not None and a.solution.utc_unix_s is not None]
    return sorted(timed, key=lambda a: a.solution.utc_unix_s or 0.0)


def draw_drive(figure: "Figure", answers: Sequence[Watched]) -> None:
    """Draw both places on a map, their distance over time, and what was learned over time."""
    timed = sorted(
        (a for a in answers if a.solution.utc_unix_s is not None), key=lambda a: a.solution.utc_unix_s or 0.0
    )
    begin_s = timed[0].solution.utc_unix_s or 0.0
    hours = np.array([((a.solution.utc_unix_s or 0.0) - begin_s) / HOUR_S for a in timed])
    above, middle, below = figure.subplots(3, 1, height_ratios=(2.2, 1.1, 1.1))
    _draw_map(above, timed)
    _draw_distance(middle, hours, timed)
    _draw_learned(below, hours, timed)
    below.sharex(middle)
    below.set_xlabel("h after the first frame")


def _draw_map(axes: "Axes", timed: Sequence[Watched]) -> None:
    plain(axes)
    places = [a.compared.place for a in timed if a.compared is not None]
    grounds = [a.ground for a in timed if a.ground is not None]
    first = places[0] if places else grounds[0]

    def km(latitude: float, longitude: float) -> np.ndarray:
        here = GnssPlace(utc_unix_s=0.0, latitude=latitude, longitude=longitude, covariance=np.eye(2))
        return here.from_place_m(first.latitude, first.longitude) / 1000

    if grounds:
        stars = np.array([km(g.latitude, g.longitude) for g in grounds])
        sigma = np.array([np.sqrt(np.diag(g.covariance)[:2]) / 1000 for g in grounds])
        axes.errorbar(stars[:, 0], stars[:, 1], xerr=sigma[:, 0], yerr=sigma[:, 1], fmt="o", color=BLUE, ecolor=SKY,
                      ms=3, elinewidth=0.7, alpha=0.8, label="stars, 1 sigma")  # fmt: skip
    for status, colour in COLOURS.items():
        which = [
            a.compared.place for a in timed if a.compared is not None and a.compared.check.status == status
        ]
        if which:
            seen = np.array([km(p.latitude, p.longitude) for p in which])
            axes.plot(
                *seen.T,
                "D",
                color=colour,
                ms=4,
                mec="black",
                mew=0.4,
                label=f"GNSS, {status}",
                zorder=3,
            )
    axes.set(xlabel="east, km", ylabel="north, km")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _draw_distance(axes: "Axes", hours: np.ndarray, timed: Sequence[Watched]) -> None:
    plain(axes)
    for status, colour in COLOURS.items():
        rows = [
            (h, a.compared.check.distance_m, a.compared.check.sigma_m)
            for h, a in zip(hours, timed, strict=True)
            if a.compared is not None and a.compared.check.status == status
        ]
        if rows:
            h, distance, sigma = np.array(rows).T
            axes.errorbar(h, distance, sigma, fmt="o", ms=3, color=colour, elinewidth=0.8, alpha=0.8)
    axes.set_yscale("log")
    axes.set_ylabel("GNSS from\nthe stars, m")
    axes.tick_params(labelbottom=False)


def _draw_learned(axes: "Axes", hours: np.ndarray, timed: Sequence[Watched]) -> None:
    plain(axes)
    known = [(h, a.learned) for h, a in zip(hours, timed, strict=True) if a.learned is not None]
    if known:
        h = [at for at, _ in known]
        across, about = np.array([learned.a3_stddev_rad for _, learned in known]).T / ARCSEC
        deflection = np.array([learned.deflection_stddev_rad for _, learned in known]) / ARCSEC
        axes.plot(h, across, color=BLUE, label="A3 across the plumb line")
        axes.plot(h, about, color=PURPLE, label="A3 about it")
        axes.plot(h, deflection, color=GREEN, label="deflection")
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    axes.set_yscale("log")
    axes.set_ylabel("learned,\n1 sigma, arcsec")
