# SPDX-License-Identifier: Apache-2.0
"""What a rosbag2 holds of one instrument, read by `rosbags` without ROS."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, InstrumentError, TiltError
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt, TiltLog
from starpos.progress import Progress
from starpos.recording import bounds
from starpos.recording.messages import UNUSABLE, message_to_camera, message_to_tilt
from starpos.report.folder import truth_in
from starpos.report.night import Shot, Truth
from starpos.report.solutions import deflection_of, shot_of

SUFFIXES = (".mcap", ".db3")
PACKAGE = "starpos_interfaces"
STARS, TILT, SOLUTION = (f"{PACKAGE}/msg/{name}" for name in ("StarArray", "Tilt", "Solution"))
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TOPICS = {"stars": STARS, "tilt": TILT, "solver/solution": SOLUTION, "camera/camera_info": CAMERA_INFO}


@dataclass(frozen=True, eq=False, kw_only=True)
class Recorded:
    """One instrument's part of a bag; cameras by (width, height) of their frames; solutions: as the solver made them."""

    path: Path
    namespace: str
    cameras: dict[tuple[int, int], Camera]
    tilts: TiltLog | None
    star_count: int
    solutions: tuple[Shot, ...]
    deflection: Deflection | None  # that the solver applied
    truth: Truth | None
    remarks: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.path.name + (f" {self.namespace}" if self.namespace != "/" else "")


def is_bag(path: Path) -> bool:
    """Whether it should be one: a folder with metadata.yaml or a bag's files, or a file of a bag's suffix."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return (path / "metadata.yaml").is_file() or any(next(path.glob(f"*{s}"), None) for s in SUFFIXES)


def read(path: Path, namespace: str | None, tilt_noise_rad: float, progress: Progress) -> Recorded:
    """All of one instrument but its stars; FrameError where it is no such bag."""
    with _Bag(path) as bag:
        chosen, connections = _instrument(bag, path, namespace)
        reading = _Reading(tilt_noise_rad)
        wanted = [c for c in connections if c.msgtype != STARS]
        total = sum(c.msgcount for c in wanted) or 1
        for done, (kind, message) in enumerate(bag.messages(wanted), 1):
            reading.take(kind, message)
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


def star_lists(r: Recorded) -> Iterator:
    """Its StarArray messages, one at a time."""
    with _Bag(r.path) as bag:
        _, connections = _instrument(bag, r.path, r.namespace)
        for _, message in bag.messages([c for c in connections if c.msgtype == STARS]):
            yield message


class _Bag:
    """An open bag; what `rosbags` raises becomes FrameError."""

    def __init__(self, path: Path):
        self.path = path

    def __enter__(self):
        from rosbags.highlevel import AnyReader

        try:
            bounds.check_folder(self.path)
            bounds.bound_rosbags()
            self._reader = AnyReader([self.path], default_typestore=_usual_types())
            self._reader.open()
            bounds.check_chunks(self._reader.readers[0])
        except Exception as error:  # rosbags, its YAML, zstd and sqlite have their own for a broken file
            raise self._broken(error) from None
        return self

    def __exit__(self, *exception):
        self._reader.close()

    @property
    def connections(self) -> list:
        return self._reader.connections

    def messages(self, connections: list) -> Iterator[tuple[str, object]]:
        """(type, message) in the bag's order."""
        for c in connections:
            if c.msgtype not in self._reader.typestore.fielddefs:
                raise FrameError(
                    f"{self.path}: it does not hold the definition of {c.msgtype}: enter the workspace that has "
                    f"{PACKAGE}, or record as MCAP, which holds them"
                )
        if not connections:
            return
        messages = self._reader.messages(connections)
        while True:
            try:
                connection, _, data = next(messages)
                message = self._reader.deserialize(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:
                raise self._broken(error) from None
            yield connection.msgtype, message

    def _broken(self, error: Exception) -> FrameError:
        if isinstance(error, bounds.BagError):
            return FrameError(f"{self.path}: {error}")
        reason = " ".join(str(error).split())[:200]
        return FrameError(f"{self.path}: not a readable bag ({type(error).__name__}: {reason})")


def _usual_types():
    """For a bag without definitions: ROS's own, and ours where a workspace is entered."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        texts = sorted((Path(prefix) / "share" / PACKAGE / "msg").glob("*.msg")) if prefix else []
        if texts:
            for text in texts:
                store.register(get_types_from_msg(text.read_text(), f"{PACKAGE}/msg/{text.stem}"))
            break
    return store


def _instrument(bag: _Bag, path: Path, namespace: str | None) -> tuple[str, list]:
    """Namespace and connections of the instrument asked for; FrameError where it is not there, or one of several."""
    found: dict[str, list] = {}
    for c in bag.connections:
        for suffix, kind in TOPICS.items():
            if c.msgtype == kind and c.topic.endswith(f"/{suffix}"):
                found.setdefault(c.topic.removesuffix(suffix).rstrip("/") or "/", []).append(c)
    able = sorted(
        n for n, cs in found.items() if any(c.msgtype in (STARS, SOLUTION) and c.msgcount for c in cs)
    )
    if not able:
        raise FrameError(
            f"{path}: neither stars nor solver/solution are in it: record stars, tilt and camera/camera_info"
        )
    wanted = "/" + namespace.strip("/") if namespace is not None else able[0]
    if wanted not in able or (namespace is None and len(able) > 1):
        raise FrameError(f"{path}: the instruments in it are {', '.join(able)}: choose one with --namespace")
    return wanted, found[wanted]


class _Reading:
    """What has been read so far."""

    def __init__(self, tilt_noise_rad: float):
        self.cameras: dict[tuple[int, int], Camera] = {}
        self.solutions: list[Shot] = []
        self.deflection: Deflection | None = None
        self._unknown_stddev_rad = tilt_noise_rad
        self._tilts: list[Tilt] = []
        self._unusable = 0
        self._why_no_camera = ""

    def take(self, kind: str, message) -> None:
        if kind == TILT:
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
        elif (message.width, message.height) not in self.cameras:
            try:
                self.cameras[message.width, message.height] = message_to_camera(message, "its camera_info")
            except InstrumentError as error:
                self._why_no_camera = str(error)

    def tilt_log(self) -> TiltLog | None:
        in_time = sorted(self._tilts, key=lambda tilt: tilt.utc_unix_s)
        return TiltLog.of_readings(in_time) if in_time else None

    def remarks(self, path: Path) -> tuple[str, ...]:
        said = []
        if self._unusable:
            said.append(f"{self._unusable} tilts of the bag were left out: flagged, out of range or broken")
        if self._why_no_camera and not self.cameras:
            said.append(f"{path.name}: {self._why_no_camera}")
        return tuple(said)
