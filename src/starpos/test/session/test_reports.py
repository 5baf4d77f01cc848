# SPDX-License-Identifier: Apache-2.0
"""The diagnostics of unstated conditions."""

import math
from dataclasses import replace

import pytest

from starpos.earth.orientation import measured_until
from starpos.fix.solution import Solution, Status
from starpos.frames.exposure import GLOBAL_SHUTTER, UNKNOWN_SHUTTER, Shutter
from starpos.frames.frame import no_stars
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import presets
from starpos.session import reports
from starpos.session.driver import Level
from starpos_testing.skies.fields import SkyField

TOLD = {"refraction.pressure": 95000.0, "refraction.temperature": 8.0}
NAMED = Instrument(4000.0, inclinometer=presets()["scl3300"], inclinometer_model="scl3300")
NOBODYS = replace(NAMED, calibration=Calibration.of((0.0, 0.0, 0.0), (5.0,) * 3))
DATED = replace(NAMED, calibration=Calibration(utc_unix_s=1.79e9))


def tilt(temperature_c):
    return replace(SkyField().tilt(), temperature_c=temperature_c)


def test_conditions_that_are_known_are_right():
    said = reports.of_conditions(TOLD, NOBODYS, tilt(12.0), GLOBAL_SHUTTER)
    assert said.level == Level.OK and said.values["inclinometer (deg C)"] == 12.0
    # before the first frame the contents of the tilts are unknown
    assert reports.of_conditions(TOLD, NOBODYS, None, None).level == Level.OK


@pytest.mark.parametrize(
    ("values", "instrument", "temperature_c", "shutter", "words"),
    [
        ({"refraction.pressure": math.nan}, NOBODYS, 12.0, GLOBAL_SHUTTER, "the air's pressure is not known"),
        (
            {"refraction.temperature": math.nan},
            NOBODYS,
            12.0,
            GLOBAL_SHUTTER,
            "the air's temperature is not known",
        ),
        ({}, NOBODYS, math.nan, GLOBAL_SHUTTER, "the inclinometer's temperature is not known"),
        ({}, DATED, 12.0, Shutter(0.02, 0.001), "at its calibration is not known"),
        ({}, NOBODYS, 12.0, UNKNOWN_SHUTTER, "the shutter's first row to its last is not known"),
        ({}, Instrument(4000.0), 12.0, GLOBAL_SHUTTER, "the inclinometer's model is not stated"),
    ],
)
def test_what_nobody_told_is_a_warning(values, instrument, temperature_c, shutter, words):
    said = reports.of_conditions(TOLD | values, instrument, tilt(temperature_c), shutter)
    assert said.level == Level.WARN and words in said.message and ";" not in said.message


def test_the_age_of_the_iers_table_is_told_with_each_frame():
    day = no_stars(640, 480, mid_unix_s=measured_until() + 400 * 86400)
    said = reports.of_solution(Solution.failed(day, Status.NO_TILT, "no tilt"), {})
    assert said.values["IERS table age (days)"] == pytest.approx(400)
    timeless = replace(day, mid_unix_s=None)
    assert (
        "IERS table age (days)"
        not in reports.of_solution(Solution.failed(timeless, Status.BAD_INPUT, "no time"), {}).values
    )


def test_each_lack_has_a_sentence():
    nothing = dict.fromkeys(TOLD, math.nan)
    said = reports.of_conditions(nothing, DATED, tilt(math.nan), UNKNOWN_SHUTTER)
    assert said.level == Level.WARN and said.message.count("is not known") == 4


@pytest.mark.parametrize(
    ("age_s", "said"),
    [(0.5, False), (60.0, True), (1.7e9, True), (6e7, False)],
    ids=["fresh", "behind", "boot", "night"],
)
def test_frames_of_another_clock_are_said_with_their_age_but_not_those_of_a_recorded_night(age_s, said):
    report = reports.of_clock(0.01, 0.001, -age_s, 0.0)
    assert (report.level is Level.WARN and f"{age_s:.3g} s behind" in report.message) == said
