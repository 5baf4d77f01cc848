# SPDX-License-Identifier: Apache-2.0
"""The line, JSON keys and CSV columns of headings at a known place."""

from collections.abc import Sequence

import numpy as np

from starpos.averaging.attitude import MeanAttitude, mean_attitude
from starpos.cli import fix_output
from starpos.cli.archive import NightFolder
from starpos.cli.fix_output import COUNTS, counted, json_of
from starpos.cli.output import Output
from starpos.earth.known_place import KnownPlace
from starpos.earth.orientation import table_age_days
from starpos.earth.vertical import Vertical
from starpos.errors import FixError
from starpos.fix.attitude_at_place import AttitudeAtPlace, LinkAttitude
from starpos.fix.solution import Solution, Status
from starpos.utc import utc_text

# the first line for people
HEAD = (
    "file: heading (deg, from true north over east) by the plumb line and on WGS 84, pitch (nose up) and roll (left side "
    "up) by the plumb line, each +- 1 sigma"
)
# besides the columns of a fix
COLUMNS = (*fix_output.COLUMNS, "pitch", "roll", "sigma_pitch_deg", "sigma_roll_deg", "heading_geodetic",
           "sigma_heading_geodetic_deg", "pitch_geodetic", "roll_geodetic")  # fmt: skip
KEYS = ("heading", "sigma_heading_deg", "pitch", "sigma_pitch_deg", "roll", "sigma_roll_deg", "covariance_attitude",
        "heading_geodetic", "sigma_heading_geodetic_deg", "pitch_geodetic", "roll_geodetic",
        "covariance_attitude_geodetic")  # fmt: skip

COVARIANCES = ("covariance", "covariance_geodetic")


def with_heading(
    values: dict, found: AttitudeAtPlace | MeanAttitude | None, place: KnownPlace | None = None
) -> dict:
    """The keys of a fix and of the heading at a known place; keys without a value are None.

    The covariances keep the fix's place, without correlation with this heading, which does not come from the fix.
    """
    if found is None or place is None:
        none = {k: _with_variance(values[k], np.nan) for k in COVARIANCES if values[k] is not None}
        return values | dict.fromkeys(KEYS) | none
    plumb, ellipsoid = found.plumb, found.ellipsoid
    covariance, covariance_geodetic = (np.degrees(np.degrees(a.covariance)) for a in (plumb, ellipsoid))
    sigma = np.sqrt(np.diag(covariance))
    told = (
        np.degrees(plumb.heading),
        sigma[0],
        np.degrees(plumb.pitch),
        sigma[1],
        np.degrees(plumb.roll),
        sigma[2],
        covariance,
        np.degrees(ellipsoid.heading),
        np.sqrt(covariance_geodetic[0, 0]),
        np.degrees(ellipsoid.pitch),
        np.degrees(ellipsoid.roll),
        covariance_geodetic,
    )
    whole = {
        "utc": utc_text(found.utc_unix_s),
        "xi_arcsec": place.deflection.xi_arcsec,
        "eta_arcsec": place.deflection.eta_arcsec,
        "deflection_stddev_arcsec": place.deflection.stddev_arcsec,
        "covariance": _with_variance(values["covariance"], covariance[0, 0]),
        "covariance_geodetic": _with_variance(values["covariance_geodetic"], covariance_geodetic[0, 0]),
        "budget": _budget(values["budget"], plumb),
    }
    return values | whole | dict(zip(KEYS, told, strict=True))


def line_of(path: str, s: Solution) -> str:
    """The line of a frame."""
    if s.at_place is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    where = "" if s.fix is None else f"{s.fix.in_degrees.where}, "
    return f"{path}: {where}{text_of(s.at_place)}, {len(s.names)} of {s.stars_detected} stars"


def text_of(found: AttitudeAtPlace | MeanAttitude) -> str:
    """Heading by the plumb line and on WGS 84, pitch and roll, with their errors."""
    plumb, ellipsoid = found.plumb, found.ellipsoid
    angles = np.degrees([plumb.heading, ellipsoid.heading, plumb.pitch, plumb.roll])
    sigma = np.degrees(
        np.sqrt([plumb.covariance[0, 0], ellipsoid.covariance[0, 0], *np.diag(plumb.covariance)[1:]])
    )
    heading, on_ground, pitch, roll = (f"{a:.5f} +- {s:.5f}" for a, s in zip(angles, sigma, strict=True))
    return f"heading {heading} (WGS 84: {on_ground}) deg, pitch {pitch}, roll {roll}"


def mean_of(answers: Sequence[Solution]) -> tuple[MeanAttitude | None, tuple[str, ...]]:
    """The mean attitude of the frames, or None with the reason; the reason is empty if no frame has an attitude."""
    attitudes = [s.at_place for s in answers if s.at_place]
    try:
        return (mean_attitude(attitudes) if attitudes else None), ()
    except FixError as error:
        return None, (str(error),)


def put_mean(
    output: Output,
    night: NightFolder,
    answers: Sequence[Solution],
    mean: MeanAttitude | None,
    place: KnownPlace,
    vertical: Vertical,
) -> None:
    """Write the mean attitude of frames without a place of their own."""
    about = {
        "stars_detected": sum(s.stars_detected for s in answers),
        "stars_matched": sum(len(s.names) for s in answers),
        "residual_arcsec": np.sqrt(np.mean([s.at_place.residual_arcsec**2 for s in answers if s.at_place])),
        "log_odds": sum(s.attitude.log_odds for s in answers if s.attitude),
        "status": (Status.OK if mean else Status.POOR_FIT).value,
        "warnings": [],
        "iers_table_age_days": table_age_days(mean.utc_unix_s) if mean else None,
    }
    name = {} if night.folder is None else {"night": night.folder}
    values = {"combined": True} | name | dict.fromkeys(COUNTS) | json_of(None, vertical)
    values |= {"frames": mean.frames} if mean else {}
    text = "" if mean is None else f"{counted(mean.frames)} together: {text_of(mean)}"
    output.put(with_heading(values, mean, place) | about, text)


def _with_variance(covariance: np.ndarray | None, heading: float) -> np.ndarray:
    """A covariance (3, 3) of east m, north m, heading deg with the variance of another heading."""
    whole = np.full((3, 3), np.nan)
    if covariance is not None:
        whole[:2, :2] = covariance[:2, :2]
    whole[2, 2] = heading
    return whole


def _budget(of_fix: dict | None, plumb: LinkAttitude) -> dict:
    """1 sigma (3,) of each source: east m, north m of a fix, heading deg at the known place by the plumb line."""
    headings = {t.name: float(np.degrees(np.sqrt(t.covariance[2, 2]))) for t in plumb.terms}
    places = {} if of_fix is None else {name: list(row[:2]) for name, row in of_fix.items()}
    names = dict.fromkeys([*places, *headings])
    return {name: [*places.get(name, [np.nan] * 2), headings.get(name, np.nan)] for name in names}
