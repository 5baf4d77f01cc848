# SPDX-License-Identifier: Apache-2.0
"""The topics of one instrument in a bag."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.errors import FrameError
from starpos.recording.bag import PACKAGE, BagReader
from starpos.recording.drivers import (
    CAMERA_INFO,
    IMU_DATA,
    NO_REMAPS,
    RAW,
    TILT,
    Remaps,
    driver_topics,
    named_topics,
    told,
)

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

STARS, SOLUTION = (f"{PACKAGE}/msg/{name}" for name in ("StarArray", "Solution"))
# types by the relative names of the solver's inputs
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
INPUTS = {"stars": STARS, "tilt": TILT, "camera/camera_info": CAMERA_INFO}
# further inputs, with gnss.use
GNSS = {"gnss/fix": NAV_SAT_FIX}


@dataclass(frozen=True)
class Chosen:
    """An instrument's namespace and connections; made: how a robot's own messages are used, '' if they are not."""

    namespace: str
    connections: "Sequence[Connection]"
    made: str = ""


def instrument_in(
    bag: BagReader,
    path: Path,
    namespace: str | None,
    topics: Mapping[str, str],
    needed: Collection[str],
    remaps: Remaps = NO_REMAPS,
) -> Chosen:
    """Find namespace and connections of an instrument, or of a robot's own drivers without an instrument.

    topics: types by relative names. needed: types of which at least one must have a message.
    remaps: images that the user names take precedence over star lists, named accelerations over tilts. FrameError if
    there is no instrument, or if there are several and `namespace` is None.
    """
    found: dict[str, list[Connection]] = {}
    for c in bag.connections:
        for suffix, kind in topics.items():
            if c.msgtype == kind and c.topic.endswith(f"/{suffix}"):
                found.setdefault(c.topic.removesuffix(suffix).rstrip("/") or "/", []).append(c)
    able = sorted(n for n, cs in found.items() if any(c.msgtype in needed and c.msgcount for c in cs))
    if not able or RAW in remaps.topics:
        drivers = driver_topics(bag.connections, remaps, namespace, path)
        if drivers:
            return _of_drivers(bag, drivers, namespace)
        names = " nor ".join(name for name, kind in topics.items() if kind in needed)
        raise FrameError(
            f"{path}: {'neither ' if len(needed) > 1 else 'no '}{names} in it, and no images: record stars, tilt and "
            "camera/camera_info, or the images and the IMU of a robot"
        )
    wanted = "/" + namespace.strip("/") if namespace is not None else able[0]
    if able == ["/"] and wanted != "/":
        raise FrameError(
            f"{path}: the instrument in it has no namespace, not {wanted}: leave --namespace out"
        )
    if wanted not in able or (namespace is None and len(able) > 1):
        raise FrameError(f"{path}: the instruments in it are {', '.join(able)}: choose one with --namespace")
    named = named_topics(bag.connections, remaps, path)
    replaced = {INPUTS.get("tilt" if name == IMU_DATA else name) for name in named}
    own = [c for c in found[wanted] if c.msgtype not in replaced]
    others = [c for c in bag.connections if c.topic in named.values()]
    return Chosen(wanted, [*own, *others], told(named, others))


def _of_drivers(bag: BagReader, drivers: Mapping[str, str], namespace: str | None) -> Chosen:
    used = set(drivers.values())
    connections = [c for c in bag.connections if c.topic in used]
    return Chosen("/" + (namespace or "").strip("/"), connections, told(drivers, connections))
