# SPDX-License-Identifier: Apache-2.0
"""The figures of a night, each with a caption: what it shows, and what would be suspicious."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from starpos.calibration import residual_map
from starpos.errors import TimeError
from starpos.gnss.solving import Watched
from starpos.gnss.watch import GnssStatus
from starpos.night.night import Night
from starpos.report import coast, drive_figure, frame_figures, measures, place_figures, sky_figure
from starpos.report.html import Picture
from starpos.report.style import figures_of, mark_simulated, new_figure, png_of
from starpos.sky.catalogue import Catalogue
from starpos.utc import utc_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def pictures_of(night: Night, catalogue: Catalogue) -> Iterator[Picture]:
    """All figures that a night has data for; without a fix only the health of its frames."""
    if night.fixed:
        yield from _place_pictures(night)
        if (over := frame_figures.overlaid(night)) is not None:
            yield _residuals(night, *over)
        # the time of a recorded solution may lie outside the tables of the Earth's rotation
        with suppress(TimeError):
            if sky_figure.views(night):
                yield _drawn(night.simulated, "sky", "Where the camera looked", _sky_caption(), 6.4,
                         lambda f: sky_figure.draw_sky(f, night, catalogue))  # fmt: skip
    if night.shots:
        if night.watched is not None and drive_figure.compared_of(night.watched.answers):
            answers = night.watched.answers
            yield _drawn(night.simulated, "drive", "The drive beside GNSS", _drive_caption(answers), 8.6,
                         lambda f: drive_figure.draw_drive(f, answers))  # fmt: skip
        yield _drawn(
            night.simulated,
            "health",
            "Frame by frame",
            HEALTH,
            6.4,
            lambda f: frame_figures.draw_health(f, night),
        )


def nights_picture(nights: Sequence[tuple[int, Night]]) -> Picture:
    """The errors of numbered nights whose truth is known, at least one."""
    simulated = all(night.simulated for _, night in nights)
    return _drawn(
        simulated,
        "nights",
        "Error of the nights",
        NIGHTS,
        5.0,
        lambda f: place_figures.draw_nights(f, nights),
    )


def _place_pictures(night: Night) -> Iterator[Picture]:
    ground = (night.combined or night.places[0]).on_ground(night.vertical)
    yield _drawn(night.simulated, "map", "Where on Earth", MAP, 6.6,
                 lambda f: coast.draw_map(f, ground.latitude, ground.longitude))  # fmt: skip
    if night.steady is not None:
        s = measures.steadiness(night, night.steady)
        yield _drawn(night.simulated, "stability", "Stability: one tilt for all frames",
                     _stability_caption(s, STEADY), 6.8, lambda f: place_figures.draw_stability(f, s))  # fmt: skip
    if len(night.fixed) > 1:
        each = measures.stability(night)
        yield _drawn(night.simulated, "frames", "Each frame with its own tilt", _stability_caption(each, EACH), 6.8,
                     lambda f: place_figures.draw_stability(f, each))  # fmt: skip
    yield _drawn(night.simulated, "scatter", "Scatter of the fixes", _scatter_caption(night), 6.4,
                 lambda f: place_figures.draw_scatter(f, night))  # fmt: skip
    if night.places[0].terms:
        yield _drawn(
            night.simulated,
            "budget",
            "Error budget",
            BUDGET,
            5.6,
            lambda f: place_figures.draw_budget(f, night),
        )


def _drawn(
    simulated: bool, name: str, title: str, caption: str, height_in: float, draw: "Callable[[Figure], None]"
) -> Picture:
    figure = new_figure(height_in)
    draw(figure)
    if simulated:
        mark_simulated(figure)
        caption = f"Simulated. {caption}"
    return Picture(name, title, caption, png_of(figure))


MAP = (
    "The place in the middle, north on top, a line every 30 degrees; the lens shows 1100 km around it, a line every 5. "
    "Coast lines: Natural Earth 1:110m, public domain; small islands are left out. Suspicious: another country."
)
STEADY = (
    "The paper's stability test: the camera stood still, so all frames take the mean tilt of the night, and what is left "
    "is what stars and air do. The bars are the errors claimed for the stars. Suspicious: a slope (the tripod settles, "
    "or the clock drifts), a step (somebody touched it), points far beyond their bars (seeing, focus, distortion)."
)
EACH = (
    "Every fix less the mean of all, with the readings of its own exposure; the bars are 1 sigma of what is new in each "
    "frame, mostly the inclinometer's noise, which the paper's figures do not hold. Suspicious: more than a third of the "
    "points beyond their bars, a slope, a step, a wave that follows the heading (an error of A3 turns with the mount)."
)
BUDGET = (
    "1 sigma of every source of error, largest on top, on a logarithmic scale. What an average leaves as it is, is "
    "common to all frames: only a better calibration, clock or barometer makes it smaller. Suspicious: a source that is "
    "larger than the instrument's data sheet allows, such as centroids above a few metres."
)
RESIDUALS = (
    "Where stars were seen less where the fit has them, all frames overlaid; where they are "
    "many, the mean of each cell. Random arrows are noise; a pattern is the "
    "camera's: arrows to or from the middle are radial distortion, all one way in one half a tilted sensor, a corner of "
    "its own a decentred lens: calibrate the camera."
)
HEALTH = (
    "What each frame had to work with. Crosses at the bottom are frames without a fix. Suspicious: stars that come and "
    "go (clouds, dew), a residual that rises (focus, wind), a tilt that drifts or jumps (the mount), slow "
    "identification."
)
DRIVE = (
    "Above, the stars' own places, each with what was learned before it, and the GNSS places in the colour of what the "
    "guard said. In the middle, how far they are apart; below, how well A3 and the deflection were known. Suspicious: a "
    "distance that grows evenly (a drag)."
)
NIGHTS = (
    "Combined fix of each night less its truth, astronomic, with the 1 sigma that is claimed. Suspicious: errors beyond "
    "twice their bars in more than one night of twenty, or all on one side: the calibration has changed."
)


def _drive_caption(answers: Sequence[Watched]) -> str:
    compared = drive_figure.compared_of(answers)
    alarm = next(
        (a for a in compared if a.compared and a.compared.check.status == GnssStatus.DISAGREES), None
    )
    if alarm is None or alarm.compared is None:
        told = "No alarm: GNSS never disagreed."
    else:
        told = f"Alarm at {utc_text(alarm.solution.utc_unix_s or 0.0)}: {alarm.compared.check.sentence}."
    return f"{DRIVE} {told}"


def _stability_caption(s: measures.Stability, text: str) -> str:
    found = int(s.outlier.sum())
    numbers = ", ".join(map(str, s.number[s.outlier][:8])) + (" ..." if found > 8 else "")
    which = f"{found} (frames {numbers})" if found else "none"
    far, own = measures.OUTLIER_SIGMA, measures.CLAIMED_SIGMA
    return f"{text} Outliers, more than {far:g} robust sigma off and {own:g} of their own: {which}."


def _scatter_caption(night: Night) -> str:
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
    return (
        text + " Suspicious: two heaps (the mount slipped), a line (the clock drifts: it is east and west)."
    )


def _residuals(night: Night, xy: np.ndarray, residual_px: np.ndarray, size: tuple[int, int]) -> Picture:
    rms = figures_of(np.sqrt(np.mean(residual_px**2)))
    text = f"{len(xy)} stars, root mean square {rms} px an axis. {RESIDUALS}"
    height = 0.9 + 6.4 * min(size[1] / size[0], 1.6)

    def draw(figure: "Figure") -> None:
        # the key of the arrows lies outside the axes
        figure.set_layout_engine("constrained", rect=(0, 0.06, 1, 0.94))
        residual_map.draw_residuals(figure.subplots(), xy, residual_px, *size)

    return _drawn(night.simulated, "residuals", "Residuals over the frame", text, height, draw)


def _sky_caption() -> str:
    return (
        f"Seen as on a map, the zenith in the middle: at most {sky_figure.OUTLINES} outlines with their identified "
        "stars, and the centre of every frame; grey, the brightest stars of that part of the sky in the middle of the "
        "night. Suspicious: frames far from the zenith (roll and refraction count more there), half a frame empty."
    )
