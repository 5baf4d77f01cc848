# SPDX-License-Identifier: Apache-2.0
"""GenICam cameras (GigE Vision, USB3 Vision) through Aravis 0.8 and its GObject introspection.

Names of features follow GenICam's Standard Features Naming Convention and GigE Vision. Aravis's functions:
https://aravisproject.github.io/docs/aravis-0.8/.
"""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from string import digits
from types import ModuleType
from typing import Any

from starpos.errors import one_line
from starpos.frames.encodings import MOSAICS
from starpos.frames.exposure import Shutter
from starpos.frames.frame import MAX_PIXELS, Frame
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource, decoded
from starpos_camera.sources.timing import dated, dated_by_command, dated_by_start
from starpos_interfaces.msg import Capture

# Between a camera's time and the moment of the light, where the clocks are related.
TIMESTAMP_STDDEV_S = 1e-3
# By so much a stamp may contradict the times of trigger and arrival.
TOLERANCE_S = 5e-3


def stamp_of_camera(
    frame: Frame,
    camera_s: float | None,
    relation: tuple[float, float] | None,
    exposure_s: float,
    commanded_s: float | None,
    received_s: float,
    values: Mapping,
) -> CapturedFrame:
    """Date a frame by the better time: the camera's, or the time of command or arrival.

    camera_s     the frame's time on the camera's clock; None: not reported
    relation     of `clock_relation`; None: the camera's clock cannot be read
    commanded_s  Unix time just before the software trigger; None: a line has triggered
    received_s   arrival of the frame's first or last data, Unix time
    """
    frame, half_s = replace(frame, exposure_s=exposure_s), exposure_s / 2
    if commanded_s is None:
        otherwise = dated_by_start(frame, received_s - exposure_s, 0.0, values)
    else:
        otherwise = dated_by_command(frame, commanded_s, values)
    if camera_s is None:
        return otherwise
    if relation is None:
        # It may keep UTC (PTP), with an error that is not stated: exposure and stamp then lie anywhere between trigger
        # and arrival.
        if commanded_s is None or not commanded_s <= camera_s <= received_s + TOLERANCE_S:
            return otherwise
        relation = 0.0, max(0.0, received_s - commanded_s - exposure_s) / math.sqrt(3)
    at_s, stddev_s = camera_s + relation[0], math.hypot(relation[1], TIMESTAMP_STDDEV_S)
    earliest_s = (-math.inf if commanded_s is None else commanded_s) + half_s - TOLERANCE_S
    latest_s = received_s - half_s + TOLERANCE_S
    middles_s = [
        mid_s
        for moment, mid_s in (("start", at_s + half_s), ("end", at_s - half_s))
        if values["aravis.timestamp"] in (moment, "unknown") and earliest_s <= mid_s <= latest_s
    ]
    if not middles_s:
        told = "its times of frames contradict trigger and arrival, and are not used."
        return replace(otherwise, remark=told)
    if len(middles_s) > 1:
        stddev_s = math.hypot(stddev_s, half_s)
    if stddev_s > otherwise.frame.stamp_stddev_s:
        return otherwise
    return dated(frame, sum(middles_s) / len(middles_s), stddev_s, Capture.HARDWARE)


# Buffers that wait for frames.
BUFFERS = 4
# Share by which the camera's exposure may differ from what was set.
EXPOSURE_TOLERANCE = 0.01
# A clock is read so often, and the quickest reading counts.
CLOCK_READINGS = 5
# The formats that are read, by their names in GenICam's Pixel Format Naming Convention: encoding and bits.
FORMATS = {
    name: (encoding + ("8" if bits == 8 else "16"), bits)
    for bits in (8, 10, 12, 14, 16)
    for name, encoding in (
        (f"Mono{bits}", "mono"),
        *((f"Bayer{p[:2].upper()}{bits}", f"bayer_{p}") for p in MOSAICS),
    )
}
# The commands that hold a clock, the features with what was held, and with the ticks of a second ('' for 1e9).
CLOCKS = (
    ("TimestampLatch", "TimestampLatchValue", ""),
    ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency"),
)


def library() -> ModuleType:
    """Import Aravis; ImportError or ValueError if it is not installed."""
    import gi

    gi.require_version("Aravis", "0.8")
    from gi.repository import Aravis

    return Aravis


