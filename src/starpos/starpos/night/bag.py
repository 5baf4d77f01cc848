# SPDX-License-Identifier: Apache-2.0
"""A night in a rosbag2: the stars and tilts of one instrument, or of a robot's own camera and IMU, to be solved."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, InstrumentError, StarposError, TiltError
from starpos.frames.frame import Frame, Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog, Tilts, TiltsByTime
from starpos.messages.camera import message_to_camera
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars
from starpos.messages.tilt import UNUSABLE, message_to_tilt
from starpos.night.opening import truth_in
from starpos.night.reading import Instruments, Worked
from starpos.night.solving import Exposures
from starpos.night.work import Solving
from starpos.progress import Progress
from starpos.recording.bag import BagReader
from starpos.recording.drivers import DriverMessages, Drivers
from starpos.recording.topics import CAMERA_INFO, CAPTURE, FRAMES, IMU, INPUTS, STARS, TILT, instrument_in
from starpos.units import utc_text

SUFFIXES = (".mcap", ".db3")
# of ROS 1, which is refused with a sentence
ROS1_SUFFIX = ".bag"


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a folder with metadata.yaml or a bag's files, or a file with a bag's suffix."""
    if path.is_file():
        return path.suffix.lower() in (*SUFFIXES, ROS1_SUFFIX)
    return (path / "metadata.yaml").is_file() or any(next(path.glob(f"*{s}"), None) for s in SUFFIXES)


def exposures(
    path: Path,
    namespace: str | None,
    drivers: Drivers,
    given: Instruments,
    atmosphere: Atmosphere,
    vertical: Vertical,
    progress: Progress,
    own_cameras: bool = True,
) -> Exposures:
    """The stars of one instrument, or of a robot's own drivers, to be solved; everything else is read here.

    namespace: the instrument's; None where there is only one.  drivers: how a robot's own messages are used.
    given: by its inclinometer, sigma of the readings that state none.  own_cameras: the bag's have their lenses.
    Raises BagError if the bag cannot be read, FrameError if the instrument is not in it.
    """
    assert given.instrument is not None
    messages, cameras, why_no_camera = DriverMessages(drivers), dict[tuple[int, int], Camera](), ""
    tilts: list[Tilt] = []
    unusable = 0
    with BagReader(path, typed=True) as bag:
        chosen = instrument_in(bag, namespace, INPUTS, drivers.remaps)
        wanted = [c for c in chosen.connections if c.msgtype not in FRAMES]
        total = sum(c.msgcount for c in wanted) or 1
        for done, (connection, log_ns, message) in enumerate(bag.decoded(wanted), 1):
            if done % 500 == 0 or done == total:
                progress(path.name[:20], done / total)
            if connection.msgtype == CAMERA_INFO:
                try:
                    camera = message_to_camera(message, "its camera_info")
                    cameras.setdefault((camera.width, camera.height), camera)
                except InstrumentError as error:
                    why_no_camera = str(error)
                continue
            if connection.msgtype == IMU:
                message = messages.tilt_of(message, log_ns * 1e-9)
            if connection.msgtype not in (IMU, TILT) or message is None:
                continue
            # an impossible tilt only leads to a remark
            with suppress(TiltError):
                tilt = message_to_tilt(message, given.instrument.inclinometer.noise_rad)
                if not message.flags & UNUSABLE:
                    tilts.append(tilt)
                    continue
            unusable += 1
    remarks = (
        f"{path.name}: {chosen.made}" if chosen.made else "",
        *messages.remarks(),
        f"{unusable} tilts of the bag were left out: flagged, out of range or broken" if unusable else "",
        f"{path.name}: {why_no_camera}" if why_no_camera and not cameras else "",
    )
    level: Tilts = TiltsByTime(why=f"{path}: no usable tilt in it: record the topic tilt too")
    if tilts:
        level = TiltLog.of_readings(sorted(tilts, key=lambda tilt: tilt.utc_unix_s))

    def each(work: Callable[[Frame | Stars], Any]) -> Worked:
        for name, item in _frames(path, chosen.namespace, drivers):
            yield name, item if isinstance(item, FrameError) else work(item)

    return Exposures(
        name=path.name + (f" {chosen.namespace}" if chosen.namespace != "/" else ""),
        origin=f"solved from stars and tilt of the bag {path.name}, namespace {chosen.namespace}",
        count=sum(c.msgcount for c in chosen.connections if c.msgtype in FRAMES),
        each=each,
        work=Solving(
            replace(given, cameras=cameras if own_cameras else {}), atmosphere=atmosphere, tilts=level
        ),
        vertical=vertical,
        truth=truth_in(path) if path.is_dir() else None,
        remarks=tuple(filter(None, remarks)),
    )


def _frames(path: Path, namespace: str, drivers: Drivers) -> Iterator[tuple[str, Stars | FrameError]]:
    """A name for each frame, one at a time, and its stars, or why it has none."""
    messages = DriverMessages(drivers)
    with BagReader(path, typed=True) as bag:
        chosen = instrument_in(bag, namespace, INPUTS, drivers.remaps)
        wanted = [c for c in chosen.connections if c.msgtype in (*FRAMES, CAPTURE)]
        for connection, _, message in bag.decoded(wanted):
            if connection.msgtype == CAPTURE:
                messages.receive_capture(message)
            else:
                yield _named_stars(connection.msgtype, message, messages)


def _named_stars(kind: str, message: Any, messages: DriverMessages) -> tuple[str, Stars | FrameError]:
    """A name for a list of stars or an image, and its stars, or the error."""
    stamp_s = stamp_to_unix(message.header.stamp)
    time = "of unknown time" if stamp_s is None else utc_text(stamp_s)
    name = f"{'stars' if kind == STARS else 'image'} {time}"
    try:
        if kind == STARS:
            return name, message_to_stars(message, name)
        return name, replace(messages.stars_of(kind, message)[0], source=name)
    except StarposError as error:
        # the error of a list names it
        return name, FrameError(f"{error}" if kind == STARS else f"{name}: {error}")
