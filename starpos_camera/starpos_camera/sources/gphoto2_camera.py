# SPDX-License-Identifier: Apache-2.0
"""One camera held through libgphoto2: its settings, an exposure, its files.

GPhoto2Error where the camera fails, CaptureError where it does something else than was asked.
"""

import math
import re
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import PurePosixPath

from starpos_camera.sources.source import CaptureError

TOLERANCE = 0.05  # of an exposure or a gain from one the camera has
AFTER_S = 20.0  # from the end of an exposure to its file; slow cards take some seconds
COMPANIONS_S = 0.3  # from a file to others of the same exposure
DRAIN_S = 1.0  # for the events that are left of what was before
POLL_S = 0.1
STORE_FULL = "PTP Event 400a"  # of the standard, PIMA 15740; libgphoto2 has no word for it
MAX_FILE_BYTES = 500_000_000


class Gphoto2Camera:
    """An open camera. `closing`, once set, ends what waits."""

    def __init__(self, model: str, port: str, closing: threading.Event):
        """The one camera that fits, initialised; CaptureError where it is none or one of several."""
        import gphoto2

        self._gp = gphoto2
        self._closing = closing
        name, place = (model, port) if model and port else _found(model, port)
        ports, kinds = gphoto2.PortInfoList(), gphoto2.CameraAbilitiesList()
        ports.load()
        kinds.load()
        self._camera = gphoto2.Camera()
        self._camera.set_port_info(ports[ports.lookup_path(place)])
        self._camera.set_abilities(kinds[kinds.lookup_model(name)])
        self._camera.init()

    def release(self):
        with suppress(self._gp.GPhoto2Error):  # it has gone
            self._camera.exit()

    def setting(self, name: str):
        """A setting's widget; None where the camera has none of the name."""
        try:
            return self._camera.get_single_config(name)
        except self._gp.GPhoto2Error as error:
            if error.code == self._gp.GP_ERROR_BAD_PARAMETERS:
                return None
            raise

    def choices(self, widget) -> list[str]:
        try:
            return [widget.get_choice(k) for k in range(widget.count_choices())]
        except self._gp.GPhoto2Error:  # a setting of another kind
            return []

    def choose(self, widget, choice: str | None):
        """Have a setting at a choice (None: leave it), and see that it is."""
        if choice is None or widget.get_value() == choice:
            return
        name = widget.get_name()
        if not widget.get_readonly():
            widget.set_value(choice)
            self._camera.set_single_config(name, widget)
        has = self._camera.get_single_config(name).get_value()
        if has != choice:
            raise CaptureError(f"its {name} stays at {has!r}, not {choice!r}: turn its dial to M.")

    def prefer(self, name: str, pattern: str):
        """Have a setting at its first choice that fits a regular expression, where it has such."""
        if (widget := self.setting(name)) is not None:
            self.choose(widget, next((c for c in self.choices(widget) if re.search(pattern, c, re.I)), None))

    def set_exposure(self, name: str, wanted_s: float | None) -> tuple[float, bool]:
        """Have the shutter at an exposure (None: as it is); the exposure in s, and whether it has to be held open."""
        widget = self.setting(name)
        if widget is None:
            raise CaptureError(f"it has no setting {name!r}: give its own in gphoto2.shutter_setting.")
        if wanted_s is None:
            exposure_s = seconds(widget.get_value())
            if exposure_s is None:
                raise CaptureError(f"its {name} stands at {widget.get_value()!r}: set `exposure`.")
            return exposure_s, False
        speeds = {c: s for c in self.choices(widget) if (s := seconds(c)) is not None}
        longest_s = max(speeds.values(), default=math.inf)
        if wanted_s > (1 + TOLERANCE) * longest_s and self.setting("bulb") is not None:
            self.choose(widget, next((c for c in self.choices(widget) if "bulb" in c.lower()), None))
            return wanted_s, True
        choice = nearest(speeds, wanted_s, f"{name} of {wanted_s:g} s")
        self.choose(widget, choice)
        return speeds[choice], False

    def set_gain(self, name: str, wanted: float):
        widget = self.setting(name)
        if widget is None:
            raise CaptureError(f"it has no setting {name!r} for `gain`: give its own in gphoto2.iso_setting.")
        gains = {c: float(c) for c in self.choices(widget) if re.fullmatch(r"\d+(\.\d+)?", c, re.ASCII)}
        self.choose(widget, nearest(gains, wanted, f"{name} of {wanted:g}"))

    def trigger(self):
        """Begin an exposure; some cameras return when it has ended."""
        self._camera.trigger_capture()

    def hold_open(self, exposure_s: float) -> float:
        """Hold the shutter open; how long it was (s)."""
        bulb = self._camera.get_single_config("bulb")
        begin = time.monotonic()
        bulb.set_value(1)
        self._camera.set_single_config("bulb", bulb)
        try:
            self._closing.wait(max(0.0, begin + exposure_s - time.monotonic()))
        finally:
            held_s = time.monotonic() - begin
            bulb.set_value(0)
            self._camera.set_single_config("bulb", bulb)
        return held_s

    def drain(self):
        """Forget the events of before: some cameras stop when they pile up."""
        end = time.monotonic() + DRAIN_S
        while time.monotonic() < end:
            kind, _ = self._camera.wait_for_event(1)
            if kind == self._gp.GP_EVENT_TIMEOUT:
                return

    def files(self, exposure_s: float) -> list[str]:
        """The paths of the files that the exposure makes, at least one; waits for them."""
        # with its noise reduction on, a camera takes a dark frame as long as the exposure before it gives the file
        found, end = [], time.monotonic() + 2 * exposure_s + AFTER_S
        while (now := time.monotonic()) < end:
            if self._closing.is_set():
                raise CaptureError("the node ends.")
            kind, what = self._camera.wait_for_event(round(1000 * POLL_S))
            if kind == self._gp.GP_EVENT_FILE_ADDED:
                found.append(str(PurePosixPath(what.folder) / what.name))
                end = min(end, now + COMPANIONS_S)
            elif kind == self._gp.GP_EVENT_UNKNOWN and str(what).startswith(STORE_FULL):
                raise CaptureError(sentence(self._gp.GP_ERROR_NO_SPACE))
            elif kind == self._gp.GP_EVENT_TIMEOUT:  # which some do not wait for
                self._closing.wait(max(0.0, min(end, now + POLL_S) - time.monotonic()))
        if not found:
            raise CaptureError(
                f"no file has come {exposure_s + AFTER_S:.0f} s after its exposure; look at its display."
            )
        return found

    def fetch(self, path: str) -> bytes:
        """A file's bytes."""
        place = str(PurePosixPath(path).parent), PurePosixPath(path).name
        size = self._camera.file_get_info(*place).file.size
        if not 0 < size <= MAX_FILE_BYTES:
            raise CaptureError(f"{path} is said to have {size} bytes; look at the camera's card.")
        file = self._camera.file_get(*place, self._gp.GP_FILE_TYPE_NORMAL)
        data = bytes(file.get_data_and_size())  # a copy: the memory is the file's
        if len(data) != size:
            raise CaptureError(f"{path} came with {len(data)} of its {size} bytes.")
        return data

    def delete(self, files: list[str]):
        for path in map(PurePosixPath, files):
            self._camera.file_delete(str(path.parent), path.name)