class AravisCamera:
    """An open camera that acquires frames, each at a trigger."""

    def __init__(self, values: Mapping) -> None:
        self._aravis = library()
        self.camera = self._aravis.Camera.new(_find_camera(self._aravis, values["aravis.device"]))
        self._exposure_s: float | None = None
        self._gain: float | None = None
        self._size = self._set_region(values["aravis.region_as_set"])
        self._encoding = self._set_format(values["aravis.pixel_format"])
        self._shutter = self._find_shutter()
        self.camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        self.camera.set_trigger(values["aravis.trigger"])
        self._stream = self.camera.create_stream(None, None)
        if self._stream is None:
            raise CaptureError("it sends no frames; another program holds it.")
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(self.camera.get_payload()))
        self.camera.start_acquisition()

    def release(self) -> None:
        """Stop and forget the camera, which may have gone."""
        with suppress(Exception):
            self.camera.stop_acquisition()
        self._stream = self.camera = None

    def set_exposure(self, wanted_s: float | None) -> tuple[float, str]:
        """Set the exposure if it was not set last; return the camera's own (s), and a remark if it is another one."""
        camera = self.camera
        if wanted_s is not None and wanted_s != self._exposure_s:
            if camera.is_exposure_auto_available():
                camera.set_exposure_time_auto(self._aravis.Auto.OFF)
            camera.set_exposure_time(1e6 * wanted_s)
            self._exposure_s = wanted_s
        told_s = camera.get_exposure_time() / 1e6
        if not (math.isfinite(told_s) and told_s > 0):
            raise CaptureError(f"it says that its exposure is {told_s:g} s.")
        if wanted_s is not None and abs(told_s - wanted_s) > EXPOSURE_TOLERANCE * wanted_s:
            return told_s, f"it exposes for {told_s:g} s, not for {wanted_s:g} s."
        return told_s, ""

    def set_gain(self, wanted: float | None) -> str:
        """Set the gain if it was not set last; return a remark if the camera has another one."""
        camera = self.camera
        if wanted is None:
            return ""
        if wanted != self._gain:
            if camera.is_gain_auto_available():
                camera.set_gain_auto(self._aravis.Auto.OFF)
            camera.set_gain(wanted)
            self._gain = wanted
        told = camera.get_gain()
        return (
            "" if abs(told - wanted) <= 0.01 * max(1.0, wanted) else f"its gain is {told:g}, not {wanted:g}."
        )

    def drain(self) -> None:
        """Leave out the frames that came before."""
        while (buffer := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(buffer)

    def pop(self, patience_s: float) -> tuple[Frame, float | None, float] | None:
        """Take the next frame; None if none comes in time. CaptureError if it is incomplete.

        With it come its time on the camera's clock (s), None if it has none, and its arrival, Unix time of the system.
        """
        buffer = self._stream.timeout_pop_buffer(round(1e6 * patience_s))
        if buffer is None:
            return None
        try:
            return self._read(buffer)
        finally:
            self._stream.push_buffer(buffer)

    def _read(self, buffer: Any) -> tuple[Frame, float | None, float]:
        if buffer.get_status() != self._aravis.BufferStatus.SUCCESS:
            raise CaptureError(f"a frame is incomplete ({buffer.get_status().value_nick}).")
        size = buffer.get_image_width(), buffer.get_image_height()
        if size != self._size:
            raise CaptureError(
                f"a frame has {size[0]} x {size[1]} px, not {self._size[0]} x {self._size[1]}."
            )
        pixels, pattern = decoded(self._encoding, buffer.get_data(), self._size)
        frame, camera_ns = Frame(pixels, pattern=pattern, shutter=self._shutter), buffer.get_timestamp()
        return frame, camera_ns * 1e-9 if camera_ns else None, buffer.get_system_timestamp() * 1e-9

    def _set_region(self, as_set: bool) -> tuple[int, int]:
        """Set the whole sensor, unless its present region is meant; return width and height (px)."""
        camera = self.camera
        sensor = camera.get_sensor_size()
        if not as_set:
            if camera.is_binning_available():
                camera.set_binning(1, 1)
            camera.set_region(0, 0, sensor.width, sensor.height)
        region = camera.get_region()
        if not as_set and (region.width, region.height) != (sensor.width, sensor.height):
            raise CaptureError(
                f"its frames have {region.width} x {region.height} px, its sensor {sensor.width} x {sensor.height}; "
                "set aravis.region_as_set where that is meant."
            )
        if min(region.width, region.height) < 1 or region.width * region.height > MAX_PIXELS:
            raise CaptureError(f"frames of {region.width} x {region.height} px cannot be used.")
        return region.width, region.height

    def _set_format(self, wanted: str) -> str:
        offered = self.camera.dup_available_pixel_formats_as_strings()
        if wanted and (wanted not in FORMATS or wanted not in offered):
            raise CaptureError(
                f"aravis.pixel_format is {wanted}; it offers {' '.join(offered)}, and this source knows unpacked Mono "
                "and Bayer formats."
            )
        name = wanted or best_format(offered, self.camera.get_pixel_format_as_string())
        self.camera.set_pixel_format_from_string(name)
        return FORMATS[name][0]

    def _find_shutter(self) -> Shutter | None:
        """A global shutter where the camera says that it has one; else nothing is known."""
        name = "SensorShutterMode"
        if self.camera.is_feature_available(name) and self.camera.get_string(name) == "Global":
            return Shutter(0.0, 0.0)
        return None


def _find_camera(aravis: ModuleType, wanted: str) -> str:
    """Name the camera to open; CaptureError if it is not there."""
    aravis.update_device_list()
    names = [aravis.get_device_id(i) for i in range(aravis.get_n_devices())]
    if wanted in names or (not wanted and len(names) == 1):
        return wanted or names[0]
    if not names:
        raise CaptureError("no GenICam camera is found; check its cable, power and network address.")
    raise CaptureError(f"aravis.device must be one of: {', '.join(names)}.")


def best_format(offered: list[str], present: str) -> str:
    """Choose the deepest format that is known; of a colour sensor its mosaic, of several the present one, else Mono.

    A mosaic alone has the sensor's own pixels: a colour camera makes its Mono by interpolation. A camera that offers
    several patterns has only one at a time, so those other than the present format's are no choice.
    """
    known = [name for name in offered if name in FORMATS]
    mosaics = [name for name in known if name.startswith("Bayer")]
    patterns = {name.rstrip(digits) for name in mosaics}
    if len(patterns) > 1:
        kind = next((pattern for pattern in patterns if present.startswith(pattern)), "Mono")
        known = [name for name in known if name.rstrip(digits) == kind]
    elif mosaics:
        known = mosaics
    if not known:
        raise CaptureError(
            f"it offers {' '.join(offered)}; this source knows unpacked Mono and Bayer formats."
        )
    return max(known, key=lambda name: FORMATS[name][1])


def clock_relation(camera: Any, now: Callable[[], float]) -> tuple[float, float] | None:
    """Host's clock minus camera's and its error (s), by holding it between readings of `now`; None if it cannot be."""
    known = (c for c in CLOCKS if camera.is_feature_available(c[0]) and camera.is_feature_available(c[1]))
    latch, value, frequency = next(known, ("", "", ""))
    if not latch:
        return None
    ticks_a_second = float(camera.get_integer(frequency)) if frequency else 1e9
    if not ticks_a_second > 0:
        return None
    readings = []
    for _ in range(CLOCK_READINGS):
        before_s = now()
        camera.execute_command(latch)
        took_s = now() - before_s
        camera_s = camera.get_integer(value) / ticks_a_second
        readings.append((took_s, before_s + took_s / 2 - camera_s))
    took_s, offset_s = min(readings)
    return offset_s, took_s / math.sqrt(12)


# A frame has to be here so long after its exposure.
READOUT_S = 10.0
# Interval at which a waiting `capture` looks whether the node ends.
WATCH_S = 0.2


class Aravis(DeviceSource[AravisCamera]):
    """Triggers each exposure, or waits for the line's signal, and takes the whole sensor's frame."""

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
        super().__init__(values, now)
        self.hardware_id = f"GenICam camera {values['aravis.device']}".strip()

    def _open(self) -> AravisCamera:
        return AravisCamera(self._values)

    def _explain(self, error: Exception) -> str:
        # Aravis reports everything as GLib.Error, and a camera's strange answers cause others.
        words = one_line(getattr(error, "message", error)).rstrip(".")
        return f"{words or type(error).__name__}; check its cable, its power, and programs that hold it."

    def _expose(self, camera: AravisCamera, settings: CaptureSettings) -> CapturedFrame:
        exposure_s, remark = camera.set_exposure(settings.exposure_s)
        remark = camera.set_gain(settings.gain) or remark
        triggers = self._values["aravis.trigger"] == "Software"
        camera.drain()
        asked_s, commanded_s = time.time(), self._now()
        if triggers:
            camera.camera.software_trigger()
        frame, camera_s, arrival_s = self._wait(camera, asked_s, exposure_s)
        # The arrival by the node's clock, which need not be the system's.
        received_s = self._now() - (time.time() - arrival_s)
        relation = clock_relation(camera.camera, self._now)
        times = exposure_s, commanded_s if triggers else None, received_s
        taken = stamp_of_camera(frame, camera_s, relation, *times, self._values)
        return replace(taken, remark=taken.remark or remark)

    def _wait(
        self, camera: AravisCamera, asked_s: float, exposure_s: float
    ) -> tuple[Frame, float | None, float]:
        """Wait for a frame that was exposed after `asked_s` (Unix time of the system); as `AravisCamera.pop` gives it."""
        end_s = time.monotonic() + exposure_s + READOUT_S
        while time.monotonic() < end_s:
            if self._closing.is_set():
                raise CaptureError("the node ends.")
            arrived = camera.pop(WATCH_S)
            # A frame that arrived before its exposure can have ended is an older one.
            if arrived is not None and arrived[2] >= asked_s + exposure_s:
                return arrived
        source = self._values["aravis.trigger"]
        raise CaptureError(
            f"no frame has come {READOUT_S:g} s after its exposure; check the trigger ({source}) and the "
            f"cable."
        )
