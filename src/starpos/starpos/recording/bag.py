# SPDX-License-Identifier: Apache-2.0
"""Reads a rosbag2 without ROS, by `rosbags`; any fault of it is a BagError of one sentence."""

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.errors import BagError, one_line
from starpos.recording import bounds

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

PACKAGE = "starpos_interfaces"
# the latest time that ROS can hold
LAST_NS = (2**31 - 1) * 10**9


class BagReader:
    """A bag to read, as a context manager: a folder with metadata.yaml, or one .mcap or .db3 file.

    typed: whether messages can be decoded too.  Then each message type of the bag must be well defined; otherwise types
    are names only.  All methods raise BagError with the path of the bag.
    """

    def __init__(self, path: Path, *, typed: bool = False):
        self.path = path
        self._typed = typed
        self._open = ExitStack()

    def __enter__(self) -> "BagReader":
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.rosbag2 import Reader
        except ImportError:
            raise BagError("rosbags, which reads bags, is not installed: pip install rosbags") from None
        if not self.path.exists():
            raise BagError(f"{self.path}: there is no such bag")
        # rosbags, ruamel.yaml, zstd and sqlite have exceptions of their own for a broken file
        try:
            bounds.check_folder(self.path)
            if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
                raise BagError("a folder without metadata.yaml is no bag: name its .mcap or .db3 file")
            bounds.bound_rosbags()
            with ExitStack() as stack:
                self._reader: Reader | AnyReader
                if self._typed:
                    decoder = AnyReader([self.path], default_typestore=installed_types())
                    self._reader, self._types = decoder, stack.enter_context(decoder).typestore
                    readers = decoder.readers
                else:
                    self._reader = stack.enter_context(Reader(self.path))
                    readers = [self._reader]
                for reader in readers:
                    bounds.check_chunks(reader)
                self._open = stack.pop_all()
        except Exception as error:
            raise self._broken(error) from None
        return self

    def __exit__(self, *exception: object) -> None:
        self._open.close()

    @property
    def connections(self) -> "Sequence[Connection]":
        """The bag's topics, one or more connections each, with message type, digest and number of messages."""
        return self._reader.connections

    def messages(self, connections: "Sequence[Connection]") -> "Iterator[tuple[Connection, int, bytes]]":
        """(connection, log time in ns, bytes) of each message of these connections, in the bag's order."""
        messages = self._reader.messages(connections) if connections else iter(())
        while True:
            try:
                connection, log_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:
                raise self._broken(error) from None
            if not 0 <= log_ns <= LAST_NS:
                raise BagError(
                    f"{self.path}: a message of {connection.topic} was logged at {log_ns} ns, no time until 2038"
                )
            yield connection, log_ns, bytes(data)

    def decoded(self, connections: "Sequence[Connection]") -> "Iterator[tuple[Connection, int, Any]]":
        """(connection, log time in ns, message) of each message of these connections, in the bag's order."""
        for c in connections:
            if c.msgtype not in self._types.fielddefs:
                raise BagError(
                    f"{self.path}: it does not hold the definition of {c.msgtype}: enter the workspace that has "
                    f"{PACKAGE}, or record as MCAP, which holds them"
                )
        for connection, log_ns, data in self.messages(connections):
            try:
                message = self._types.deserialize_cdr(data, connection.msgtype)
            except Exception as error:
                raise self._broken(error) from None
            yield connection, log_ns, message

    def _broken(self, error: Exception) -> BagError:
        if isinstance(error, BagError):
            return BagError(f"{self.path}: {error}")
        return BagError(f"{self.path}: not a readable bag ({type(error).__name__}: {one_line(error)})")


def installed_types() -> "Typestore":
    """Message types for a bag without definitions: ROS's own, and ours if a workspace was entered."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        texts = sorted((Path(prefix) / "share" / PACKAGE / "msg").glob("*.msg")) if prefix else []
        if texts:
            for text in texts:
                store.register(get_types_from_msg(text.read_text(), f"{PACKAGE}/msg/{text.stem}"))
            break
    return store
