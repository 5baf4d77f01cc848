# SPDX-License-Identifier: Apache-2.0
"""Figures of a night: its place, its frames, the drive next to GNSS, and the sky that it saw."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.earth.orientation import EarthState, earth_state
from starpos.earth.place import Place
from starpos.fix.fix import PlaceFix, frame_to_icrs
from starpos.fix.solution import FieldPointing
from starpos.gnss.solving import Watched
from starpos.gnss.watch import GnssStatus
from starpos.instrument.camera import Camera
from starpos.night.night import Night, Shot
from starpos.report import measures
from starpos.report.measures import Stability
from starpos.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, figures_of, number_axis, plain
from starpos.sky.catalogue import Catalogue
from starpos.sky.site import Site
from starpos.units import ARCSEC, HOUR_S, utc_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# more points than this are drawn small, with a band instead of bars
MANY = 150
# A scatter that reaches farther is drawn in km.
FAR_M = 10_000.0
# In m or arcsec.
SMALLEST_SHOWN = 1e-3


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
            bars = axes.barh(at, np.maximum(np.nan_to_num(row), low), height, color=colour, label=label)
            axes.bar_label(bars, list(map(_short, row)), padding=2, fontsize=7, color="#333333")
        axes.set_xscale("log")
        axes.set_xlim(low, top * 12)
        axes.set_xlabel(title)
    panels[0].set_yticks(np.arange(len(names)), [n.replace(" (", "\n(") for n in names])
    panels[1].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=9, frameon=False)


def _short(value: float) -> str:
    if np.isnan(value):
        return "none"
    return "0" if value == 0 else figures_of(value, 2) if value >= SMALLEST_SHOWN else f"< {SMALLEST_SHOWN:g}"


def _shares(place: PlaceFix, night: Night) -> dict[str, np.ndarray]:
    """1 sigma (3,) of each source: east m, north m, heading arcsec; the latter is NaN if there is no heading."""
    roots = place.budget(place.on_ground(night.vertical))
    shares = {name: root * [1, 1, 1 / ARCSEC] for name, root in roots.items()}
    shares = {name: share for name, share in shares.items() if share.max() >= SMALLEST_SHOWN}
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


def draw_health(figure: "Figure", night: Night) -> None:
    """Draw stars, residual, tilt and working time of every frame against time."""
    shots = night.shots
    at, label = _times(shots)
    panels = figure.subplots(4, 1, sharex=True)
    mark, size = ("o", 3.5) if len(shots) <= MANY else (".", 2.5)

    points: dict[str, Any] = {"ms": size, "ls": "none", "marker": mark}

    def draw(
        axes: "Axes", values: Sequence[float] | np.ndarray, colour: str, label: str = "", **more: Any
    ) -> None:
        axes.plot(at, values, color=colour, label=label, **points | more)

    draw(panels[0], [s.stars_detected for s in shots], ORANGE, "detected", ms=1.8 * size, mfc="none")
    draw(panels[0], [s.stars_matched for s in shots], BLUE, "in the fix")
    panels[0].set_ylabel("stars")
    panels[0].set_ylim(0, 1.15 * max(1, *(s.stars_detected for s in shots)))
    _legend(panels[0])
    residual = np.array([s.residual_arcsec for s in shots])
    draw(panels[1], residual, BLUE)
    panels[1].set_ylabel("residual,\narcsec")
    panels[1].set_ylim(0, 1.2 * np.nanmax(np.append(residual, 1e-3)))
    tilt = np.degrees([s.tilt for s in shots]) * 3600
    known = np.isfinite(tilt).all(1)
    mean = tilt[known].mean(0) if known.any() else np.zeros(2)
    for k, (axis, colour) in enumerate((("x", GREEN), ("y", PURPLE))):
        draw(panels[2], tilt[:, k] - mean[k], colour, f"{axis} about {mean[k] / 3600:+.4f}°")
    panels[2].set_ylabel("tilt,\narcsec")
    _legend(panels[2])
    seconds = np.array([[s.identify_s, s.fix_s] for s in shots]) * 1e3
    draw(panels[3], seconds[:, 0], ORANGE, "identification")
    draw(panels[3], seconds[:, 1], BLUE, "fix")
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


COLOURS = {
    GnssStatus.LEARNING: GREY,
    GnssStatus.AGREES: GREEN,
    GnssStatus.DOUBTFUL: ORANGE,
    GnssStatus.DISAGREES: RED,
}


def timed_of(answers: Sequence[Watched]) -> list[Watched]:
    """The answers to frames whose time is known, in its order."""
    return sorted((a for a in answers if a.solution.utc_unix_s is not None), key=_time_of)


def _time_of(answer: Watched) -> float:
    return answer.solution.utc_unix_s or 0.0


def draw_drive(figure: "Figure", timed: Sequence[Watched]) -> None:
    """Draw both places of `timed_of` answers on a map, their distance over time, and what was learned over time."""
    hours = np.array([(_time_of(a) - _time_of(timed[0])) / HOUR_S for a in timed])
    above, middle, below = figure.subplots(3, 1, height_ratios=(2.2, 1.1, 1.1))
    _draw_map(above, timed)
    _draw_distance(middle, hours, timed)
    _draw_learned(below, hours, timed)
    below.sharex(middle)
    below.set_xlabel("h after the first frame")


def _draw_map(axes: "Axes", timed: Sequence[Watched]) -> None:
    plain(axes)
    grounds = [a.ground for a in timed if a.ground is not None]
    first = next(a.compared.place for a in timed if a.compared is not None)

    def km(latitude: float, longitude: float) -> np.ndarray:
        here = Place.on_ellipsoid(*np.degrees([latitude, longitude]).tolist())
        return here.offset_m(first.latitude, first.longitude) / 1000

    if grounds:
        stars = np.array([km(g.latitude, g.longitude) for g in grounds])
        sigma = np.array([np.sqrt(np.diag(g.covariance)[:2]) / 1000 for g in grounds])
        axes.errorbar(stars[:, 0], stars[:, 1], xerr=sigma[:, 0], yerr=sigma[:, 1], fmt="o", color=BLUE, ecolor=SKY,
                      ms=3, elinewidth=0.7, alpha=0.8, label="stars, 1 sigma")  # fmt: skip
    for status, colour in COLOURS.items():
        which = [a.compared.place for a in timed if a.compared is not None and a.compared.status == status]
        if which:
            seen = np.array([km(p.latitude, p.longitude) for p in which])
            axes.plot(
                *seen.T, "D", color=colour, ms=4, mec="black", mew=0.4, label=f"GNSS, {status}", zorder=3
            )
    axes.set(xlabel="east, km", ylabel="north, km")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _draw_distance(axes: "Axes", hours: np.ndarray, timed: Sequence[Watched]) -> None:
    plain(axes)
    for status, colour in COLOURS.items():
        rows = [
            (h, a.compared.distance_m, a.compared.sigma_m)
            for h, a in zip(hours, timed, strict=True)
            if a.compared is not None and a.compared.status == status
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


# maximum number of frames shown with outline and stars
OUTLINES = 12
# number of the brightest stars that are shown, whether a frame saw them or not
BRIGHT = 60
REACHES_DEG = (5, 10, 15, 20, 30, 45, 60, 90)
FAINTEST_DOT = 11.0


@dataclass(frozen=True)
class View:
    """A frame whose pointing is known, with its size in px."""

    shot: Shot
    pointing: FieldPointing
    size: tuple[int, int]

    def directions(self, xy: np.ndarray) -> np.ndarray:
        """ICRS directions (N, 3) of pixels xy (N, 2), without distortion."""
        camera = Camera.from_focal(*self.size, self.pointing.focal_px, self.pointing.model)
        return camera.directions(*xy.T) @ _axes(self.pointing)


def views(night: Night) -> list[View]:
    """The frames of a night of which it is known where they looked."""
    return [
        View(s, s.pointing, s.size)
        for s in night.shots
        if s.pointing is not None and s.size is not None and np.isfinite(s.utc_unix_s)
    ]


def draw_sky(figure: "Figure", night: Night, catalogue: Catalogue) -> None:
    """Draw north on top, east to the right, the zenith in the middle; needs a fix and one of the `views`."""
    axes: Any = figure.subplots(subplot_kw={"projection": "polar"})
    place = night.combined or night.places[0]
    site = Site(np.degrees(place.latitude), np.degrees(place.longitude), night.atmosphere)
    seen = views(night)
    centres = np.concatenate(
        [site.refracted(_axes(v.pointing)[2:], earth_state(v.shot.utc_unix_s)) for v in seen]
    )
    shown = _different(seen, centres)
    outlines = [site.refracted(_outline(v), earth_state(v.shot.utc_unix_s)) for v in shown]
    reach = _reach(np.concatenate(outlines))
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    middle_unix_s = float(np.median([v.shot.utc_unix_s for v in seen]))
    _bright(axes, site, earth_state(middle_unix_s), catalogue, reach)
    for view, outline in zip(shown, outlines, strict=True):
        shot = view.shot
        axes.plot(*polar(outline), color=ORANGE, lw=1.3)
        if len(shot.xy):
            stars = site.refracted(view.directions(shot.xy), earth_state(shot.utc_unix_s))
            axes.scatter(*polar(stars), s=_dot(shot.magnitudes), color=BLUE, lw=0, zorder=3)
    axes.plot(*polar(centres), "+", color=ORANGE, ms=7, mew=1.4, zorder=4)
    axes.set_rlim(0, reach)
    axes.set_xticks(np.radians(np.arange(0, 360, 45)), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    rings = np.linspace(0, reach, 4)[1:]
    axes.set_rgrids(rings, [f"{r:.3g}°" for r in rings], angle=22.5, fontsize=8, color=GREY)
    axes.grid(alpha=0.3, lw=0.6)
    _sky_legend(axes)


def _sky_legend(axes: "Axes") -> None:
    from matplotlib.lines import Line2D

    def dot(colour: str, magnitude: float, text: str, **more: Any) -> Line2D:
        size = np.sqrt(_dot(np.array([magnitude]))[0])
        return Line2D([], [], ls="none", marker="o", color=colour, ms=size, mew=0, label=text, **more)

    axes.legend(
        handles=[
            Line2D([], [], color=ORANGE, marker="+", ms=7, lw=1.3, label="a frame and its centre"),
            *(dot(BLUE, m, f"identified, V {m}") for m in (6, 8, 10)),
            dot(GREY, 3, "bright star, V 3", alpha=0.6),
        ],
        loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=3, fontsize=9, frameon=False,
    )  # fmt: skip


def _dot(magnitude: np.ndarray) -> np.ndarray:
    """Area of a star's dot in points squared."""
    return 1.2 + 1.1 * np.clip(FAINTEST_DOT - np.nan_to_num(magnitude, nan=9.0), 0, None) ** 1.7


