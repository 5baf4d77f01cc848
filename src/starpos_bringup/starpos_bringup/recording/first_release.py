# SPDX-License-Identifier: Apache-2.0
"""Brings messages that the first release recorded, whose Tilt had no third axis, to the types of today."""

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

from starpos.recording.bag import PACKAGE, installed_types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TILT, SOLUTION = f"{PACKAGE}/msg/Tilt", f"{PACKAGE}/msg/Solution"
# its fields; constants are no part of what is recorded
FIRST_TILT = """
std_msgs/Header header
float64 x
float64 y
float64[4] covariance
float64 temperature
uint32 sequence
uint8 flags
"""


class FirstRelease:
    """The message types of the first release that have changed: Tilt, and Solution, which holds one."""

    def knows(self, type_name: str, digest: str) -> bool:
        """Whether a type with this hash is one of them."""
        return type_name in (TILT, SOLUTION) and digest == self._then.hash_rihs01(type_name)

    def upgraded(self, data: bytes, type_name: str) -> bytes:
        """The bytes of such a message as the type of today has them; as they are if they are broken."""
        try:
            message: Any = self._then.deserialize_cdr(data, type_name)
            if type_name == TILT:
                message = self._tilt(message)
            else:
                message.tilt = self._tilt(message.tilt)
            return bytes(self._now.serialize_cdr(message, type_name))
        except Exception:
            # hostile bytes may cause any error of a conversion; who plays them says that they are broken
            return data

    def _tilt(self, tilt: Any) -> Any:
        """The tilt of two axes that it was."""
        return self._now.types[TILT](**vars(tilt), z=math.nan, z_variance=math.nan)

    @cached_property
    def _now(self) -> "Typestore":
        return installed_types()

    @cached_property
    def _then(self) -> "Typestore":
        from rosbags.typesys import get_types_from_msg

        store = installed_types()
        del store.fielddefs[TILT]
        store.register(get_types_from_msg(FIRST_TILT, TILT))
        return store
