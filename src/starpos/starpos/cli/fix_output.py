# SPDX-License-Identifier: Apache-2.0
"""The lines, JSON keys and CSV columns of fixes and of headings at a known place: of a frame, and of a night together."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from starpos.averaging.average import Average
from starpos.averaging.poses import MeanAttitude
from starpos.averaging.sights import SextantSight
from starpos.cli import console, options
from starpos.cli.console import Output
from starpos.earth.orientation import measured_until, table_age_days
from starpos.earth.place import Place
from starpos.earth.vertical import Geodetic, Vertical, geodetic
from starpos.errors import StarposError
from starpos.fix.attitude import Attitude
from starpos.fix.circle import Circle
from starpos.fix.directions import OPTICAL_AXIS, horizontal
from starpos.fix.fix import InDegrees, PlaceFix, length_text
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import Solution, Status, status_of
from starpos.frames.tables import Pointing
from starpos.night.remarks import Near
from starpos.night.together import Together
from starpos.units import utc_text

# numbers of an average that are printed
COUNTS = ("frames", "poses", "left_out", "moved")


def in_degrees(covariance: np.ndarray) -> np.ndarray:
    """A covariance (3, 3) of east m, north m, heading rad with the heading in deg instead."""
    unit = np.array([1.0, 1.0, np.degrees(1.0)])
    return covariance * np.outer(unit, unit)


def budget_of(fix: PlaceFix, ground: Geodetic) -> dict:
    """1 sigma (3,) of each source, as `PlaceFix.budget` has it, with the heading in deg."""
    return {name: root * [1, 1, np.degrees(1)] for name, root in fix.budget(ground).items()}


# the keys of --json that come from a fix and the same place on the ellipsoid
FIX_KEYS: dict[str, Callable[[Any, Geodetic], Any]] = {
    "utc": lambda fix, _: utc_text(fix.utc_unix_s),
    "latitude": lambda fix, _: np.degrees(fix.latitude),
    "longitude": lambda fix, _: np.degrees(fix.longitude),
    "heading": lambda fix, _: np.degrees(fix.heading),
    "latitude_geodetic": lambda _, ground: np.degrees(ground.latitude),
    "longitude_geodetic": lambda _, ground: np.degrees(ground.longitude),
    "sigma_east_m": lambda fix, _: np.sqrt(fix.covariance[0, 0]),
    "sigma_north_m": lambda fix, _: np.sqrt(fix.covariance[1, 1]),
    "sigma_heading_deg": lambda fix, _: np.sqrt(in_degrees(fix.covariance)[2, 2]),
    "covariance": lambda fix, _: in_degrees(fix.covariance),
    "covariance_geodetic": lambda _, ground: in_degrees(ground.covariance),
    "xi_arcsec": lambda _, ground: ground.deflection.xi_arcsec,
    "eta_arcsec": lambda _, ground: ground.deflection.eta_arcsec,
    "deflection_stddev_arcsec": lambda _, ground: ground.deflection.stddev_arcsec,
    "budget": budget_of,
}


def json_of(fix: PlaceFix | None, vertical: Vertical) -> dict:
    """The keys of --json that come from a fix; all None without a fix."""
    return json_on_ground(fix, None if fix is None else fix.on_ground(vertical))


def json_on_ground(fix: PlaceFix | None, ground: Geodetic | None) -> dict:
    """The keys of --json that come from a fix with its geodetic place; all None without one."""
    if fix is None or ground is None:
        return dict.fromkeys(FIX_KEYS)
    return {key: value(fix, ground) for key, value in FIX_KEYS.items()}


def counted(frames: int) -> str:
    """A number of frames in words."""
    return "1 frame" if frames == 1 else f"{frames} frames"


def json_about(s: Solution) -> dict:
    """The keys of --json about the stars of a frame."""
    a, fitted = s.pointing, s.fix or s.at_place
    return {
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.names),
        "residual_arcsec": fitted.residual_arcsec if fitted else None,
        "log_odds": a.log_odds if a else None,
        "status": s.status.value,
        "bodies": list(s.bodies),
        "warnings": list(s.warnings),
        "remark": s.remark or None,
    }


def line_of(path: str, s: Solution, turning: bool) -> str:
    """The line of a frame; turning: its place needs the other headings."""
    if s.circle is not None:
        return f"{path}: {s.message}"
    if s.fix is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    # one frame of a turn does not determine A3, so the error of its own place would exceed 1000 km
    where = "its place waits for the whole turn" if turning else str(s.fix.in_degrees)
    stars = f", {len(s.names)} of {s.stars_detected} stars" if s.stars_detected else ""
    return f"{path}: {where}{stars}"


# the status of a row that gives an elevation
ELEVATION = "elevation alone"


def tell_elevations(
    args: argparse.Namespace,
    output: Output,
    rows: Sequence[Pointing | SextantSight],
    circles: Sequence[Circle | StarposError],
    whole: Together,
    vertical: Vertical,
    near: Near | None,
) -> int:
    """Write rows that give a zenith distance alone, or why not, and the place that they give; returns the exit status."""
    none = dict.fromkeys(("residual_arcsec", "log_odds"))
    for row, circle in zip(rows, circles, strict=True):
        utc_unix_s = row.utc_unix_s if isinstance(row, SextantSight) else row.mid_unix_s
        if isinstance(circle, StarposError):
            console.complain(circle)
            deg, status = (
                None,
                status_of(row, circle).value if isinstance(row, Pointing) else Status.BAD_INPUT.value,
            )
            about = status
        else:
            deg, status = np.degrees(circle.zenith_distance), ELEVATION
            about = f"{deg:.5f} deg from the zenith"
        utc = {} if utc_unix_s is None else {"utc": utc_text(utc_unix_s)}
        of_stars = {"stars_detected": 0, "stars_matched": 0} | none | {"status": status, "warnings": []}
        values = (
            {"file": row.source} | json_of(None, vertical) | utc | {"zenith_distance_deg": deg} | of_stars
        )
        output.put(values, f"{row.source}: {about}")
    console.complain(whole.why_not, *whole.remarks)
    if whole.average is not None or whole.why_not:
        about_place = about_average(args, whole.average, vertical, near)
        put_combined(output, None, whole, vertical, about_place)
    return 0 if whole.average else console.NOTHING


def about_average(
    args: argparse.Namespace, place: PlaceFix | None, vertical: Vertical, near: Near | None
) -> dict:
    """The distance from --near, for --json, after a complaint if the geoid has no data at the place."""
    if place is None:
        return {}
    options.tell_unknown(args, vertical.at(place.latitude, place.longitude))
    return {} if near is None else {"km_from_near": near.km_from(place.latitude, place.longitude)}


def put_combined(
    output: Output, folder: str | None, together: Together, vertical: Vertical, about: dict | None = None
) -> None:
    """Write the average of a night, or that it is missing; about: more keys of JSON.

    folder: of the night; None where it is not named.
    """
    average, mean, gathered = together.average, together.mean, together.gathered
    rows = gathered.solved or gathered.headings
    # the mean attitude is the answer where no frame has a fix
    whole = average if gathered.solved or mean is None else mean
    fitted = [f.residual_arcsec for s in rows if (f := s.fix or s.at_place) is not None]
    of_stars = {
        "stars_detected": sum(s.stars_detected for s in rows),
        "stars_matched": sum(len(s.named) for s in rows),
        "residual_arcsec": np.sqrt(np.mean(np.square(fitted or [np.nan]))),
        "log_odds": sum(np.nan if s.pointing is None else s.pointing.log_odds for s in rows)
        if rows
        else None,
        "status": (Status.OK if whole else Status.POOR_FIT).value,
        "warnings": sorted(gathered.warnings),
        "iers_table_age_days": table_age_days(whole.utc_unix_s) if whole else None,
    }
    values = {"combined": True} | ({} if folder is None else {"night": folder})
    values |= {name: getattr(whole, name, None) for name in COUNTS} | json_of(average, vertical)
    line = ""
    if average is not None:
        line = _lines_of(folder, average, vertical)
    elif whole is not None and mean is not None:
        line = f"{counted(mean.frames)} together: {heading_text_of(mean)}{axes_text((about or {})['axes'])}"
    output.put(values | of_stars | (about or {}), line)


def _lines_of(folder: str | None, together: Average, vertical: Vertical) -> str:
    """The lines of an average: its place, the place on WGS 84, the sources of error, the IERS table."""
    ground = geodetic(together.latitude, together.longitude, 0.0, together.covariance, vertical)
    headed = together.poses > 1 and not np.isnan(together.heading)
    turned = f" (the last of {together.poses} poses)" if headed else ""
    night = "" if folder is None else f"{folder}: "
    on_ground = InDegrees.of(ground.latitude, ground.longitude, 0.0, ground.covariance)
    frames = counted(together.frames) + ("" if together.frames == 1 else " together")
    lines = [
        f"{night}{frames}: {together.in_degrees}{turned} (astronomic)",
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


# the keys of --json that come from a heading at a known place
HEADING_KEYS: dict[str, Callable[[Attitude, Attitude], Any]] = {
    "heading": lambda plumb, _: np.degrees(plumb.heading),
    "sigma_heading_deg": lambda plumb, _: np.sqrt(_angles_deg2(plumb)[0, 0]),
    "pitch": lambda plumb, _: np.degrees(plumb.pitch),
    "sigma_pitch_deg": lambda plumb, _: np.sqrt(_angles_deg2(plumb)[1, 1]),
    "roll": lambda plumb, _: np.degrees(plumb.roll),
    "sigma_roll_deg": lambda plumb, _: np.sqrt(_angles_deg2(plumb)[2, 2]),
    "covariance_attitude": lambda plumb, _: _angles_deg2(plumb),
    "heading_geodetic": lambda _, ellipsoid: np.degrees(ellipsoid.heading),
    "sigma_heading_geodetic_deg": lambda _, ellipsoid: np.sqrt(_angles_deg2(ellipsoid)[0, 0]),
    "pitch_geodetic": lambda _, ellipsoid: np.degrees(ellipsoid.pitch),
    "roll_geodetic": lambda _, ellipsoid: np.degrees(ellipsoid.roll),
    "covariance_attitude_geodetic": lambda _, ellipsoid: _angles_deg2(ellipsoid),
}


def _angles_deg2(attitude: Attitude) -> np.ndarray:
    """Covariance (3, 3) of heading, pitch, roll in deg2."""
    return np.degrees(np.degrees(attitude.angles_covariance))


COVARIANCES = ("covariance", "covariance_geodetic")


# names and directions in C, which a camera's axes are
Axes = Mapping[str, Sequence[float]]
OPTICS: Axes = {"optical axis": OPTICAL_AXIS}


def with_heading(
    values: dict,
    found: AttitudeAtPlace | MeanAttitude | None,
    place: Place | None = None,
    axes: Axes = OPTICS,
) -> dict:
    """The keys of a fix and of the heading at a known place; keys without a value are None.

    The covariances keep the fix's place, without correlation with this heading, which does not come from the fix.
    """
    if found is None or place is None:
        none = {k: _with_variance(values[k], np.nan) for k in COVARIANCES if values[k] is not None}
        return values | dict.fromkeys((*HEADING_KEYS, "axes")) | none
    told = {key: value(found.plumb, found.ellipsoid) for key, value in HEADING_KEYS.items()}
    whole = {
        "utc": utc_text(found.utc_unix_s),
        "xi_arcsec": place.deflection.xi_arcsec,
        "eta_arcsec": place.deflection.eta_arcsec,
        "deflection_stddev_arcsec": place.deflection.stddev_arcsec,
        "covariance": _with_variance(values["covariance"], told["covariance_attitude"][0, 0]),
        "covariance_geodetic": _with_variance(
            values["covariance_geodetic"], told["covariance_attitude_geodetic"][0, 0]
        ),
        "budget": _heading_budget(values["budget"], found.plumb),
        "axes": json_of_axes(found, axes),
    }
    return values | whole | told


def json_of_axes(found: AttitudeAtPlace | MeanAttitude, axes: Axes) -> list[dict]:
    """Where directions that are fixed to the camera point, by the plumb line, as they are seen."""
    seen = horizontal(found.optics, np.array(list(axes.values()), float))
    columns = (seen.azimuth, seen.altitude, seen.sigma_azimuth, seen.sigma_altitude)
    keys = "azimuth", "altitude", "sigma_azimuth_deg", "sigma_altitude_deg"
    return [
        {"name": name, **dict(zip(keys, row, strict=True))}
        for name, row in zip(axes, np.degrees(columns).T.tolist(), strict=True)
    ]


def axes_text(axes: Iterable[Mapping]) -> str:
    """Text of what `json_of_axes` gives."""
    return "".join(
        f"; {a['name']} azimuth {a['azimuth']:.5f} +- {a['sigma_azimuth_deg']:.5f}, altitude {a['altitude']:.5f} +- "
        f"{a['sigma_altitude_deg']:.5f}"
        for a in axes
    )


def heading_line_of(path: str, s: Solution, axes: Axes = OPTICS) -> str:
    """The line of a frame."""
    if s.at_place is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    where = "" if s.fix is None else f"{s.fix.in_degrees.where}, "
    seen = (
        f"by the {' and the '.join(s.bodies)}" if s.bodies else f"{len(s.names)} of {s.stars_detected} stars"
    )
    return f"{path}: {where}{heading_text_of(s.at_place)}{axes_text(json_of_axes(s.at_place, axes))}, {seen}"


def heading_text_of(found: AttitudeAtPlace | MeanAttitude) -> str:
    """Heading by the plumb line and on WGS 84, pitch and roll, with their errors."""
    plumb, ellipsoid = found.plumb, found.ellipsoid
    angles = np.degrees([plumb.heading, ellipsoid.heading, plumb.pitch, plumb.roll])
    sigma = np.degrees(
        np.sqrt([ellipsoid.angles_covariance[0, 0], *np.diag(plumb.angles_covariance)])[[1, 0, 2, 3]]
    )
    heading, on_ground, pitch, roll = (f"{a:.5f} +- {s:.5f}" for a, s in zip(angles, sigma, strict=True))
    return f"heading {heading} (WGS 84: {on_ground}) deg, pitch {pitch}, roll {roll}"


def _with_variance(covariance: np.ndarray | None, heading: float) -> np.ndarray:
    """A covariance (3, 3) of east m, north m, heading deg with the variance of another heading."""
    whole = np.full((3, 3), np.nan)
    if covariance is not None:
        whole[:2, :2] = covariance[:2, :2]
    whole[2, 2] = heading
    return whole


def _heading_budget(of_fix: dict | None, plumb: Attitude) -> dict:
    """1 sigma (3,) of each source: east m, north m of a fix, heading deg at the known place by the plumb line."""
    headings = {t.name: float(np.degrees(np.sqrt(t.covariance[2, 2]))) for t in plumb.terms}
    places = {} if of_fix is None else {name: list(row[:2]) for name, row in of_fix.items()}
    names = dict.fromkeys([*places, *headings])
    return {name: [*places.get(name, [np.nan] * 2), headings.get(name, np.nan)] for name in names}
