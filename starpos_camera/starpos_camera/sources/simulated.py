# SPDX-License-Identifier: Apache-2.0
"""A simulated sky, live: what a camera standing at a place would have seen until now."""

from collections.abc import Callable, Mapping

import numpy as np

from starpos.atmosphere import Atmosphere
from starpos.catalogue import load as load_catalogue
from starpos.instrument import focal_px_of
from starpos.simulate import Scene, expose, render, scene_of
from starpos_camera.sources import Exposure, Settings
from starpos_interfaces.msg import Capture

DEFAULT_EXPOSURE_S = 0.5
MAX_EXPOSURE_S = 10.0  # the time and the memory of a render grow with the length of the trails
MAX_PIXELS = 100_000_000
STAMP_ROUNDING_S = 1e-6


class Simulated:
    """Renders the exposure that has just ended, through an ideal camera."""

    waits_for_listener = False

    @staticmethod
    def refusal(values: Mapping, settings: Settings) -> str | None:
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
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]):
        self._now = now
        self._rng = np.random.default_rng(values["simulated.seed"])
        self._scene = scene_from(values)
        self.hardware_id = "simulated sky"

    def lacking(self) -> None:
        """Nothing: the sky is always there."""

    def capture(self, settings: Settings) -> Exposure:
        exposure_s = settings.exposure_s or DEFAULT_EXPOSURE_S
        start = self._now() - exposure_s
        scene = self._scene
        stars = expose(scene, load_catalogue(), start, exposure_s, self._rng)
        frame = render(scene, stars, start, exposure_s, self._rng)
        return Exposure(frame, Capture.SIMULATED, STAMP_ROUNDING_S, scene.camera)

    def update(self, values: Mapping):
        self._scene = scene_from(values)

    def close(self):
        """Nothing is held open."""


def scene_from(values: Mapping) -> Scene:
    """The scene of the node's parameters."""
    return scene_of(
        size=(values["simulated.width"], values["simulated.height"]),
        focal_px=focal_px_of(values["focal_mm"], values["pixel_um"]),
        latitude_deg=values["simulated.latitude"],
        longitude_deg=values["simulated.longitude"],
        atmosphere=Atmosphere(
            values["simulated.pressure"], values["simulated.temperature"], values["simulated.humidity"]
        ),
        pointing_deg=(values["simulated.azimuth"], values["simulated.altitude"], values["simulated.roll"]),
    )
