# SPDX-License-Identifier: Apache-2.0
"""The lines, JSON keys and CSV columns of fixes: of a frame, and of a night together."""

from collections.abc import Sequence

import numpy as np

from starpos.averaging.average import Average
from starpos.cli.archive import NightFolder
from starpos.cli.output import Output
from starpos.earth.orientation import measured_until, table_age_days
from starpos.earth.vertical import Geodetic, Vertical, geodetic
from starpos.fix.fix import Fix
from starpos.fix.readable import InDegrees, length_text
from starpos.fix.solution import Solution, Status
from starpos.night.together import Solved
from starpos.utc import utc_text

# numbers of an average that are printed
COUNTS = ("frames", "poses", "left_out", "moved")
# the first line for people
HEAD = (
    "file: latitude and longitude (deg, astronomic: by the plumb line) +- 1 sigma, heading (deg, from true "
    "north over east) +- 1 sigma"
)
# columns of --csv: keys of --json with a single value
COLUMNS = ("file", "combined", "night", "status", "utc", "latitude", "longitude", "heading", "latitude_geodetic",
           "longitude_geodetic", "sigma_east_m", "sigma_north_m", "sigma_heading_deg", "stars_detected",
           "stars_matched", "residual_arcsec", "log_odds", "warnings", "frames")  # fmt: skip
JSON_HELP = (
    "one JSON object a frame, and one with combined: true for all: latitude, longitude and heading are astronomic, in "
    "deg, their ..._geodetic on WGS 84, covariance (3 x 3) is of east m, north m, heading deg, budget 1 sigma of each "
    "source; status is ok, or why there is no fix, which is null then"
)
CSV_HELP = "a row of a CSV a frame, and one with combined=True for all; columns as the keys of --json"


FIX_KEYS = ("utc", "latitude", "longitude", "heading", "latitude_geodetic", "longitude_geodetic", "sigma_east_m",
            "sigma_north_m", "sigma_heading_deg", "covariance", "covariance_geodetic", "xi_arcsec", "eta_arcsec",
            "deflection_stddev_arcsec", "budget")  # fmt: skip


def json_of(fix: Fix | Average | None, vertical: Vertical) -> dict:
    """The keys of --json that come from a fix; all None without a fix."""
    if fix is None:
        return dict.fromkeys(FIX_KEYS)
    ground = geodetic(fix.latitude, fix.longitude, fix.heading, fix.covariance, vertical)
    return json_on_ground(fix, ground)


def json_on_ground(fix: Fix | Average, ground: Geodetic) -> dict:
    """The keys of --json that come from a fix with its geodetic place."""
    covariance = in_degrees(fix.covariance)
    sigma = np.sqrt(np.diag(covariance))
    values = (
        utc_text(fix.utc_unix_s),
        np.degrees(fix.latitude),
        np.degrees(fix.longitude),
        np.degrees(fix.heading),
        np.degrees(ground.latitude),
        np.degrees(ground.longitude),
        *sigma,
        covariance,
        in_degrees(ground.covariance),
        ground.deflection.xi_arcsec,
        ground.deflection.eta_arcsec,
        ground.deflection.stddev_arcsec,
        budget_of(fix, ground),
    )
    return dict(zip(FIX_KEYS, values, strict=True))


def counted(frames: int) -> str:
    """A number of frames in words."""
    return "1 frame" if frames == 1 else f"{frames} frames"


def in_degrees(covariance: np.ndarray) -> np.ndarray:
    """A covariance (3, 3) of east m, north m, heading rad with the heading in deg instead."""
    unit = np.array([1.0, 1.0, np.degrees(1.0)])
    return covariance * np.outer(unit, unit)


