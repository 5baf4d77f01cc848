# SPDX-License-Identifier: Apache-2.0
"""Canon, Nikon and other cameras that libgphoto2 knows, by USB or PTP/IP, through PyPI's gphoto2."""

import math
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

from starpos.frames.reading import RAW, decode_frame
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource, missing
from starpos_camera.sources.timing import dated_by_command

# Largest difference of an exposure or a gain from one that the camera has, as a share.
TOLERANCE = 0.05
# From the end of an exposure to its file; slow cards take some seconds.
AFTER_S = 20.0
# From a file to the others of the same exposure.
COMPANIONS_S = 0.3
# For the events that are left from before.
DRAIN_S = 1.0
POLL_S = 0.1
# An event of the standard PIMA 15740 for which libgphoto2 has no name.
STORE_FULL = "PTP Event 400a"
MAX_FILE_BYTES = 500_000_000


class Gphoto2Camera:
    """An open camera: its settings, its exposures, its files. Setting `closing` ends all waiting.

    GPhoto2Error is raised if the camera fails, CaptureError if it does something else than was asked.
    """

    def __init__(self, model: str, port: str, closing: threading.Event) -> None:
        """Open the one camera that fits; CaptureError if none fits, or several."""
        import gphoto2

        self._gp = gphoto2
        self._closing = closing
        name, place = (model, port) if model and port else _find_camera(model, port)
        ports, kinds = gphoto2.PortInfoList(), gphoto2.CameraAbilitiesList()
        ports.load()
        kinds.load()
        self._camera = gphoto2.Camera()
        self._camera.set_port_info(ports[ports.lookup_path(place)])
        self._camera.set_abilities(kinds[kinds.lookup_model(name)])
        self._camera.init()

    def release(self) -> None:
        # The camera may have gone.
        with suppress(self._gp.GPhoto2Error):
            self._camera.exit()

    def setting(self, name: str) -> Any:
        """Return the widget of a setting; None if the camera has no such setting."""
        try:
            return self._camera.get_single_config(name)
        except self._gp.GPhoto2Error as error:
            if error.code == self._gp.GP_ERROR_BAD_PARAMETERS:
                return None
            raise

    def choices(self, widget: Any) -> list[str]:
        try:
            return [widget.get_choice(k) for k in range(widget.count_choices())]
        except self._gp.GPhoto2Error:
            # The setting is of another kind, without choices.
            return []

    def choose(self, widget: Any, choice: str | None) -> None:
        """Set a setting to a choice (None: leave it) and check it; CaptureError if it stays at another one."""
        if choice is None or widget.get_value() == choice:
            return
        name = widget.get_name()
        if not widget.get_readonly():
            widget.set_value(choice)
            self._camera.set_single_config(name, widget)
        has = self._camera.get_single_config(name).get_value()
        if has != choice:
            raise CaptureError(f"its {name} stays at {has!r}, not {choice!r}: turn its dial to M.")

    def prefer(self, name: str, pattern: str) -> None:
        """Set a setting to its first choice that matches a regular expression, if it has one."""
        if (widget := self.setting(name)) is not None:
            self.choose(widget, next((c for c in self.choices(widget) if re.search(pattern, c, re.I)), None))

    def set_exposure(self, name: str, wanted_s: float | None) -> float:
        """Set the shutter (None: leave it); return the exposure in s."""
        widget = self.setting(name)
        if widget is None:
            raise CaptureError(f"it has no setting {name!r}: give its own in gphoto2.shutter_setting.")
        if wanted_s is None:
            exposure_s = seconds(widget.get_value())
            if exposure_s is None:
                raise CaptureError(f"its {name} stands at {widget.get_value()!r}: set `exposure`.")
            return exposure_s
        speeds = {c: s for c in self.choices(widget) if (s := seconds(c)) is not None}
        choice = nearest(speeds, wanted_s, f"{name} of {wanted_s:g} s")
        self.choose(widget, choice)
        return speeds[choice]

    def set_gain(self, name: str, wanted: float) -> None:
        widget = self.setting(name)
        if widget is None:
            raise CaptureError(f"it has no setting {name!r} for `gain`: give its own in gphoto2.iso_setting.")
        gains = {c: float(c) for c in self.choices(widget) if re.fullmatch(r"\d+(\.\d+)?", c, re.ASCII)}
        self.choose(widget, nearest(gains, wanted, f"{name} of {wanted:g}"))

    def trigger(self) -> None:
        """Begin an exposure; with some cameras this returns only at its end."""
        self._camera.trigger_capture()

    def drain(self) -> None:
        """Drop the events from before, because some cameras stop when they pile up."""
        end = time.monotonic() + DRAIN_S
        while time.monotonic() < end:
            kind, _ = self._camera.wait_for_event(1)
            if kind == self._gp.GP_EVENT_TIMEOUT:
                return

    def files(self, exposure_s: float) -> list[str]:
        """Wait for the files of the exposure and return their paths, at least one."""
        # With noise reduction a camera takes a dark frame, as long as the exposure, before it gives the file.
        patience_s = 2 * exposure_s + AFTER_S
        found: list[str] = []
        end = time.monotonic() + patience_s
        while (now := time.monotonic()) < end:
            if self._closing.is_set():
                raise CaptureError("the node ends.")
            kind, what = self._camera.wait_for_event(round(1000 * POLL_S))
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                found.append(str(PurePosixPath(what.folder) / what.name))
                end = min(end, now + COMPANIONS_S)
            elif kind == self._gp.GP_EVENT_UNKNOWN and str(what).startswith(STORE_FULL):
                raise CaptureError(sentence(self._gp.GP_ERROR_NO_SPACE))
            elif kind == self._gp.GP_EVENT_TIMEOUT:
                # Some cameras return this event at once.
                self._closing.wait(max(0.0, min(end, now + POLL_S) - time.monotonic()))
        if not found:
            raise CaptureError(
                f"no file of an exposure of {exposure_s:g} s has come in {patience_s:.0f} s; look at its display."
            )
        return found

    def fetch(self, path: str) -> bytes:
        place = str(PurePosixPath(path).parent), PurePosixPath(path).name
        size = self._camera.file_get_info(*place).file.size
        if not 0 < size <= MAX_FILE_BYTES:
            raise CaptureError(f"{path} is said to have {size} bytes; look at the camera's card.")
        file = self._camera.file_get(*place, self._gp.GP_FILE_TYPE_NORMAL)
        # A copy, because the memory belongs to the file.
        data = bytes(file.get_data_and_size())
        if len(data) != size:
            raise CaptureError(f"{path} came with {len(data)} of its {size} bytes.")
        return data

    def delete(self, files: list[str]) -> str:
        """Delete the files of an exposure in the camera; return a sentence if that failed, otherwise ''."""
        try:
            for path in map(PurePosixPath, files):
                self._camera.file_delete(str(path.parent), path.name)
        except self._gp.GPhoto2Error as error:
            return f"frames stay in the camera, which fills up ({error.string})."
        return ""


