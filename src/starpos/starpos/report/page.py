# SPDX-License-Identifier: Apache-2.0
"""Writes a night as one HTML page: its numbers, and its figures, each with a caption that says what would be suspicious.
The page holds its pictures and loads nothing, and all text that comes from files is escaped.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos import __version__
from starpos.averaging.average import Average
from starpos.calibration import residual_map
from starpos.errors import TimeError
from starpos.files import rows_of
from starpos.fix.fix import PlaceFix, length_text
from starpos.gnss.solving import Watched
from starpos.gnss.watch import GnssStatus
from starpos.night.night import Night, Truth
from starpos.report import coast, measures, night_figures, style
from starpos.report.html import document, figures, sexagesimal, table
from starpos.report.style import Picture, figures_of
from starpos.sky.catalogue import Catalogue
from starpos.units import utc_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


TEXTS = Path(__file__).with_name("data") / "figures.yaml"
# name of a figure in data/figures.yaml, what this one shows, and what draws it
_Figure = tuple[str, object, "Callable[[Figure], None]"]


def pictures_of(night: Night, catalogue: Catalogue) -> Iterator[Picture]:
    """All figures that a night has data for; without a fix only the health of its frames."""
    for figure in _figures(night, catalogue):
        # the time of a recorded solution may lie outside the tables of the Earth's rotation
        with suppress(TimeError):
            yield _picture(*figure, night.simulated)


def nights_picture(nights: Sequence[tuple[int, Night]]) -> Picture:
    """The errors of numbered nights whose truth is known, at least one."""
    simulated = all(night.simulated for _, night in nights)
    return _picture("nights", "", lambda f: night_figures.draw_nights(f, nights), simulated)


def _picture(name: str, told: object, draw: "Callable[[Figure], None]", simulated: bool) -> Picture:
    texts = rows_of(TEXTS)[name]
    caption, figure = texts["caption"].format(told=told), style.new_figure(texts["height"])
    draw(figure)
    if simulated:
        style.mark_simulated(figure)
        caption = f"Simulated. {caption}"
    return Picture(name, texts["title"], caption, style.png_of(figure))


def _figures(night: Night, catalogue: Catalogue) -> Iterator[_Figure]:
    draw = night_figures
    if night.fixed:
        ground = (night.combined or night.places[0]).on_ground(night.vertical)
        where = ground.latitude, ground.longitude, ground.covariance[:2, :2]
        yield "map", "", lambda f: coast.draw_map(f, *where)
        if night.steady is not None:
            s = measures.steadiness(night, night.steady)
            yield "stability", _outliers_told(s), lambda f: draw.draw_stability(f, s)
        if len(night.fixed) > 1:
            each = measures.stability(night)
            yield "frames", _outliers_told(each), lambda f: draw.draw_stability(f, each)
        yield "scatter", _scatter_told(night), lambda f: draw.draw_scatter(f, night)
        if night.places[0].terms:
            yield "budget", "", lambda f: draw.draw_budget(f, night)
        if (over := draw.overlaid(night)) is not None:
            yield _residuals(*over)
        if draw.views(night):
            yield "sky", draw.OUTLINES, lambda f: draw.draw_sky(f, night, catalogue)
    timed = [] if night.watched is None else draw.timed_of(night.watched.answers)
    if any(a.compared is not None for a in timed):
        yield "drive", _alarm_told(timed), lambda f: draw.draw_drive(f, timed)
    if night.shots:
        yield "health", "", lambda f: draw.draw_health(f, night)


def _alarm_told(timed: Sequence[Watched]) -> str:
    alarm = next((a for a in timed if a.compared and a.compared.status == GnssStatus.DISAGREES), None)
    if alarm is None or alarm.compared is None:
        return "No alarm: GNSS never disagreed."
    return f"Alarm at {utc_text(alarm.solution.utc_unix_s or 0.0)}: {alarm.compared.sentence}."


def _outliers_told(s: measures.Stability) -> str:
    found = int(s.outlier.sum())
    numbers = ", ".join(map(str, s.number[s.outlier][:8])) + (" ..." if found > 8 else "")
    which = f"{found} (frames {numbers})" if found else "none"
    far, own = measures.OUTLIER_SIGMA, measures.CLAIMED_SIGMA
    return f"Outliers, more than {far:g} robust sigma off and {own:g} of their own: {which}."


def _scatter_told(night: Night) -> str:
    count = len(night.fixed)
    about = "the average" if night.combined else "their mean, for they do not average"
    text = f"Fixes about {about}. Shaded: the errors that are new in every frame"
    if count > 1:
        near, far = (measures.share_inside(night, d) for d in (measures.INSIDE_1_SIGMA, measures.INSIDE_95))
        text += (
            f"; {near} of {count} lie within their own 39 % ellipse and {far} within that of 95 %. "
            f"Expected: {0.39 * count:.0f} and {0.95 * count:.0f}"
        )
    text += ". Outlined: all errors of the average, those common to the frames too."
    if night.truth and night.combined:
        east, north = measures.offset_m(night.truth, *measures.middle(night))
        d2 = np.array([east, north]) @ np.linalg.solve(night.combined.covariance[:2, :2], [east, north])
        verdict = "inside" if d2 <= measures.INSIDE_95 else "OUTSIDE"
        text += f" The truth is {figures_of(np.hypot(east, north))} m from it, {verdict} the 95 % ellipse."
    return text


def _residuals(xy: np.ndarray, residual_px: np.ndarray, size: tuple[int, int]) -> _Figure:
    rms = figures_of(np.sqrt(np.mean(residual_px**2)))

    def draw(figure: "Figure") -> None:
        figure.set_figheight(0.9 + 6.4 * min(size[1] / size[0], 1.6))
        # the key of the arrows lies outside the axes
        figure.set_layout_engine("constrained", rect=(0, 0.06, 1, 0.94))
        residual_map.draw_residuals(figure.subplots(), xy, residual_px, *size)

    return "residuals", f"{len(xy)} stars, root mean square {rms} px an axis.", draw


# maximum number of frames listed by name
LISTED = 200
# number of frames of one status without a fix that say why
REASONS = 5


def page(
    nights: Sequence[Night], each: Sequence[Sequence[Picture]], overall: Sequence[Picture], made_utc: str
) -> str:
    """The HTML of nights.

    each: pictures of each night; overall: pictures of all nights together.
    """
    title = (
        f"starpos report: {nights[0].name}" if len(nights) == 1 else f"starpos report: {len(nights)} nights"
    )
    parts = [f"<h1>{escape(title)}</h1>", figures(overall)]
    for number, (night, pictures) in enumerate(zip(nights, each, strict=True), 1):
        if len(nights) > 1:
            parts.append(f'<h2 id="night{number}">{number}. {escape(night.name)}</h2>')
        parts += [_place(night), _simulated(night), table(_rows(night)), _names(night), figures(pictures)]
    parts.append(
        f"<footer><p>{rows_of(TEXTS)['footer'].format(version=escape(__version__), made=escape(made_utc))}</p></footer>"
    )
    return document(title, parts)


def _simulated(night: Night) -> str:
    return '<p class="bad">Simulated: no camera took these frames.</p>' if night.simulated else ""


def _place(night: Night) -> str:
    """The answer of a night, or the reason why it is missing."""
    if night.combined is None:
        return f'<p class="place bad">No position: {escape(night.why_not)}</p>'
    c = night.combined
    ground = c.on_ground(night.vertical)
    facing = "turned between the frames"
    if np.isfinite(c.heading):
        last = "last " if _poses(c) > 1 else ""
        sigma_deg = np.degrees(np.sqrt(ground.covariance[2, 2]))
        facing = f"{last}heading {np.degrees(ground.heading):.4f} &plusmn; {sigma_deg:.4f}&deg;"
    where = f"{_degrees(ground.latitude)}, {_degrees(ground.longitude)}"
    link = f"geo:{np.degrees(ground.latitude):.6f},{np.degrees(ground.longitude):.6f}"
    errors = _errors(ground.covariance)
    return f'<p class="place"><a href="{link}">{where}</a> {errors} (WGS 84, as on maps), {facing}</p>'


def _poses(place: PlaceFix) -> int:
    return place.poses if isinstance(place, Average) else 1


def _errors(covariance: np.ndarray) -> str:
    """1 sigma of a place to north and east."""
    east, north = np.sqrt(np.diag(covariance)[:2])
    return f"&plusmn; {length_text(north)} N {length_text(east)} E"


def _degrees(angle: float) -> str:
    """An angle in rad as degrees, in the form that `starpos solve` prints."""
    return f"{np.degrees(angle):+.6f}&deg;"


def _rows(night: Night) -> Iterator[tuple[str, str]]:
    """Names and texts in HTML of what is known of a night."""
    if night.combined:
        yield from _rows_on_place(night.combined, night)
    lost = [s for s in night.shots if s.place is None]
    failed = Counter(s.status.value for s in lost)
    counts = "".join(f", {n} {escape(why)}" for why, n in failed.most_common())
    yield "Frames", f"{len(night.shots)}: {len(night.fixed)} with a fix{counts}"
    told: Counter[str] = Counter()
    for s in lost:
        told[s.status.value] += 1
        if told[s.status.value] <= REASONS:
            yield f"&lsquo;{escape(s.status.value)}&rsquo;", escape(s.message)
    warned = Counter(warning for s in night.shots for warning in s.warnings)
    if warned:
        yield "Warnings", ", ".join(f"{n} {escape(what)}" for what, n in sorted(warned.items()))
    times = [s.utc_unix_s for s in night.shots if np.isfinite(s.utc_unix_s)]
    if times:
        yield "From, to", f"{escape(utc_text(min(times)))}, {escape(utc_text(max(times)))}"
    if night.fixed:
        yield from _rows_on_fixes(night)
    yield "Source", escape(night.origin)
    for remark in night.remarks:
        yield "Note", escape(remark)


def _rows_on_place(c: PlaceFix, night: Night) -> Iterator[tuple[str, str]]:
    ground = c.on_ground(night.vertical)
    yield (
        "WGS 84",
        f"{sexagesimal(ground.latitude, 'NS')}, {sexagesimal(ground.longitude, 'EW')}, {_errors(ground.covariance)}, "
        "the deflection of the vertical included",
    )
    where = f"{_degrees(c.latitude)}, {_degrees(c.longitude)} {_errors(c.covariance)}"
    yield "By the plumb line (astronomic)", where
    heading = "none in common: the instrument turned between the frames"
    if np.isfinite(c.heading):
        last = f", of the last of {_poses(c)} poses" if _poses(c) > 1 else ""
        heading = (
            f"{np.degrees(c.heading):.4f} &plusmn; {np.degrees(c.sigma[2]):.4f}&deg; from astronomic north, "
            f"{np.degrees(ground.heading):.4f}&deg; from true north on WGS 84{last}"
        )
    yield "Heading", heading
    if night.truth:
        yield "Error against the truth", _error(c, night.truth)


def _rows_on_fixes(night: Night) -> Iterator[tuple[str, str]]:
    shots = [s for _, s in night.fixed]

    def median(name: str) -> float:
        return float(np.median([getattr(s, name) for s in shots]))

    yield (
        "Stars, median",
        f"{median('stars_detected'):.0f} detected, {median('stars_matched'):.0f} in the fix",
    )
    yield "Residual, median", f"{figures_of(median('residual_arcsec'))}&Prime;"
    identify, fix = (figures_of(1e3 * median(name)) for name in ("identify_s", "fix_s"))
    yield "Time, median", f"{identify} ms identification, {fix} ms fix"
    if len(shots) > 1:
        lat, lon, _ = (figures_of(v) for v in measures.stability(night).mean_absolute)
        off = f"latitude {lat}&Prime;, longitude {lon}&Prime;, each with its own tilt"
        yield "Mean absolute deviation", off
    if night.steady is not None:
        lat, lon, north = (figures_of(v) for v in measures.steadiness(night, night.steady).mean_absolute)
        yield (
            "Stability",
            f"latitude {lat}&Prime;, longitude {lon}&Prime;, north {north}&Prime; with one tilt for all (the paper's "
            "0.526&Prime;, 1.70&Prime;, 6.34&Prime;)",
        )


def _error(place: PlaceFix, truth: Truth) -> str:
    east, north = measures.offset_m(place, truth.latitude, truth.longitude)
    latitude, longitude = measures.error_arcsec(place, truth)
    return (
        f"{figures_of(np.hypot(east, north))} m: {east:+.0f} m E {north:+.0f} m N, latitude {latitude:+.2f}&Prime;, "
        f"longitude {longitude:+.2f}&Prime;"
    )


def _names(night: Night) -> str:
    names = [s.name for s in night.shots]
    more = f" ... and {len(names) - LISTED} more" if len(names) > LISTED else ""
    listed = escape(", ".join(names[:LISTED])) + more
    summary = f"Input: {escape(night.name)}, {len(names)} frames"
    return f'<details class="soft"><summary>{summary}</summary><p>{listed}</p></details>'