def budget_of(fix: Fix | Average, ground: Geodetic) -> dict:
    """1 sigma (3,) of each source: east m, north m, heading deg; the deflection acts on the geodetic place only."""
    terms = {t.name: np.sqrt(np.diag(t.covariance)[:3]) * [1, 1, np.degrees(1)] for t in fix.terms}
    terms["deflection (geodetic only)"] = np.sqrt(np.diag(ground.deflection_covariance)) * [
        1,
        1,
        np.degrees(1),
    ]
    return terms


def json_about(s: Solution) -> dict:
    """The keys of --json about the stars of a frame."""
    a, fitted = s.attitude, s.fix or s.at_place
    return {
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.names),
        "residual_arcsec": fitted.residual_arcsec if fitted else None,
        "log_odds": a.log_odds if a else None,
        "status": s.status.value,
        "warnings": list(s.warnings),
        "remark": s.remark or None,
    }


def line_of(path: str, s: Solution, turning: bool) -> str:
    """The line of a frame; turning: its place needs the other headings."""
    if s.fix is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    # one frame of a turn does not determine A3, so the error of its own place would exceed 1000 km
    where = "its place waits for the whole turn" if turning else str(s.fix.in_degrees)
    stars = f", {len(s.names)} of {s.stars_detected} stars" if s.stars_detected else ""
    return f"{path}: {where}{stars}"


def put_combined(
    output: Output,
    night: NightFolder,
    all_together: Average | None,
    solved: Sequence[Solved],
    warnings: set[str],
    vertical: Vertical,
    about: dict | None = None,
) -> None:
    """Write the average of a night, or that it is missing; about: more keys of JSON."""
    name = {} if night.folder is None else {"night": night.folder}
    counts = dict.fromkeys(COUNTS) if all_together is None else {k: getattr(all_together, k) for k in COUNTS}
    of_stars = {
        "stars_detected": sum(s.stars_detected for s in solved),
        "stars_matched": sum(s.stars_matched for s in solved),
        "residual_arcsec": np.sqrt(np.mean([s.fix.residual_arcsec**2 for s in solved] or [np.nan])),
        "log_odds": sum(s.log_odds for s in solved) if solved else None,
        "status": (Status.OK if all_together else Status.POOR_FIT).value,
        "warnings": sorted(warnings),
    }
    age_days = table_age_days(all_together.utc_unix_s) if all_together else None
    output.put(
        {"combined": True}
        | name
        | counts
        | json_of(all_together, vertical)
        | of_stars
        | {"iers_table_age_days": age_days}
        | (about or {}),
        "" if all_together is None else _lines_of(night, all_together, vertical),
    )


def _lines_of(night: NightFolder, together: Average, vertical: Vertical) -> str:
    """The lines of an average: its place, the place on WGS 84, the sources of error, the IERS table."""
    ground = geodetic(together.latitude, together.longitude, 0.0, together.covariance, vertical)
    turned = f" (the last of {together.poses} poses)" if together.poses > 1 else ""
    folder = "" if night.folder is None else f"{night.folder}: "
    on_ground = InDegrees.of(ground.latitude, ground.longitude, 0.0, ground.covariance)
    frames = counted(together.frames) + ("" if together.frames == 1 else " together")
    lines = [
        f"{folder}{frames}: {together.in_degrees}{turned} (astronomic)",
        f"geodetic, WGS 84: {on_ground.where} (the deflection of the vertical included)",
        "where the error comes from, 1 sigma of each source in the place and the heading:",
    ]
    for name, (east, north, heading) in budget_of(together, ground).items():
        turn = "" if np.isnan(together.heading) else f" {heading * 3600:8.2f} arcsec"
        lines.append(f"  {name:<28} {length_text(east, 2):>10} E {length_text(north, 2):>10} N{turn}")
    age_days = table_age_days(together.utc_unix_s)
    where = f"{age_days:.0f} days before" if age_days > 0 else "after"
    lines.append(
        f"Earth rotation: IERS table, measured until {utc_text(measured_until())[:10]}, {where} these frames"
    )
    return "\n".join(lines)