def _find_camera(model: str, port: str) -> tuple[str, str]:
    """Find name and port of the one camera on the buses that fits."""
    import gphoto2

    found = gphoto2.Camera.autodetect()
    cameras = [(found.get_name(k), found.get_value(k)) for k in range(found.count())]
    fitting = [c for c in cameras if model.lower() in c[0].lower() and port in ("", c[1])]
    if len(fitting) == 1:
        return fitting[0]
    if not cameras:
        raise CaptureError("no camera is on the bus; plug it in and switch it on.")
    there = ", ".join(f"{name} at {place}" for name, place in cameras)
    raise CaptureError(f"of {there}, {len(fitting)} fit gphoto2.model and gphoto2.port: name one.")


def seconds(text: str) -> float | None:
    """Read a shutter speed as cameras write it: 1/30, 0.5, 13/10, 0.0100s, 30"; None for bulb, Auto and the like."""
    match = re.fullmatch(r'(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*(?:s|sec|")?', str(text).strip(), re.ASCII)
    if not match or not float(match[1]) or not float(match[2] or 1):
        return None
    return float(match[1]) / float(match[2] or 1)


def nearest(values: Mapping[str, float], wanted: float, what: str) -> str:
    """Find the choice whose value is within 5 % of the wanted one; CaptureError with the nearest ones if none is."""
    order = sorted(values, key=lambda choice: values[choice])
    best = min(order, key=lambda choice: abs(values[choice] - wanted), default=None)
    if best is not None and abs(values[best] - wanted) <= TOLERANCE * wanted:
        return best
    below = [choice for choice in order if values[choice] < wanted][-1:]
    above = [choice for choice in order if values[choice] > wanted][:1]
    raise CaptureError(
        f"it has no {what}; the nearest are {' and '.join(below + above) or 'not told: turn its dial to M'}."
    )


