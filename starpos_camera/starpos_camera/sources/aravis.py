# SPDX-License-Identifier: Apache-2.0
"""GenICam cameras (GigE Vision, USB3 Vision) through Aravis 0.8 and its GObject introspection."""

import threading
import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

from starpos.frames.frame import Frame
from starpos_camera.sources.aravis_camera import AravisCamera, fault, library
from starpos_camera.sources.aravis_times import FrameTimes, stamp_of_camera
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, FrameSource
from starpos_common.parameters import Parameter

# A frame has to be here so long after its exposure.
READOUT_S = 10.0
# Interval at which a waiting `capture` looks whether the node ends.
WATCH_S = 0.2
PARAMETERS = (
    Parameter(
        "aravis.device",
        "",
        "The camera's name, as the program `arv-tool-0.8` prints it. Empty takes the only camera there is.",
        read_only=True,
    ),
    Parameter(
        "aravis.trigger",
        "Software",
        "The trigger's source by the camera's name for it. With `Software` this node triggers each "
        "frame; with `Line0` or another line the camera waits for a signal there.",
        read_only=True,
    ),
    Parameter(
        "aravis.pixel_format",
        "",
        "Pixel format, such as Mono8, Mono12, Mono16, BayerRG12. Empty takes the one with the most "
        "bits that both the camera and this source support.",
        read_only=True,
    ),
    Parameter(
        "aravis.region_as_set",
        False,
        "Keep the region of the sensor and the binning that the camera is set to; false sets the "
        "whole sensor without binning. A calibration and pixel_um hold for one region and binning "
        "only.",
        read_only=True,
    ),
    Parameter(
        "aravis.timestamp",
        "unknown",
        "Moment of the exposure that the camera's own times mark. A wrong one makes the stamp wrong "
        "by the exposure time. If it is unknown, the stamp's error covers all that is possible "
        "between trigger and arrival.",
        choices=("start", "end", "unknown"),
        read_only=True,
    ),
)


class Aravis(FrameSource):
    """Triggers each exposure, or waits for the line's signal, and takes the whole sensor's frame."""

    parameters = PARAMETERS
    waits_for_listener = False

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        if not find_spec("gi"):
            return "this source needs PyGObject: sudo apt-get install python3-gi gir1.2-aravis-0.8"
        try:
            library()
        except (ImportError, ValueError):
            return "this source needs Aravis: sudo apt-get install gir1.2-aravis-0.8"
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        self._values = values
        self._now = now
        self.hardware_id = f"GenICam camera {values['aravis.device']}".strip()
        self._closing = threading.Event()
        self._in_use = threading.Lock()
        self._camera: AravisCamera | None = None

    def lacking(self) -> None:
        """Return None, because only a look at the network and the bus would show it."""

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        with self._in_use:
            try:
                if self._camera is None:
                    self._camera = AravisCamera(self._values)
                return self._expose(self._camera, settings)
            except Exception as error:
                # Aravis reports everything as GLib.Error, and a camera's strange answers cause others.
                self._release()
                raise CaptureError(f"{self.hardware_id}: {fault(error)}") from error

    def update(self, values: Mapping) -> None:
        self._values = values

    def close(self) -> None:
        self._closing.set()
        with self._in_use:
            self._release()

    def _release(self) -> None:
        if self._camera is not None:
            self._camera.release()
        self._camera = None

    def _expose(self, camera: AravisCamera, settings: CaptureSettings) -> CapturedFrame:
        exposure_s, remark = camera.set_exposure(settings.exposure_s)
        remark = camera.set_gain(settings.gain) or remark
        triggers = self._values["aravis.trigger"] == "Software"
        camera.drain()
        asked_s, commanded_s = time.time(), self._now()
        if triggers:
            camera.trigger()
        buffer = self._wait(camera, asked_s, exposure_s)
        # The arrival by the node's clock, which need not be the system's.
        received_s = self._now() - (time.time() - buffer.received_s)
        times = FrameTimes(
            exposure_s=exposure_s,
            commanded_s=commanded_s if triggers else None,
            received_s=received_s,
            camera_s=buffer.camera_s,
            relation=camera.clock_relation(self._now),
        )
        stamp = stamp_of_camera(times, self._values["aravis.timestamp"], self._values)
        frame = Frame(
            buffer.pixels,
            pattern=buffer.pattern,
            mid_unix_s=stamp.mid_s,
            exposure_s=exposure_s,
            source=self.hardware_id,
            stamp_stddev_s=stamp.stddev_s,
            shutter=camera.shutter,
        )
        remark = remark or stamp.remark
        return CapturedFrame(frame, stamp.source, remark=remark and f"{self.hardware_id}: {remark}.")

    def _wait(self, camera: AravisCamera, asked_s: float, exposure_s: float) -> Any:
        """Wait for a frame that was exposed after `asked_s` (Unix time of the system)."""
        end_s = time.monotonic() + exposure_s + READOUT_S
        while time.monotonic() < end_s:
            if self._closing.is_set():
                raise CaptureError("the node ends.")
            buffer = camera.pop(WATCH_S)
            # A frame that arrived before its exposure can have ended is an older one.
            if buffer is not None and buffer.received_s >= asked_s + exposure_s:
                return buffer
        source = self._values["aravis.trigger"]
        raise CaptureError(
            f"no frame has come {READOUT_S:g} s after its exposure; check the trigger ({source}) and the "
            f"cable."
        )