def _found(model, port):
    """Name and port of the one camera on the buses that fits."""
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
    """Of a shutter speed as cameras write them: 1/30, 0.5, 13/10, 0.0100s, 30"; None of bulb, Auto and the like."""
    match = re.fullmatch(r'(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*(?:s|sec|")?', str(text).strip(), re.ASCII)
    if not match or not float(match[1]) or not float(match[2] or 1):
        return None
    return float(match[1]) / float(match[2] or 1)


def nearest(values: Mapping[str, float], wanted: float, what: str) -> str:
    """The choice whose value is the wanted one to 5 %; CaptureError that names its neighbours where there is none."""
    order = sorted(values, key=values.get)
    best = min(order, key=lambda choice: abs(values[choice] - wanted), default=None)
    if best is not None and abs(values[best] - wanted) <= TOLERANCE * wanted:
        return best
    below = [choice for choice in order if values[choice] < wanted][-1:]
    above = [choice for choice in order if values[choice] > wanted][:1]
    raise CaptureError(
        f"it has no {what}; the nearest are {' and '.join(below + above) or 'not told: turn its dial to M'}."
    )


def sentence(code: int) -> str:
    """What an error of libgphoto2 means."""
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
        gphoto2.GP_ERROR_TIMEOUT: "it does not answer; look after the cable, or switch it off and on.",
    }
    told = gphoto2.gp_result_as_string(code)
    return known.get(code, f"{told} ({code}); look after the cable, or switch it off and on.")