def sentence(code: int) -> str:
    """Say in a sentence what an error of libgphoto2 means."""
    import gphoto2

    known = {
        gphoto2.GP_ERROR_IO_USB_CLAIM: "another program holds it, on a desktop mostly gvfs: stop that (systemctl --user "
        "mask --now gvfs-gphoto2-volume-monitor) and plug it in again.",
        gphoto2.GP_ERROR_IO_USB_FIND: "it is not on the bus; plug it in and switch it on.",
        gphoto2.GP_ERROR_MODEL_NOT_FOUND: "libgphoto2 knows no such model; correct gphoto2.model.",
        gphoto2.GP_ERROR_UNKNOWN_PORT: "there is no such port; correct gphoto2.port.",
        gphoto2.GP_ERROR_CAMERA_BUSY: "it is busy; let it finish, or switch it off and on.",
        gphoto2.GP_ERROR_NO_MEMORY: "its memory or card is full; empty it.",
        gphoto2.GP_ERROR_NO_SPACE: "its memory or card is full; empty it.",
        gphoto2.GP_ERROR_TIMEOUT: "it does not answer; check the cable, or switch it off and on.",
    }
    told = gphoto2.gp_result_as_string(code)
    return known.get(code, f"{told} ({code}); check the cable, or switch it off and on.")


# Each target with a part of its name in libgphoto2.
TARGETS = {"memory": "ram", "card": "card"}
# Names of the setting with Canon and with Nikon.
FORMATS = ("imageformat", "imagequality")
RAW_ALONE = r"^(?!.*(jpe?g|\+|fine|large)).*\b(raw|nef)\b"


class Gphoto2(DeviceSource[Gphoto2Camera]):
    """Commands each exposure, waits for its file, fetches and deletes it. The camera's dial must stand at M."""

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
        super().__init__(values, now)
        which = filter(None, (values["gphoto2.model"], values["gphoto2.port"]))
        self.hardware_id = " ".join(("gphoto2", *which))

    def _explain(self, error: Exception) -> str | None:
        import gphoto2

        return sentence(error.code) if isinstance(error, gphoto2.GPhoto2Error) else None

    def _open(self) -> Gphoto2Camera:
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
        set_s = camera.set_exposure(self._values["gphoto2.shutter_setting"], settings.exposure_s)
        if settings.gain is not None:
            camera.set_gain(self._values["gphoto2.iso_setting"], settings.gain)
        commanded_s = self._now()
        camera.trigger()
        files = camera.files(set_s)
        file = next((f for f in files if PurePosixPath(f).suffix.lower() in RAW), files[0])
        data = camera.fetch(file)
        remark = "" if self._values["gphoto2.keep"] else camera.delete(files)
        frame = decode_frame(data, file)
        exposure_s = set_s if frame.exposure_s is None else frame.exposure_s
        if abs(math.log(exposure_s / set_s)) > TOLERANCE:
            remark = f"it says that it exposed for {exposure_s:g} s, though its shutter stood at {set_s:g} s."
        taken = dated_by_command(replace(frame, exposure_s=exposure_s), commanded_s, self._values)
        stddev_s = math.hypot(taken.frame.stamp_stddev_s, named_off_s(exposure_s) / 2)
        return replace(taken, frame=replace(taken.frame, stamp_stddev_s=stddev_s), remark=remark)


def named_off_s(exposure_s: float) -> float:
    """Error of the nominal exposure (s): shutters go by thirds of powers of 2, so that 30 s may be 32 s."""
    return abs(2 ** (round(3 * math.log2(exposure_s)) / 3) - exposure_s)
