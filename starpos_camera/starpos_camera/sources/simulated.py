# SPDX-License-Identifier: Apache-2.0
"""A simulated sky, live: the frames that a camera at a place would take now."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError
from starpos.instrument.instrument import focal_px_of
from starpos_camera.sources.source import CapturedFrame, CaptureSettings, FrameSource
from starpos_interfaces.msg import Capture

# Time and memory of a render grow with the length of the trails.
MAX_EXPOSURE_S = 10.0
MAX_PIXELS = 100_000_000
STAMP_ROUNDING_S = 1e-6


class Simulated(FrameSource):
    """Renders the exposure that has just ended, through an ideal camera."""

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        exposure_s = settings.definite_exposure_s
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
        self.hardware_id = "simulated sky"

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        from starpos.simulation.scene import expose, render, scene_of
        from starpos.sky.catalogue import load_catalogue

        values, exposure_s = self._values, settings.definite_exposure_s
        start = self._now() - exposure_s
        scene = scene_of(
            size=(values["simulated.width"], values["simulated.height"]),
            focal_px=focal_px_of(values["focal_mm"], values["pixel_um"]),
            latitude_deg=values["simulated.latitude"],
            longitude_deg=values["simulated.longitude"],
            atmosphere=air_from(values),
            pointing_deg=(
                values["simulated.azimuth"],
                values["simulated.altitude"],
                values["simulated.roll"],
            ),
        )
        stars = expose(scene, load_catalogue(), start, exposure_s, self._rng)
        frame = render(scene, stars, start, exposure_s, self._rng)
        return CapturedFrame(replace(frame, stamp_stddev_s=STAMP_ROUNDING_S), Capture.SIMULATED)


def air_from(values: Mapping) -> Atmosphere:
    """Make the air of the node's parameters; InstrumentError for values that cannot be."""
    return Atmosphere(
        pressure_pa=values["simulated.pressure"],
        temperature_c=values["simulated.temperature"],
        humidity=values["simulated.humidity"],
    )
