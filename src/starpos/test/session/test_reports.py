# SPDX-License-Identifier: Apache-2.0
"""What the diagnostics say of conditions that nobody told."""

import math
from dataclasses import replace

import pytest

from starpos.instrument.instrument import Calibration
from starpos.session import reports
from starpos.session.diagnosis import Level
from starpos_testing.skies.fields import SkyField

TOLD = {"refraction.pressure": 95000.0, "refraction.temperature": 8.0}
NOBODYS = Calibration.of((0.0, 0.0, 0.0), (5.0,) * 3)
DATED = Calibration(utc_unix_s=1.79e9)


def tilt(temperature_c):
    return replace(SkyField().tilt(), temperature_c=temperature_c)


def test_air_and_temperatures_that_are_known_are_right():
    said = reports.of_conditions(TOLD, NOBODYS, tilt(12.0))
    assert said.level == Level.OK and said.values["inclinometer (deg C)"] == 12.0
    # before the first frame nobody can know what the tilts carry
    assert reports.of_conditions(TOLD, NOBODYS, None).level == Level.OK


@pytest.mark.parametrize(
    ("values", "calibration", "temperature_c", "words"),
    [
        ({"refraction.pressure": math.nan}, NOBODYS, 12.0, "the air's pressure is not known"),
        ({"refraction.temperature": math.nan}, NOBODYS, 12.0, "the air's temperature is not known"),
        ({}, NOBODYS, math.nan, "the inclinometer's temperature is not known"),
        ({}, DATED, 12.0, "at its calibration is not known"),
    ],
)
def test_what_nobody_told_is_a_warning(values, calibration, temperature_c, words):
    said = reports.of_conditions(TOLD | values, calibration, tilt(temperature_c))
    assert said.level == Level.WARN and words in said.message and ";" not in said.message


def test_each_lack_has_a_sentence():
    nothing = dict.fromkeys(TOLD, math.nan)
    said = reports.of_conditions(nothing, DATED, tilt(math.nan))
    assert said.level == Level.WARN and said.message.count("is not known") == 3
