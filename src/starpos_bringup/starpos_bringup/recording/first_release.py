# SPDX-License-Identifier: Apache-2.0
"""Brings messages that the first release recorded, which lacked some fields, to the types of today."""

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

from starpos.recording.bag import PACKAGE, installed_types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

SHUTTER = {"shutter_known": False, "readout": 0.0, "readout_stddev": 0.0}
# The fields that types got since then, at their end, each with the value that says that it is not known.
APPENDED: dict[str, dict[str, Any]] = {
    f"{PACKAGE}/msg/Tilt": {"z": math.nan, "z_variance": math.nan},
    f"{PACKAGE}/msg/Capture": SHUTTER,
    f"{PACKAGE}/msg/StarArray": SHUTTER,
}
TILT, SOLUTION = f"{PACKAGE}/msg/Tilt", f"{PACKAGE}/msg/Solution"


class FirstRelease:
    """The message types of the first release that have changed: those of APPENDED, and Solution, which holds a Tilt."""

    def knows(self, type_name: str, digest: str) -> bool:
        """Whether a type with this hash is one of them."""
        return type_name in (*APPENDED, SOLUTION) and digest == self._then.hash_rihs01(type_name)

    def upgraded(self, data: bytes, type_name: str) -> bytes:
        """The bytes of such a message as the type of today has them; as they are if they are broken."""
        try:
            message: Any = self._then.deserialize_cdr(data, type_name)
            if type_name == SOLUTION:
                message.tilt = self._completed(message.tilt, TILT)
            else:
                message = self._completed(message, type_name)
            return bytes(self._now.serialize_cdr(message, type_name))
        except Exception:
            # hostile bytes may cause any error of a conversion; who plays them says that they are broken
            return data

    def _completed(self, message: Any, type_name: str) -> Any:
        return self._now.types[type_name](**vars(message), **APPENDED[type_name])

    @cached_property
    def _now(self) -> "Typestore":
        return installed_types()

    @cached_property
    def _then(self) -> "Typestore":
        store = installed_types()
        for type_name, appended in APPENDED.items():
            constants, fields = store.fielddefs.pop(type_name)
            store.register({type_name: (constants, [f for f in fields if f[0] not in appended])})
        return store
