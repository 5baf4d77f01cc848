# SPDX-License-Identifier: Apache-2.0
"""Brings messages that an earlier version recorded, which lacked some fields, to the types of today."""

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

from starpos.recording.bag import PACKAGE, installed_types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Appended = dict[str, dict[str, Any]]

SHUTTER = {"shutter_known": False, "readout": 0.0, "readout_stddev": 0.0}
# Fields added at the end of types, each with its value for unknown: newest first, last the fields that the first release
# lacked.
VERSIONS: tuple[Appended, ...] = (
    {f"{PACKAGE}/msg/Solution": {"warnings": []}},
    {
        f"{PACKAGE}/msg/Tilt": {"z": math.nan, "z_variance": math.nan},
        f"{PACKAGE}/msg/Capture": SHUTTER,
        f"{PACKAGE}/msg/StarArray": SHUTTER,
    },
)
APPENDED: Appended = {name: fields for version in VERSIONS for name, fields in version.items()}


class OlderTypes:
    """The types of APPENDED as earlier versions had them."""

    def knows(self, type_name: str, digest: str) -> bool:
        """Whether a type with this hash is one of them."""
        return self._store_of(type_name, digest) is not None

    def upgraded(self, data: bytes, type_name: str, digest: str) -> bytes:
        """The bytes of such a message as the type of today has them; as they are if they are broken."""
        store = self._store_of(type_name, digest)
        if store is None:
            return data
        try:
            message = self._completed(store.deserialize_cdr(data, type_name), type_name)
            return bytes(self._now.serialize_cdr(message, type_name))
        except Exception:
            # hostile bytes may cause any error of a conversion; the player reports that they are broken
            return data

    def _completed(self, message: Any, type_name: str) -> Any:
        given = vars(message)
        for name, (_, about) in self._now.fielddefs[type_name][1]:
            if about in APPENDED:
                given[name] = self._completed(given[name], about)
        return self._now.types[type_name](**APPENDED[type_name] | given)

    def _store_of(self, type_name: str, digest: str) -> "Typestore | None":
        if type_name not in APPENDED:
            return None
        return next((s for s in self._then if s.hash_rihs01(type_name) == digest), None)

    @cached_property
    def _now(self) -> "Typestore":
        return installed_types()

    @cached_property
    def _then(self) -> "list[Typestore]":
        """The types before each of VERSIONS."""
        stores = []
        for k in range(len(VERSIONS)):
            store = installed_types()
            for version in VERSIONS[: k + 1]:
                for type_name, appended in version.items():
                    constants, fields = store.fielddefs.pop(type_name)
                    store.register({type_name: (constants, [f for f in fields if f[0] not in appended])})
            stores.append(store)
        return stores
