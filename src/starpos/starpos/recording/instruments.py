# SPDX-License-Identifier: Apache-2.0
"""The topics of one instrument among those of a bag."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.errors import FrameError
from starpos.recording.bag import PACKAGE, BagReader

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

STARS, TILT, SOLUTION = (f"{PACKAGE}/msg/{name}" for name in ("StarArray", "Tilt", "Solution"))
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# types by the relative names of what a solver takes
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
INPUTS = {"stars": STARS, "tilt": TILT, "camera/camera_info": CAMERA_INFO}
# what it takes besides, with gnss.use
GNSS = {"gnss/fix": NAV_SAT_FIX}


def instrument_in(
    bag: BagReader, path: Path, namespace: str | None, topics: Mapping[str, str], needed: Collection[str]
) -> "tuple[str, Sequence[Connection]]":
    """Find namespace and connections of an instrument; FrameError if there is none, or several and none is named.

    topics: types by relative names.  needed: types of which one has to be there, with a message.
    """
    found: dict[str, list[Connection]] = {}
    for c in bag.connections:
        for suffix, kind in topics.items():
            if c.msgtype == kind and c.topic.endswith(f"/{suffix}"):
                found.setdefault(c.topic.removesuffix(suffix).rstrip("/") or "/", []).append(c)
    able = sorted(n for n, cs in found.items() if any(c.msgtype in needed and c.msgcount for c in cs))
    if not able:
        names = " nor ".join(name for name, kind in topics.items() if kind in needed)
        raise FrameError(
            f"{path}: {'neither ' if len(needed) > 1 else 'no '}{names} in it: record stars, tilt and camera/camera_info"
        )
    wanted = "/" + namespace.strip("/") if namespace is not None else able[0]
    if able == ["/"] and wanted != "/":
        raise FrameError(
            f"{path}: the instrument in it has no namespace, not {wanted}: leave --namespace out"
        )
    if wanted not in able or (namespace is None and len(able) > 1):
        raise FrameError(f"{path}: the instruments in it are {', '.join(able)}: choose one with --namespace")
    return wanted, found[wanted]
