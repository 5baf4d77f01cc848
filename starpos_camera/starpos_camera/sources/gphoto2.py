# SPDX-License-Identifier: Apache-2.0
"""Canon, Nikon and other cameras that libgphoto2 knows, by USB or PTP/IP, through PyPI's gphoto2."""

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import PurePosixPath

from starpos.errors import FrameError
from starpos.frames.reading import RAW, decode_frame
from starpos_camera.sources.gphoto2_camera import TOLERANCE, Gphoto2Camera, sentence
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, FrameSource, missing
from starpos_camera.sources.timing import middle_of_commanded
from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture

# Each target with a part of its name in libgphoto2.
TARGETS = {"memory": "ram", "card": "card"}
# Names of the setting with Canon and with Nikon.
FORMATS = ("imageformat", "imagequality")
RAW_ALONE = r"^(?!.*(jpe?g|\+|fine|large)).*\b(raw|nef)\b"
PARAMETERS = (
    Parameter(
        "gphoto2.model",
        "",
        "The camera's name or a part of it, as the program `gphoto2 --auto-detect` prints it. Empty "
        "takes the only camera there is.",
        read_only=True,
    ),
    Parameter(
        "gphoto2.port",
        "",
        "The camera's port, such as ptpip:192.168.1.1 (then give gphoto2.model in full), or "
        "usb:001,004, which changes each time the camera is plugged in. Empty takes any.",
        read_only=True,
    ),
    Parameter(
        "gphoto2.shutter_setting",
        "shutterspeed",
        "The camera's name for its exposure time setting (gphoto2 --list-config); shutterspeed2 for "
        "some Nikon cameras.",
        read_only=True,
    ),
    Parameter(
        "gphoto2.iso_setting",
        "iso",
        "The camera's name for its ISO setting, which `gain` sets.",
        read_only=True,
    ),
    Parameter(
        "gphoto2.raw",
        True,
        "Set the camera to its raw format if it has one; false leaves the format as it is. A JPEG "
        "has 8 bits, and the camera smooths faint stars away.",
        read_only=True,
    ),
    Parameter(
        "gphoto2.target",
        "memory",
        "Where the camera stores a frame before it is fetched; some cameras can do only one of the two.",
        choices=tuple(TARGETS),
        read_only=True,
    ),
    Parameter(
        "gphoto2.keep",
        False,
        "Leave the frames in the camera too. When its card is full, no more frames come.",
        read_only=True,
    ),
)


class Gphoto2(FrameSource):
    """Commands each exposure, waits for its file, fetches and deletes it. The camera's dial must stand at M."""

    parameters = PARAMETERS
    waits_for_listener = False

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        for package in ("gphoto2", "exifread", *(("rawpy",) if values["gphoto2.raw"] else ())):
            if lack := missing(package, package):
                return lack
        exposure_s, cadence_s = settings.exposure_s, settings.cadence_s
        if exposure_s is not None and exposure_s > cadence_s:
            return f"`exposure` ({exposure_s:g} s) must not be longer than `cadence` ({cadence_s:g} s)."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        self._values = values
        self._now = now
        which = filter(None, (values["gphoto2.model"], values["gphoto2.port"]))
        self.hardware_id = " ".join(("gphoto2", *which))
        self._closing = threading.Event()
        self._in_use = threading.Lock()
        self._camera: Gphoto2Camera | None = None

    def lacking(self) -> None:
        """Return None, because only a look at the bus would show it."""

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        import gphoto2

        with self._in_use:
            try:
                if self._camera is None:
                    self._camera = self._opened()
                return self._expose(self._camera, settings)
            except (CaptureError, FrameError) as error:
                self._release()
                raise CaptureError(f"{self.hardware_id}: {error}") from error
            except gphoto2.GPhoto2Error as error:
                self._release()
                raise CaptureError(f"{self.hardware_id}: {sentence(error.code)}") from error

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

    def _opened(self) -> Gphoto2Camera:
        """Open the camera and make the settings that hold as long as it is open."""
        values = self._values
        camera = Gphoto2Camera(values["gphoto2.model"], values["gphoto2.port"], self._closing)
        # Autofocus finds no target in stars, and without a target the camera does not expose.
        camera.prefer("autofocus", "off")
        camera.prefer("capturetarget", TARGETS[values["gphoto2.target"]])
        if values["gphoto2.raw"]:
            for name in FORMATS:
                camera.prefer(name, RAW_ALONE)
        return camera

    def _expose(self, camera: Gphoto2Camera, settings: CaptureSettings) -> CapturedFrame:
        camera.drain()
        set_s, bulb = camera.set_exposure(self._values["gphoto2.shutter_setting"], settings.exposure_s)
        if settings.gain is not None:
            camera.set_gain(self._values["gphoto2.iso_setting"], settings.gain)
        commanded_s = self._now()
        if bulb:
            set_s = camera.hold_open(set_s)
        else:
            camera.trigger()
        files = camera.files(set_s)
        file = next((f for f in files if PurePosixPath(f).suffix.lower() in RAW), files[0])
        data = camera.fetch(file)
        remark = "" if self._values["gphoto2.keep"] else self._delete(camera, files)
        frame = decode_frame(data, file)
        told_s = frame.exposure_s
        exposure_s = set_s if bulb or told_s is None else told_s
        if abs(math.log(exposure_s / set_s)) > TOLERANCE:
            told = f"it says that it exposed for {exposure_s:g} s, though its shutter stood at {set_s:g} s"
            remark = f"{self.hardware_id}: {told}."
        mid_s, stddev_s = middle_of_commanded(commanded_s, exposure_s, self._values)
        if not bulb:
            stddev_s = math.hypot(stddev_s, named_off_s(exposure_s) / 2)
        frame = replace(frame, exposure_s=exposure_s, mid_unix_s=mid_s, stamp_stddev_s=stddev_s)
        return CapturedFrame(frame, Capture.COMMAND, remark=remark)

    def _delete(self, camera: Gphoto2Camera, files: list[str]) -> str:
        """Delete the files of this exposure in the camera; return a sentence if that failed, otherwise ''."""
        import gphoto2

        try:
            camera.delete(files)
        except gphoto2.GPhoto2Error as error:
            return f"{self.hardware_id}: frames stay in the camera, which fills up ({error.string})."
        return ""


def named_off_s(exposure_s: float) -> float:
    """Error of the nominal exposure (s): shutters go by thirds of powers of 2, so that 30 s may be 32 s."""
    return abs(2 ** (round(3 * math.log2(exposure_s)) / 3) - exposure_s)
