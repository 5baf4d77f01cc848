# SPDX-License-Identifier: Apache-2.0
"""Interface between the node and a camera. A new camera is a FrameSource in a module here, and a line in `registry`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from starpos.errors import StarposError
from starpos.frames.frame import Frame
from starpos.instrument.camera import Camera


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


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """One frame and how it was taken.

    frame         with its time: mid_unix_s and stamp_stddev_s are set, clock_stddev_s if another machine gave the time,
                  shutter if anything is known of it
    stamp_source  one of starpos_interfaces/Capture's constants
    camera        intrinsics that the source knows; None: use the node's
    remark        a sentence about a trouble of the camera although the frame is good; '' for none
    """

    frame: Frame
    stamp_source: int
    camera: Camera | None = None
    remark: str = ""


class FrameSource(Protocol):
    """A camera, made as SourceClass(values, now): the node's parameters, and its clock in Unix seconds.

    Making one opens no device and cannot fail for lack of one. `capture` opens the device if it is not open, so a
    device may come, go and come back. All methods except `close` and `capture` return at once. A module imports the
    library of its devices only inside the functions that use it, because every node imports every source.
    """

    # Each named `source.something`.
    hardware_id: str
    # True: nothing is captured before somebody subscribes to the images.
    waits_for_listener: bool

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None: ...

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        """Say in a sentence why a source cannot be made of these parameters, or cannot take such frames; else None."""

    def lacking(self) -> str | None:
        """Say in a sentence why `capture` would find nothing; asked each cadence before the first frame."""

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        """Take the next frame; blocks until it is there, in a thread of the node.

        Raises StarposError with a sentence if there is no frame: the node reports it and calls again one cadence
        later. Raises NothingYet while it waits for a frame, SourceEnded if there will be none.
        """

    def update(self, values: Mapping) -> None:
        """Apply changed parameters; may be called while `capture` runs."""

    def close(self) -> None:
        """Release the device; called once. A `capture` that still runs ends soon."""


def missing(module: str, package: str) -> str | None:
    """Say in a sentence, for `refusal`, that an optional library is not installed; None if it is."""
    return (
        None
        if find_spec(module)
        else f"this source needs the Python package {package}: pip install {package}"
    )
