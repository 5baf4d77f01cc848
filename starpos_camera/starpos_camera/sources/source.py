# SPDX-License-Identifier: Apache-2.0
"""What a camera is to the node. Every camera is a Source; a new one is a module here and a line in `registry`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from starpos.errors import StarposError
from starpos.frames.frame import Frame
from starpos.instrument.camera import Camera
from starpos_common.parameters import Parameter


class CaptureError(StarposError):
    """The camera is not there, or gave no frame."""


class NothingYet(StarposError):
    """No frame has come since the last one, and that is as it should be."""


class SourceEnded(StarposError):
    """There are no more frames, and there will be none: not a fault."""


@dataclass(frozen=True)
class CaptureSettings:
    """How to take the next frame.

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

    frame         with its time: mid_unix_s and stamp_stddev_s are set, clock_stddev_s where another machine told it
    stamp_source  one of starpos_interfaces/Capture's constants
    camera        intrinsics that the source knows to be true; None: the node's
    remark        what is wrong with the camera, though the frame is good: a sentence; '' for nothing
    """

    frame: Frame
    stamp_source: int
    camera: Camera | None = None
    remark: str = ""


class FrameSource(Protocol):
    """A camera. Made as SourceClass(values, now): the node's parameters, and its clock in Unix seconds.

    Making one opens nothing and cannot fail for want of a device: `capture` opens what is not open, so that a
    device may come, go and come back. All methods but `close` and `capture` return at once. The module imports what
    only its own devices need (a vendor's library) where it is used: every node imports every source.
    """

    parameters: Sequence[Parameter]  # each named `source.something`
    hardware_id: str
    waits_for_listener: bool  # True: nothing is captured before someone subscribes to the images

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        """A sentence where a source with these parameters cannot be made, or cannot take such frames."""

    def lacking(self) -> str | None:
        """A sentence where `capture` would find nothing; asked before the first frame, each cadence."""

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        """Take the next frame, in a thread of the node's; blocks until it is there.

        StarposError in one sentence where there is none: the node reports it and calls again one cadence
        later. NothingYet where it waits for one, SourceEnded where there will be none.
        """

    def update(self, values: Mapping):
        """The node's parameters have changed; may be called while `capture` runs."""

    def close(self):
        """Release the device. Called once, also while the last `capture` runs, which then ends soon."""


def missing(module: str, package: str) -> str | None:
    """For `refusal`: the sentence where an optional library is not installed, with the line that installs it."""
    return (
        None
        if find_spec(module)
        else f"this source needs the Python package {package}: pip install {package}"
    )