def _bright(axes: "Axes", site: Site, state: EarthState, catalogue: Catalogue, reach: float) -> None:
    """Draw the brightest stars up to a zenith distance `reach` in deg."""
    index = site.overhead(catalogue, state, np.array([0.0, 0.0, 1.0]), np.radians(reach), 6.5)[:BRIGHT]
    v = site.observed(catalogue, index, state)
    theta, r = polar(v)
    inside = r < reach
    size = _dot(catalogue.vmag(index))
    axes.scatter(theta[inside], r[inside], s=size[inside], color=GREY, alpha=0.6, lw=0, zorder=2)


def polar(enu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth (N,) in rad and zenith distance (N,) in deg of directions (N, 3) in ENU."""
    return np.arctan2(enu[:, 0], enu[:, 1]), np.degrees(np.arctan2(np.hypot(enu[:, 0], enu[:, 1]), enu[:, 2]))


def _axes(a: FieldPointing) -> np.ndarray:
    """Camera axes (3, 3) in ICRS: its rows are x (along columns), y (along rows) and z."""
    axes = frame_to_icrs(a.ra, a.dec, a.roll).T
    return axes * [[-1], [1], [1]] if a.mirrored else axes


def _outline(view: View) -> np.ndarray:
    """ICRS directions (N, 3) along the edge of a frame."""
    width, height = view.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], float) - 0.5
    steps = np.linspace(0, 1, 9)[:-1, None]
    sides = [a + (b - a) * steps for a, b in pairwise(corners)]
    return view.directions(np.concatenate([*sides, corners[:1]]))


def _different(seen: Sequence[View], centres: np.ndarray) -> list[View]:
    """Frames that look elsewhere than all before them, OUTLINES at most."""
    kept: list[int] = []
    for k, view in enumerate(seen):
        field = 0.5 * view.size[1] / view.pointing.focal_px
        if all(np.linalg.norm(centres[k] - centres[j]) > field for j in kept):
            kept.append(k)
        if len(kept) == OUTLINES:
            break
    return [seen[k] for k in kept]


def _reach(enu: np.ndarray) -> float:
    """Zenith distance in deg at the edge of the map, so that all directions (N, 3) are on it."""
    furthest = 1.08 * polar(enu)[1].max()
    return next((r for r in REACHES_DEG if r >= furthest), 90)
