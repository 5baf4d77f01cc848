# SPDX-License-Identifier: Apache-2.0
"""Writes a night as one HTML page.

The page holds its pictures and loads nothing, and all text that comes from files is escaped.
"""

from collections import Counter
from collections.abc import Sequence
from html import escape

import numpy as np

from starpos import __version__
from starpos.fix.readable import length_text
from starpos.night.night import Night, ReportedPlace, Truth
from starpos.report import measures
from starpos.report.html import Picture, document, figures, sexagesimal, table, wide_table
from starpos.report.style import figures_of
from starpos.utc import utc_text

# maximum number of frames listed by name
LISTED = 200


def page(
    nights: Sequence[Night], each: Sequence[Sequence[Picture]], overall: Sequence[Picture], made_utc: str
) -> str:
    """The HTML of nights.

    each: pictures of each night, all empty if the nights are too many; overall: pictures of all nights together.
    """
    title = (
        f"starpos report: {nights[0].name}" if len(nights) == 1 else f"starpos report: {len(nights)} nights"
    )
    parts = [f"<h1>{escape(title)}</h1>"]
    if len(nights) > 1:
        parts += [_table_of_nights(nights), figures(overall)]
        if not any(each):
            parts.append(
                '<p class="soft">Too many nights for the figures of each: report on fewer to see them.</p>'
            )
    for number, (night, pictures) in enumerate(zip(nights, each, strict=True), 1):
        if len(nights) > 1:
            parts.append(f'<h2 id="night{number}">{number}. {escape(night.name)}</h2>')
        parts += [_place(night), _simulated(night), _summary(night), figures(pictures)]
    parts.append(
        f"<footer><p>Made by starpos {escape(__version__)} on {escape(made_utc)}. Positions are astronomic unless "
        "said otherwise; errors are 1 sigma. The paper is Izadmehr &amp; Khakian Ghomi, &ldquo;Design and construction "
        "of a high resolution, portable and low-cost positioner by a star tracking system&rdquo;.</p></footer>"
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
        last = "last " if c.poses > 1 else ""
        sigma_deg = np.degrees(np.sqrt(ground.covariance[2, 2]))
        facing = f"{last}heading {np.degrees(ground.heading):.4f} &plusmn; {sigma_deg:.4f}&deg;"
    where = f"{_degrees(ground.latitude)}, {_degrees(ground.longitude)}"
    link = f"geo:{np.degrees(ground.latitude):.6f},{np.degrees(ground.longitude):.6f}"
    errors = _errors(ground.covariance)
    return f'<p class="place"><a href="{link}">{where}</a> {errors} (WGS 84, as on maps), {facing}</p>'


def _errors(covariance: np.ndarray) -> str:
    """1 sigma of a place to north and east."""
    east, north = np.sqrt(np.diag(covariance)[:2])
    return f"&plusmn; {length_text(north)} N {length_text(east)} E"


def _degrees(angle: float) -> str:
    """An angle in rad as degrees, in the form that `starpos solve` prints."""
    return f"{np.degrees(angle):+.6f}&deg;"


def _summary(night: Night) -> str:
    rows = []
    if night.combined:
        c = night.combined
        ground = c.on_ground(night.vertical)
        rows.append(("WGS 84", f"{sexagesimal(ground.latitude, 'NS')}, {sexagesimal(ground.longitude, 'EW')}, "
                     f"{_errors(ground.covariance)}, the deflection of the vertical included"))  # fmt: skip
        rows.append(
            (
                "By the plumb line (astronomic)",
                f"{_degrees(c.latitude)}, {_degrees(c.longitude)} {_errors(c.covariance)}",
            )
        )
        if np.isfinite(c.heading):
            text = f"{np.degrees(c.heading):.4f} &plusmn; {np.degrees(c.sigma[2]):.4f}&deg; from astronomic north"
            last = f", of the last of {c.poses} poses" if c.poses > 1 else ""
            rows.append(
                ("Heading", f"{text}, {np.degrees(ground.heading):.4f}&deg; from true north on WGS 84{last}")
            )
        else:
            rows.append(("Heading", "none in common: the instrument turned between the frames"))
    if night.truth and night.combined:
        rows.append(("Error against the truth", _error(night.combined, night.truth)))
    used = len(night.fixed)
    failed = Counter(s.status.value for s in night.shots if s.place is None)
    counts = f"{used} with a fix" + "".join(f", {n} {escape(why)}" for why, n in failed.most_common())
    rows.append(("Frames", f"{len(night.shots)}: {counts}"))
    for why in failed:
        first = next(s for s in night.shots if s.place is None and s.status.value == why)
        rows.append((f"First &lsquo;{escape(why)}&rsquo;", escape(first.message)))
    warned = Counter(warning for s in night.shots for warning in s.warnings)
    if warned:
        rows.append(("Warnings", ", ".join(f"{n} {escape(what)}" for what, n in sorted(warned.items()))))
    times = [s.utc_unix_s for s in night.shots if np.isfinite(s.utc_unix_s)]
    if times:
        rows.append(("From, to", f"{escape(utc_text(min(times)))}, {escape(utc_text(max(times)))}"))
    if used:
        rows += _rows_on_fixes(night)
    rows.append(("Source", escape(night.origin)))
    rows += [("Note", escape(remark.text)) for remark in night.remarks]
    return f"{table(rows)}\n{_names(night)}"


def _rows_on_fixes(night: Night) -> list[tuple[str, str]]:
    shots = [s for _, s in night.fixed]

    def median(values: Sequence[float]) -> float:
        return float(np.median(values))

    detected, matched = (median([getattr(s, k) for s in shots]) for k in ("stars_detected", "stars_matched"))
    identify, fix = (1e3 * median([getattr(s, k) for s in shots]) for k in ("identify_s", "fix_s"))
    s = measures.stability(night)
    rows = [
        ("Stars, median", f"{detected:.0f} detected, {matched:.0f} in the fix"),
        ("Residual, median", f"{figures_of(median([x.residual_arcsec for x in shots]))}&Prime;"),
        ("Time, median", f"{figures_of(identify)} ms identification, {figures_of(fix)} ms fix"),
    ]
    if len(shots) > 1:
        lat, lon, _ = (figures_of(v) for v in s.mean_absolute)
        rows.append(
            (
                "Mean absolute deviation",
                f"latitude {lat}&Prime;, longitude {lon}&Prime;, each with its own tilt",
            )
        )
    if night.steady is not None:
        lat, lon, north = (figures_of(v) for v in measures.steadiness(night, night.steady).mean_absolute)
        rows.append((
            "Stability",
            f"latitude {lat}&Prime;, longitude {lon}&Prime;, north {north}&Prime; with one tilt for all (the paper's "
            "0.526&Prime;, 1.70&Prime;, 6.34&Prime;)",
        ))  # fmt: skip
    return rows


def _error(place: ReportedPlace, truth: Truth) -> str:
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


def _table_of_nights(nights: Sequence[Night]) -> str:
    titles = (
        "",
        "Night",
        "Latitude, longitude on WGS 84",
        "1 sigma",
        "Error N, E, astronomic",
        "Latitude, longitude",
        "Frames",
    )
    rows = []
    for number, n in enumerate(nights, 1):
        cells = ['<span class="bad">no position</span>', "", "", ""]
        if n.combined:
            ground = n.combined.on_ground(n.vertical)
            cells[0] = f"{_degrees(ground.latitude)}, {_degrees(ground.longitude)}"
            cells[1] = _errors(ground.covariance)
        if n.combined and n.truth:
            east, north = measures.offset_m(n.combined, n.truth.latitude, n.truth.longitude)
            cells[2] = f"{north:+.0f} m, {east:+.0f} m"
            cells[3] = ", ".join(f"{v:+.2f}&Prime;" for v in measures.error_arcsec(n.combined, n.truth))
        name = f'<a href="#night{number}">{escape(n.name)}</a>'
        row = [str(number), name, *cells, f"{len(n.fixed)} of {len(n.shots)}"]
        rows.append(row)
    return wide_table(titles, rows)
