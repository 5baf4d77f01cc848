# SPDX-License-Identifier: Apache-2.0
"""A simulated sky, live: the frames that a camera at a place would take now."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError
from starpos.instrument.instrument import focal_px_of
from starpos_camera.sources.source import CapturedFrame, CaptureSettings, FrameSource
from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture

if TYPE_CHECKING:
    from starpos.simulation.scene import Scene

DEFAULT_EXPOSURE_S = 0.5
# Time and memory of a render grow with the length of the trails.
MAX_EXPOSURE_S = 10.0
MAX_PIXELS = 100_000_000
STAMP_ROUNDING_S = 1e-6
PARAMETERS = (
    Parameter(
        "simulated.latitude",
        35.7046,
        "Astronomic latitude of the simulated place.",
        unit="deg",
        minimum=-90.0,
        maximum=90.0,
    ),
    Parameter(
        "simulated.longitude",
        51.4106,
        "Astronomic longitude of the simulated place, east positive.",
        unit="deg",
        minimum=-180.0,
        maximum=360.0,
    ),
    Parameter(
        "simulated.azimuth",
        40.0,
        "Azimuth of the optical axis, clockwise from north.",
        unit="deg",
        minimum=-360.0,
        maximum=360.0,
    ),
    Parameter(
        "simulated.altitude",
        78.0,
        "Altitude of the optical axis above the horizon; below 60 deg the inclinometer is out of its range.",
        unit="deg",
        minimum=5.0,
        maximum=90.0,
    ),
    Parameter(
        "simulated.roll",
        15.0,
        "Roll about the optical axis; 0: rows are level.",
        unit="deg",
        minimum=-360.0,
        maximum=360.0,
    ),
    Parameter(
        "simulated.pressure",
        101325.0,
        "Air pressure of the simulated place, 30000 Pa or more, or 0 for a vacuum; the solver's refraction.pressure has "
        "to agree.",
        unit="Pa",
        minimum=0.0,
        maximum=120000.0,
    ),
    Parameter(
        "simulated.temperature",
        15.0,
        "Air temperature of the simulated place; the solver's refraction.temperature has to agree.",
        unit="deg C",
        minimum=-100.0,
        maximum=80.0,
    ),
    Parameter(
        "simulated.humidity",
        0.5,
        "Relative humidity of the simulated place, 0 to 1; the solver's refraction.humidity has to agree.",
        unit="",
        minimum=0.0,
        maximum=1.0,
    ),
    Parameter(
        "simulated.width", 5616, "Width of the simulated frames.", unit="px", minimum=16, maximum=20000
    ),
    Parameter(
        "simulated.height", 3744, "Height of the simulated frames.", unit="px", minimum=16, maximum=20000
    ),
    Parameter(
        "simulated.seed",
        1,
        "Seed of the simulated noise.",
        unit="",
        minimum=0,
        maximum=2**31 - 1,
        read_only=True,
    ),
)


class Simulated(FrameSource):
    """Renders the exposure that has just ended, through an ideal camera."""

    parameters = PARAMETERS

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        exposure_s = settings.exposure_s or DEFAULT_EXPOSURE_S
        if values["simulated.width"] * values["simulated.height"] > MAX_PIXELS:
            return f"simulated.width times simulated.height must be at most {MAX_PIXELS} px."
        if exposure_s > MAX_EXPOSURE_S:
            return f"the simulated sky takes an `exposure` of at most {MAX_EXPOSURE_S:g} s, not {exposure_s:g} s."
        if exposure_s > settings.cadence_s:
            return (
                f"`exposure` ({exposure_s:g} s) must not be longer than `cadence` ({settings.cadence_s:g} s)."
            )
        if settings.gain:
            return "the simulated sky has no gain: leave `gain` unset."
        try:
            air_from(values)
        except InstrumentError as error:
            return f"simulated.{error}."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        self._rng = np.random.default_rng(values["simulated.seed"])
        self._scene = scene_from(values)
        self.hardware_id = "simulated sky"

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        from starpos.simulation.scene import expose, render
        from starpos.sky.catalogue import load_catalogue

        exposure_s = settings.exposure_s or DEFAULT_EXPOSURE_S
        start = self._now() - exposure_s
        scene = self._scene
        stars = expose(scene, load_catalogue(), start, exposure_s, self._rng)
        frame = render(scene, stars, start, exposure_s, self._rng)
        return CapturedFrame(replace(frame, stamp_stddev_s=STAMP_ROUNDING_S), Capture.SIMULATED, scene.camera)

    def update(self, values: Mapping) -> None:
        self._scene = scene_from(values)


def air_from(values: Mapping) -> Atmosphere:
    """Make the air of the node's parameters; InstrumentError for values that cannot be."""
    return Atmosphere(
        pressure_pa=values["simulated.pressure"],
        temperature_c=values["simulated.temperature"],
        humidity=values["simulated.humidity"],
    )


def scene_from(values: Mapping) -> "Scene":
    """Make the scene of the node's parameters."""
    from starpos.simulation.scene import scene_of

    return scene_of(
        size=(values["simulated.width"], values["simulated.height"]),
        focal_px=focal_px_of(values["focal_mm"], values["pixel_um"]),
        latitude_deg=values["simulated.latitude"],
        longitude_deg=values["simulated.longitude"],
        atmosphere=air_from(values),
        pointing_deg=(values["simulated.azimuth"], values["simulated.altitude"], values["simulated.roll"]),
    )
