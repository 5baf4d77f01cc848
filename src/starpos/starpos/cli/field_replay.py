# SPDX-License-Identifier: Apache-2.0
"""A field report for `starpos replay`: its parameters, and what the session makes of it."""

from collections.abc import Iterator
from pathlib import Path

from starpos.earth.refraction import Atmosphere
from starpos.frames.reading import read_frame
from starpos.frames.tables import TILTS
from starpos.instrument import instrument_file
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.night.opening import frames_in
from starpos.night.reading import stars_of
from starpos.report.field import INSTRUMENT
from starpos.session.frames import Output
from starpos.session.replay import Replay


def parameters_in(folder: Path, air: Atmosphere) -> list[str]:
    """The solver's parameters, NAME:=VALUE, of an unpacked field report."""
    measured = {"pressure": air.pressure_pa, "temperature": air.temperature_c, "humidity": air.humidity}
    refraction = [f"refraction.{name}:={float(value)}" for name, value in measured.items()]
    return [f"calibration_url:={folder / INSTRUMENT}", *refraction]


def played(replay: Replay, folder: Path) -> Iterator[Output]:
    """What the session publishes of an unpacked field report."""
    instrument = instrument_file.read(folder / INSTRUMENT)
    stars = [stars_of(read_frame(path)) for path in frames_in(folder)]
    tilts = read_tilt_csv(folder / TILTS, instrument.inclinometer.noise_rad)
    return replay.play_lists(instrument.camera_for(stars[0].width, stars[0].height), stars, tilts)
