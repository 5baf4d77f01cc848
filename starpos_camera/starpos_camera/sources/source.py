# SPDX-License-Identifier: Apache-2.0
"""Interface between the node and a camera. A new camera is a FrameSource in a module here, and a line in `registry`."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Generic, Protocol, TypeVar

import numpy as np

from starpos.errors import StarposError
from starpos.frames.encodings import ENCODINGS, pixels_of
from starpos.frames.frame import Frame


class CaptureError(StarposError):
    """The camera is not there, or gave no frame."""


class NothingYet(StarposError):
    """No frame has come since the last one, which is no fault."""


class SourceEnded(StarposError):
    """There are no more frames, and there will be none, which is no fault."""


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of the next frame.

    exposure_s  None: the source's own
    gain        in the camera's own unit; None: as the camera is set
    cadence_s   from the start of one exposure to the start of the next
    """

    exposure_s: float | None
    gain: float | None
    cadence_s: float

    @property
    def definite_exposure_s(self) -> float:
        """The exposure, for a source that has none of its own."""
        return self.exposure_s or 0.5


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """One frame and how it was taken.

    frame         with its time: mid_unix_s and stamp_stddev_s are set, clock_stddev_s if another machine gave the time,
                  shutter if anything is known of it
    stamp_source  one of starpos_interfaces/Capture's constants
    remark        a sentence about a trouble of the camera although the frame is good; '' for none
    """

    frame: Frame
    stamp_source: int
    remark: str = ""


class FrameSource:
    """A camera, made as SourceClass(values, now): the node's parameters as they are at any time, its clock in Unix s.

    Making one opens no device and cannot fail for lack of one. `capture` opens the device if it is not open, so a
    device may come, go and come back. All methods except `close` and `capture` return at once. A module imports the
    library of its devices only inside the functions that use it, because every node imports every source.
    """

    # Each named `source.something`.
    hardware_id: str
    # True: nothing is captured before somebody subscribes to the images.
    waits_for_listener = False

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        self._values, self._now = values, now

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        """Say in a sentence why a source cannot be made of these parameters, or cannot take such frames; else None."""
        return None

    def lacking(self) -> str | None:
        """Say in a sentence why `capture` would find nothing; asked each cadence before the first frame.

        None also where only an attempt would show it.
        """
        return None

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        """Take the next frame; blocks until it is there, in a thread of the node.

        Raises StarposError with a sentence if there is no frame: the node reports it and calls again one cadence
        later. Raises NothingYet while it waits for a frame, SourceEnded if there will be none.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Release the device; called once. A `capture` that still runs ends soon."""


class Device(Protocol):
    """What a DeviceSource keeps open."""

    def release(self) -> object:
        """Give the device up, which may have gone."""


D = TypeVar("D", bound=Device)


class DeviceSource(FrameSource, Generic[D]):
    """A source whose device is kept open between frames, and opened again after a failure.

    A subclass opens its device, exposes with it, and looks at `_closing` while it waits. Its frames, remarks and errors
    need no name of the camera: it is added here.
    """

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        self._closing = threading.Event()
        self._in_use = threading.Lock()
        self._device: D | None = None

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        with self._in_use:
            try:
                if self._device is None:
                    self._device = self._open()
                taken = self._expose(self._device, settings)
            except Exception as error:
                self._release()
                why = str(error) if isinstance(error, StarposError) else self._explain(error)
                if why is None:
                    raise
                raise CaptureError(f"{self.hardware_id}: {why}") from error
        remark = taken.remark and f"{self.hardware_id}: {taken.remark}"
        return replace(taken, frame=replace(taken.frame, source=self.hardware_id), remark=remark)

    def close(self) -> None:
        self._closing.set()
        with self._in_use:
            self._release()

    def _release(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            device.release()

    def _open(self) -> D:
        """Open the device; CaptureError if it is not there."""
        raise NotImplementedError

    def _expose(self, device: D, settings: CaptureSettings) -> CapturedFrame:
        raise NotImplementedError

    def _explain(self, error: Exception) -> str | None:
        """Say in a sentence what an error of a library means; None for a defect, which the node reports as one."""
        return None


def decoded(encoding: str, data: bytes, size: tuple[int, int], more: int = 0) -> tuple[np.ndarray, str]:
    """Pixels of a driver's buffer, and the pattern of their mosaic; CaptureError for a buffer of another length.

    encoding: one of ENCODINGS.  size: width and height, px.  more: number of bytes after the pixels, to be left out.
    """
    width, height = size
    row = ENCODINGS[encoding].row_bytes(width)
    if len(data) != row * height + more:
        raise CaptureError(f"a frame has {len(data)} bytes instead of {row * height + more}.")
    return pixels_of(encoding, data, width, height, row, False, "the frame")


def missing(module: str, package: str) -> str | None:
    """Say in a sentence, for `refusal`, that an optional library is not installed; None if it is."""
    return (
        None
        if find_spec(module)
        else f"this source needs the Python package {package}: pip install {package}"
    )
