# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the solver about its frames."""

import math
from collections.abc import Mapping

import numpy as np

from starpos.earth.orientation import EQUATOR_M_PER_S, table_age_days
from starpos.earth.place import Place
from starpos.fix.checks import MODEL_BY_PARAMETERS, unnamed_inclinometer
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import Solution
from starpos.frames.exposure import UNKNOWN_SHUTTER, Shutter
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument
from starpos.session.driver import ANOTHER_TIME_S, Diagnosis, Level
from starpos.units import ARCSEC

WIDE_CLOCK_S = 0.1
# Age on arrival above which frames are stamped by another clock or recorded on another evening, and age above which
# stamps count from the boot of their host.
OLD_S, SINCE_BOOT_S = 40.0, 1e9
AHEAD_S = 1.0
SITE_LATITUDE, SITE_LONGITUDE = "site latitude (deg)", "site longitude (deg)"
ONE_CLOCK = "set the clocks of camera, inclinometer and solver by one source"

OTHER_TILTS = (
    "by its stars the camera has not moved, by the tilts at its stamp it has: these are of another time; "
    + ONE_CLOCK
)
OTHER_LEVEL = (
    "by its stars the camera stands, but the level puts it at another place than before, further off than its errors "
    "allow: the level was set to zero, or knocked; confirm it with solver/reset, then calibrate A3 anew"
)


def of_site(site: Place) -> dict[str, float]:
    """Values with a known place, deg on WGS 84, which the dashboard reads."""
    return {SITE_LATITUDE: math.degrees(site.latitude), SITE_LONGITUDE: math.degrees(site.longitude)}


def of_solution(answer: Solution, counts: Mapping[str, float], remarks: str = "") -> Diagnosis:
    """Report the solution of the newest frame; remarks: sentences on what is wrong around it."""
    values: dict[str, object] = {**counts, "status": answer.status.value}
    values |= {
        "source": ", ".join(answer.bodies) or "stars",
        "stars detected": answer.stars_detected,
        "stars matched": len(answer.names),
        "identify (s)": answer.identify_s,
        "fit (s)": answer.fix_s,
    }
    if answer.fix:
        east, north, _ = answer.fix.covariance.diagonal() ** 0.5
        values |= {
            "sigma east (m)": float(east),
            "sigma north (m)": float(north),
            "residual (arcsec)": answer.fix.residual_arcsec,
        }
    if (attitude := answer.at_place) is not None:
        values["sigma heading at the known place (arcsec)"] = _heading_stddev_arcsec(attitude)
    if answer.utc_unix_s is not None:
        values["IERS table age (days)"] = table_age_days(answer.utc_unix_s)
    if answer.extrapolated_days > 0:
        old = f"UT1 is extrapolated by {answer.extrapolated_days:.0f} days: upgrade astropy-iers-data"
        return Diagnosis(Level.WARN, old if answer.ok else answer.message, values)
    said = "; ".join(filter(None, (answer.remark, remarks)))
    if said:
        return Diagnosis(
            Level.WARN, said if answer.ok or answer.remark else f"{answer.message}; {said}", values
        )
    if answer.fix is None and attitude is not None and not answer.bodies:
        sigma_arcsec = _heading_stddev_arcsec(attitude)
        told = f"heading at the known place, +- {sigma_arcsec:.2g} arcsec; no position: {answer.message}"
        return Diagnosis(Level.OK, told, values)
    return Diagnosis(Level.OK if answer.ok else Level.WARN, answer.message, values)


def _heading_stddev_arcsec(attitude: AttitudeAtPlace) -> float:
    """1 sigma of the heading that is published."""
    return float(np.sqrt(attitude.true_north.angles_covariance[0, 0]) / ARCSEC)


def of_clock(clock_stddev_s: float, stamp_stddev_s: float, ahead_s: float, doubt_s: float) -> Diagnosis:
    """Report how well the time of the newest frame is known.

    ahead_s: how far it was ahead of this node's clock.  doubt_s: how far the stars contradict it, or 0.
    """
    values = {"clock sigma (s)": clock_stddev_s, "stamp sigma (s)": stamp_stddev_s, "frame age (s)": -ahead_s}
    if ahead_s > AHEAD_S:
        return Diagnosis(
            Level.WARN,
            f"frames are stamped {ahead_s:.3g} s in the future and are refused: {ONE_CLOCK}",
            values,
        )
    if doubt_s:
        return Diagnosis(
            Level.WARN,
            f"the camera is at rest, but the sky has turned by {doubt_s:.3g} s more than the stamps say: a "
            f"clock was set, or a frame stamped wrongly. Fixes include this error until the clock is back "
            f"or solver/reset is called",
            values,
        )
    if OLD_S < -ahead_s < ANOTHER_TIME_S or -ahead_s > SINCE_BOOT_S:
        return Diagnosis(
            Level.WARN,
            f"frames are stamped {-ahead_s:.3g} s behind this node's clock: if they are taken now, they belong to "
            f"another clock, and so does their longitude: {ONE_CLOCK}",
            values,
        )
    wide = float(np.hypot(clock_stddev_s, stamp_stddev_s))
    if wide > WIDE_CLOCK_S:
        return Diagnosis(
            Level.WARN,
            f"the time is known to {wide:.2g} s only, {wide * EQUATOR_M_PER_S:.0f} m at the equator: synchronise the "
            "camera's clock, or set clock_stddev where you know better",
            values,
        )
    return Diagnosis(Level.OK, f"the time is known to {wide:.2g} s", values)


def of_conditions(
    values: Mapping, instrument: Instrument, tilt: Tilt | None, shutter: Shutter | None
) -> Diagnosis:
    """Report what is unknown of the air, the inclinometer, its temperatures, and the shutter.

    values: the parameters.  tilt, shutter: of the newest frame, None without one.
    """
    calibration = instrument.calibration
    now_c = math.nan if tilt is None else tilt.temperature_c
    pressure_pa, air_c = values["refraction.pressure"], values["refraction.temperature"]
    unnamed = unnamed_inclinometer(instrument, MODEL_BY_PARAMETERS)
    unknown = [unnamed] if unnamed else []
    if math.isnan(pressure_pa):
        unknown.append("the air's pressure is not known, which widens the fix: set refraction.pressure")
    if math.isnan(air_c):
        unknown.append("the air's temperature is not known, which widens the fix: set refraction.temperature")
    if tilt is not None and math.isnan(now_c):
        unknown.append(
            "the inclinometer's temperature is not known, on which its zero depends: let its tilts carry it"
        )
    elif math.isnan(calibration.temperature_c) and not math.isnan(calibration.utc_unix_s):
        unknown.append(
            "the inclinometer's temperature at its calibration is not known, which widens the fix: calibrate again"
        )
    if shutter == UNKNOWN_SHUTTER:
        unknown.append(
            "the time from the shutter's first row to its last is not known, which widens the fix: give the instrument "
            "file's shutter, readout_s: 0 for a global one"
        )
    shown = {
        "pressure (Pa)": pressure_pa,
        "temperature (deg C)": air_c,
        "inclinometer (deg C)": now_c,
        "inclinometer at its calibration (deg C)": calibration.temperature_c,
    }
    if unknown:
        return Diagnosis(Level.WARN, "; ".join(unknown), shown)
    return Diagnosis(Level.OK, "air, inclinometer, temperatures and shutter are known", shown)
