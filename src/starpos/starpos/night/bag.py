# SPDX-License-Identifier: Apache-2.0
"""Reads what a rosbag2 holds of one instrument."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.earth.vertical import Deflection
from starpos.errors import InstrumentError, TiltError
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog
from starpos.messages.camera import message_to_camera
from starpos.messages.tilt import UNUSABLE, message_to_tilt
from starpos.night.folder import truth_in
from starpos.night.night import Shot, Truth
from starpos.night.remarks import Kind, Remark
from starpos.night.solutions import deflection_of, shot_of
from starpos.progress import Progress
from starpos.recording.bag import BagReader
from starpos.recording.instruments import INPUTS, SOLUTION, STARS, TILT, instrument_in

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

SUFFIXES = (".mcap", ".db3")
TOPICS = INPUTS | {"solver/solution": SOLUTION}


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One instrument's part of a bag.

    cameras: by (width, height) of their frames in px.  solutions: as the solver published them.
    deflection: that the solver applied, None if no solution says so.
    """

    path: Path
    namespace: str
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


def read(path: Path, namespace: str | None, tilt_noise_rad: float, progress: Progress) -> Recorded:
    """Read all of one instrument but its stars.

    namespace: the instrument's; None where there is only one.  tilt_noise_rad: sigma of readings that state none.
    Raises BagError if the bag cannot be read, FrameError if the instrument is not in it.
    """
    with BagReader(path, typed=True) as bag:
        chosen, connections = _instrument(bag, path, namespace)
        reading = _Reading(tilt_noise_rad)
        wanted = [c for c in connections if c.msgtype != STARS]
        total = sum(c.msgcount for c in wanted) or 1
        for done, (connection, _, message) in enumerate(bag.decoded(wanted), 1):
            reading.take(connection.msgtype, message)
            if done % 500 == 0 or done == total:
                progress(path.name[:20], done / total)
        return Recorded(
            path=path,
            namespace=chosen,
            cameras=reading.cameras,
            tilts=reading.tilt_log(),
            star_count=sum(c.msgcount for c in connections if c.msgtype == STARS),
            solutions=tuple(reading.solutions),
            deflection=reading.deflection,
            truth=truth_in(path) if path.is_dir() else None,
            remarks=reading.remarks(path),
        )


def star_arrays(r: Recorded) -> Iterator[Any]:
    """The StarArray messages of an instrument, one at a time."""
    with BagReader(r.path, typed=True) as bag:
        _, connections = _instrument(bag, r.path, r.namespace)
        for _, _, message in bag.decoded([c for c in connections if c.msgtype == STARS]):
            yield message


def _instrument(bag: BagReader, path: Path, namespace: str | None) -> "tuple[str, Sequence[Connection]]":
    """Namespace and connections of the instrument; raises FrameError if it is not there or one of several."""
    return instrument_in(bag, path, namespace, TOPICS, (STARS, SOLUTION))


class _Reading:
    """Collects the messages of one instrument."""

    def __init__(self, tilt_noise_rad: float):
        self.cameras: dict[tuple[int, int], Camera] = {}
        self.solutions: list[Shot] = []
        self.deflection: Deflection | None = None
        self._unknown_stddev_rad = tilt_noise_rad
        self._tilts: list[Tilt] = []
        self._unusable = 0
        self._why_no_camera = ""

    def take(self, kind: str, message: Any) -> None:
        """Take in a message of a type; a tilt or a camera that cannot be is remarked only."""
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
        else:
            try:
                camera = message_to_camera(message, "its camera_info")
                self.cameras.setdefault((camera.width, camera.height), camera)
            except InstrumentError as error:
                self._why_no_camera = str(error)

    def tilt_log(self) -> TiltLog | None:
        """The usable tilts; None if there are none."""
        in_time = sorted(self._tilts, key=lambda tilt: tilt.utc_unix_s)
        return TiltLog.of_readings(in_time) if in_time else None

    def remarks(self, path: Path) -> tuple[Remark, ...]:
        """What is to be said of what was left out."""
        said = []
        if self._unusable:
            sentence = f"{self._unusable} tilts of the bag were left out: flagged, out of range or broken"
            said.append(Remark(Kind.TILTS, sentence))
        if self._why_no_camera and not self.cameras:
            said.append(Remark(Kind.RECORDED, f"{path.name}: {self._why_no_camera}"))
        return tuple(said)
