# SPDX-License-Identifier: Apache-2.0
"""A robot's own messages as its instrument's: stars detected in its images, tilts made of its accelerations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from starpos.frames.frame import Stars
from starpos.messages.camera import ExposureFacts, check_stamp, message_to_frame, message_to_picture
from starpos.messages.stamp import PlainHeader, PlainStamp, stamp_to_unix
from starpos.messages.tilt import ImuTilts, Reading
from starpos.parameters.given import values_of
from starpos.recording.topics import IMAGE, NO_REMAPS, Remaps


@dataclass(frozen=True)
class Drivers:
    """How a robot's messages are used: parameters of detector and inclinometer by name, and the topics."""

    detector: Mapping[str, Any]
    inclinometer: Mapping[str, Any]
    remaps: Remaps = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        file: Path | None = None,
        given: Sequence[str] = (),
        namespace: str | None = None,
        remaps: Remaps = NO_REMAPS,
    ) -> "Drivers":
        """Read them from a parameter file and texts NODE:NAME:=VALUE; errors as `values_of` raises them."""
        detector, inclinometer = (values_of(n, file, given, namespace) for n in ("detector", "inclinometer"))
        return cls(detector, inclinometer, remaps)


class DriverMessages:
    """Takes the messages of a robot's drivers in one bag one after another, as the nodes detector and inclinometer do."""

    def __init__(self, drivers: Drivers) -> None:
        self._drivers = drivers
        self._exposures = ExposureFacts(drivers.detector)
        self._imu = ImuTilts(drivers.inclinometer)
        self._frames = self._tilts = 0

    def receive_capture(self, message: Any) -> None:
        self._exposures.keep_capture(message)

    def stars_of(self, kind: str, message: Any) -> tuple[Stars, PlainHeader]:
        """The stars of an image of this type and the header of their message; raises StarposError without any."""
        from starpos.detection import DetectionSettings, detect

        self._frames += 1
        check_stamp(message.header)
        mid_ns, add = self._exposures.of(message.header)
        frame = add(message_to_frame(message) if kind == IMAGE else message_to_picture(message))
        header = PlainHeader(PlainStamp.of_ns(mid_ns), message.header.frame_id)
        return _as_sent(
            detect(frame, DetectionSettings.by_parameters(self._drivers.detector)).stars, header
        ), header

    def tilt_of(self, message: Any, now_s: float) -> Reading | None:
        """The tilt that an IMU's message completes; now_s: when it was recorded."""
        reading = self._imu.receive(message, round(now_s * 1e9))
        if reading is None:
            return None
        self._tilts += 1
        return replace(reading, frame_id=self._drivers.inclinometer["frame_id"])

    def remarks(self) -> list[str]:
        """Sentences on missing parameters, and on accelerations that gave no tilt."""
        said = [self._exposures.missing_statement] if self._frames else []
        imu = self._imu
        heard = imu.good + imu.malformed + imu.future
        if heard and not self._tilts:
            why = imu.unrest or (
                f"{imu.malformed} are broken and {imu.future} stamped after they were recorded"
                if imu.malformed + imu.future
                else "too few come in imu.average"
            )
            said.append(f"no tilt was made of {heard} messages of the IMU: {why}")
        return [sentence for sentence in said if sentence]


def _as_sent(stars: Stars, header: PlainHeader) -> Stars:
    """Stars with the numbers that a StarArray holds of them."""
    return replace(
        stars,
        flux=stars.flux.astype(np.float32),
        snr=stars.snr.astype(np.float32),
        mid_unix_s=stamp_to_unix(header.stamp),
        source="stars",
        fwhm_px=None,
        window=None,
        negative=False,
    )
