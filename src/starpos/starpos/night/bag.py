# SPDX-License-Identifier: Apache-2.0
"""Reads one instrument's messages from a rosbag2."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, InstrumentError, TiltError
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog
from starpos.messages.camera import message_to_camera
from starpos.messages.tilt import UNUSABLE, message_to_tilt
from starpos.night.drivers import IMAGES, DriverMessages, Drivers, named_image
from starpos.night.folder import truth_in
from starpos.night.night import Shot, Truth
from starpos.night.remarks import Kind, Remark
from starpos.night.solutions import deflection_of, named_stars, shot_of
from starpos.progress import Progress
from starpos.recording.bag import BagReader
from starpos.recording.drivers import CAMERA_INFO, CAPTURE, IMU, TILT
from starpos.recording.instruments import INPUTS, SOLUTION, STARS, Chosen, instrument_in

SUFFIXES = (".mcap", ".db3")
TOPICS = INPUTS | {"solver/solution": SOLUTION}
# types of messages that are a frame each
WITH_STARS = (STARS, *IMAGES)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One instrument's part of a bag.

    drivers: how a robot's own messages are used.  cameras: by (width, height) of their frames in px.
    star_count: star lists, or images that stars are detected in.  solutions: as the solver published them.
    deflection: as the solver applied it, None if no solution states it.
    """

    path: Path
    namespace: str
    drivers: Drivers
    cameras: dict[tuple[int, int], Camera]
    tilts: TiltLog | None
    star_count: int
    solutions: tuple[Shot, ...]
    deflection: Deflection | None
    truth: Truth | None
    remarks: tuple[Remark, ...]

    @property
    def name(self) -> str:
        """Name for headings: the bag's own, and the namespace if there is one."""
        return self.path.name + (f" {self.namespace}" if self.namespace != "/" else "")


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a folder with metadata.yaml or a bag's files, or a file with a bag's suffix."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return (path / "metadata.yaml").is_file() or any(next(path.glob(f"*{s}"), None) for s in SUFFIXES)


def read(
    path: Path, namespace: str | None, tilt_noise_rad: float, drivers: Drivers, progress: Progress
) -> Recorded:
    """Read everything of one instrument, or of a robot's own drivers, except the stars.

    namespace: the instrument's; None where there is only one.  tilt_noise_rad: sigma of readings that state none.
    Raises BagError if the bag cannot be read, FrameError if the instrument is not in it.
    """
    with BagReader(path, typed=True) as bag:
        chosen = _instrument(bag, path, namespace, drivers)
        reading = _Reading(tilt_noise_rad, drivers.begin())
        wanted = [c for c in chosen.connections if c.msgtype not in WITH_STARS]
        total = sum(c.msgcount for c in wanted) or 1
        for done, (connection, log_ns, message) in enumerate(bag.decoded(wanted), 1):
            reading.take(connection.msgtype, message, log_ns * 1e-9)
            if done % 500 == 0 or done == total:
                progress(path.name[:20], done / total)
        return Recorded(
            path=path,
            namespace=chosen.namespace,
            drivers=drivers,
            cameras=reading.cameras,
            tilts=reading.tilt_log(),
            star_count=sum(c.msgcount for c in chosen.connections if c.msgtype in WITH_STARS),
            solutions=tuple(reading.solutions),
            deflection=reading.deflection,
            truth=truth_in(path) if path.is_dir() else None,
            remarks=reading.remarks(path, chosen.made),
        )


def each_frame(r: Recorded) -> Iterator[tuple[str, Stars | FrameError]]:
    """A name for each frame, one at a time, and its stars, or why it has none."""
    messages = r.drivers.begin()
    with BagReader(r.path, typed=True) as bag:
        chosen = _instrument(bag, r.path, r.namespace, r.drivers)
        wanted = [c for c in chosen.connections if c.msgtype in (*WITH_STARS, CAPTURE)]
        for connection, _, message in bag.decoded(wanted):
            if connection.msgtype == STARS:
                yield named_stars(message)
            elif connection.msgtype == CAPTURE:
                messages.take_capture(message)
            else:
                yield named_image(connection.msgtype, message, messages)


def _instrument(bag: BagReader, path: Path, namespace: str | None, drivers: Drivers) -> Chosen:
    """The instrument, or a robot's own drivers; raises FrameError if it is not there or one of several."""
    return instrument_in(bag, path, namespace, TOPICS, (STARS, SOLUTION), drivers.remaps)


class _Reading:
    """Collects the messages of one instrument."""

    def __init__(self, tilt_noise_rad: float, messages: DriverMessages):
        self.cameras: dict[tuple[int, int], Camera] = {}
        self.solutions: list[Shot] = []
        self.deflection: Deflection | None = None
        self._unknown_stddev_rad, self._messages = tilt_noise_rad, messages
        self._tilts: list[Tilt] = []
        self._unusable = 0
        self._why_no_camera = ""

    def take(self, kind: str, message: Any, log_s: float) -> None:
        """Take in a message of a type; an impossible tilt or camera only leads to a remark."""
        if kind == IMU:
            kind, message = TILT, self._messages.tilt_of(message, log_s)
            if message is None:
                return
        if kind == TILT:
            tilt: Tilt | None
            try:
                tilt = message_to_tilt(message, self._unknown_stddev_rad)
            except TiltError:
                tilt = None
            if tilt is None or message.flags & UNUSABLE:
                self._unusable += 1
            else:
                self._tilts.append(tilt)
        elif kind == SOLUTION:
            self.solutions.append(shot_of(message, self.cameras))
            if self.deflection is None and message.status == 0:
                self.deflection = deflection_of(message)
        elif kind == CAMERA_INFO:
            try:
                camera = message_to_camera(message, "its camera_info")
                self.cameras.setdefault((camera.width, camera.height), camera)
            except InstrumentError as error:
                self._why_no_camera = str(error)

    def tilt_log(self) -> TiltLog | None:
        """The usable tilts; None without any."""
        in_time = sorted(self._tilts, key=lambda tilt: tilt.utc_unix_s)
        return TiltLog.of_readings(in_time) if in_time else None

    def remarks(self, path: Path, made: str) -> tuple[Remark, ...]:
        """Remarks on left-out messages, and on how a robot's own messages were used."""
        said = [Remark(Kind.RECORDED, f"{path.name}: {made}")] if made else []
        said += [Remark(Kind.TILTS, sentence) for sentence in self._messages.remarks()]
        if self._unusable:
            sentence = f"{self._unusable} tilts of the bag were left out: flagged, out of range or broken"
            said.append(Remark(Kind.TILTS, sentence))
        if self._why_no_camera and not self.cameras:
            said.append(Remark(Kind.RECORDED, f"{path.name}: {self._why_no_camera}"))
        return tuple(said)
