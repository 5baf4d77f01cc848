# SPDX-License-Identifier: Apache-2.0
"""Reads a rosbag2 without ROS, by `rosbags`, within bounds; any fault of it is a BagError of one sentence.

A small file must not unpack to more than memory or disk can hold. rosbags (0.11) unpacks whatever a chunk, a message or a
file holds, without a limit: its unpacking functions are replaced by bounded ones.
"""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import IO, TYPE_CHECKING, Any, TypeVar

from starpos.errors import BagError, one_line
from starpos.files import open_regular

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

# a bag of a thousand files has 250 kB; a parser of YAML reads about 100 kB in a second
MAX_METADATA = 1 << 20
# bytes of a chunk or a message; a frame of 21 megapixels has a twelfth of it
MAX_UNPACKED = 1 << 29
# bytes of the chunks of a file that overlap in time: rosbags has all of them in memory
MAX_AT_ONCE = 1 << 30
# the first and the last bytes of a file
MCAP = b"\x89MCAP0\r\n"
# rosbag2's names of the supported storages, .mcap and .db3
STORAGES = ("mcap", "sqlite3")
# the first bytes of a bag of ROS 1
ROS1 = b"#ROSBAG"
# bytes that stay free in the folder for temporary files, when a packed file is unpacked there
LEFT_ON_DISK = 1 << 30


def check_folder(path: Path) -> None:
    """Check the files of a bag before it is opened.

    Raises BagError if one is a pipe or a device, if metadata.yaml is too large or names a storage that is not read, or if
    an MCAP file begins as one and has no end.
    """
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.exists() and not (file.is_file() or file.is_dir()):
            raise BagError(
                f"{file.name} is no regular file but a pipe, a socket or a device: give a bag's files"
            )
    if path.is_file() and _begins_with(path, ROS1):
        whole = path.with_suffix("")
        raise BagError(
            f"this is a bag of ROS 1: run `rosbags-convert --src {path.name} --dst {whole.name}` (pip install rosbags), "
            f"and give {whole.name}"
        )
    for file in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        if file.suffix == ".mcap" and _is_cut_off(file):
            raise BagError(
                f"{file.name} was cut off, by a kill or a power failure, or is being recorded still: `mcap recover "
                f"{file.name} -o whole.mcap` (https://mcap.dev) gets back what is in it, to the last second or minute"
            )
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        return
    if metadata.stat().st_size > MAX_METADATA:
        raise BagError(f"its metadata.yaml has over {MAX_METADATA >> 20} MB, not the description of a bag")
    named = re.search(rb"^\s*storage_identifier:[ \t]*(.*?)\s*$", metadata.read_bytes(), re.MULTILINE)
    storage = named[1].decode("ascii", "replace").strip("'\"") if named else STORAGES[0]
    if storage not in STORAGES:
        raise BagError(
            f"the storage_identifier in its metadata.yaml is {storage[:40]!r}: write there {' or '.join(STORAGES)}, as "
            "its files are, or name the file itself"
        )


def _begins_with(file: Path, head: bytes) -> bool:
    with open_regular(file) as content:
        return content.read(len(head)) == head


def _is_cut_off(file: Path) -> bool:
    with open_regular(file) as content:
        if content.read(len(MCAP)) != MCAP:
            return False
        content.seek(-len(MCAP), 2)
        return content.tell() == 0 or content.read() != MCAP


def bound_rosbags() -> None:
    """Make rosbags raise BagError for data that unpack to too much, in this process. Call it before a bag is opened.

    Raises BagError if this version of rosbags unpacks in another way.
    """
    from rosbags.rosbag2 import reader, storage_mcap

    try:
        table, zstd = storage_mcap.DECOMPRESSORS, reader.zstd
        if isinstance(zstd, _Zstd):
            return
        table["lz4"], table["zstd"] = _lz4, lambda data, size: _unpacked(zstd, data, size)
        reader.zstd = _Zstd(zstd)  # type: ignore[assignment]  # takes the place of a module
    except AttributeError:
        raise BagError(
            "this version of rosbags unpacks in an unknown way, without bounds: pip install rosbags==0.11.9"
        ) from None


def check_chunks(reader: Any) -> None:
    """Check the chunks of an open rosbags.rosbag2.Reader; raises BagError if too large ones overlap in time."""
    storages = getattr(reader.storage, "storages", [reader.storage])
    for storage in storages:
        edges: list[tuple[int, int, int]] = []
        # only an MCAP with an index has a list of chunks; rosbags reads all others one by one
        for chunk in getattr(storage, "chunks", ()):
            first, size = chunk.message_start_time, chunk.uncompressed_size
            edges += [(first, 0, size), (max(first, chunk.message_end_time), 1, -size)]
        at_once = 0
        for _, _, size in sorted(edges):
            at_once += size
            if at_once > MAX_AT_ONCE:
                raise BagError(
                    f"chunks of over {MAX_AT_ONCE >> 20} MB have the same times: write it anew, in the order of time"
                )


class _Zstd:
    """The functions that rosbags' reader calls of its zstd module, bounded."""

    def __init__(self, zstd: ModuleType):
        self._zstd = zstd

    def decompress(self, data: bytes) -> bytes:
        """Unpack a message."""
        return _unpacked(self._zstd, data, MAX_UNPACKED)

    def open(self, file: IO[bytes], mode: str) -> "_Bounded":
        """Open a file of a bag, which rosbags unpacks into the folder for temporary files."""
        room = shutil.disk_usage(tempfile.gettempdir()).free - LEFT_ON_DISK
        return _Bounded(self._zstd.open(file, mode), room)


class _Bounded:
    """A file that gives a limited number of bytes."""

    def __init__(self, file: Any, most: int):
        self._file, self._left, self._most = file, most, most

    def __enter__(self) -> "_Bounded":
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise BagError(
                f"unpacked it has over {max(self._most, 0) >> 20} MB, more than there is room for in "
                f"{tempfile.gettempdir()}: make room, or unpack it yourself (zstd -d)"
            )
        return data


def _unpacked(zstd: ModuleType, data: bytes, size: int) -> bytes:
    """Unpack the zstd frames in data, at most `size` bytes; raises BagError if there are more."""
    _check_size(size)
    parts: list[bytes] = []
    left = size
    while data:
        frame = zstd.ZstdDecompressor()
        parts.append(frame.decompress(data, left + 1))
        left -= len(parts[-1])
        if left < 0:
            raise _too_large(size)
        if not frame.eof:
            raise EOFError("a compressed part breaks off")
        data = frame.unused_data
    return b"".join(parts)


def _lz4(data: bytes, size: int) -> bytes:
    """Unpack an lz4 frame of the size that its chunk states; raises BagError if there is more."""
    from lz4.frame import LZ4FrameDecompressor

    _check_size(size)
    frame = LZ4FrameDecompressor()
    unpacked = frame.decompress(data, size + 1)
    if len(unpacked) > size:
        raise _too_large(size)
    if not frame.eof:
        raise EOFError("a compressed part breaks off")
    return unpacked


def _check_size(size: int) -> None:
    if size > MAX_UNPACKED:
        raise BagError(f"a part of it unpacks to {size >> 20} MB, over {MAX_UNPACKED >> 20} MB")


def _too_large(size: int) -> BagError:
    return BagError(f"a part of it unpacks to more than the {size} bytes it may have")


PACKAGE = "starpos_interfaces"
# the latest time that ROS can hold
LAST_NS = (2**31 - 1) * 10**9
B = TypeVar("B", bound="BagReader")


class BagReader:
    """A bag to read, as a context manager: a folder with metadata.yaml, or one .mcap or .db3 file.

    typed: whether messages can be decoded too.  Then each message type of the bag must be well defined; otherwise types
    are names only.  All methods raise BagError with the path of the bag.
    """

    def __init__(self, path: Path, *, typed: bool = False):
        self.path = path
        self._typed = typed
        self._open = ExitStack()

    def __enter__(self: B) -> B:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.rosbag2 import Reader
        except ImportError:
            raise BagError("rosbags, which reads bags, is not installed: pip install rosbags") from None
        if not self.path.exists():
            raise BagError(f"{self.path}: there is no such bag")
        # rosbags, ruamel.yaml, zstd and sqlite have exceptions of their own for a broken file
        try:
            check_folder(self.path)
            if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
                raise BagError("a folder without metadata.yaml is no bag: name its .mcap or .db3 file")
            bound_rosbags()
            with ExitStack() as stack:
                self._reader: Reader | AnyReader
                if self._typed:
                    installed = installed_types()
                    decoder = AnyReader([self.path], default_typestore=installed)
                    self._reader, self._types = decoder, stack.enter_context(decoder).typestore
                    _spell(self._types, installed)
                    readers = decoder.readers
                else:
                    self._reader = stack.enter_context(Reader(self.path))
                    readers = [self._reader]
                for reader in readers:
                    check_chunks(reader)
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


def _spell(types: "Typestore", installed: "Typestore") -> None:
    """Give fields the names that ROS 2 has: a bag that was converted from ROS 1 calls them D, K, R, P."""

    def fields(store: "Typestore", name: str) -> list[tuple]:
        return [(field.lower(), kind) for field, kind in store.fielddefs[name][1]]

    for name in types.fielddefs.keys() & installed.fielddefs.keys():
        if fields(types, name) == fields(installed, name):
            types.fielddefs[name], types.types[name] = installed.fielddefs[name], installed.types[name]


def installed_types() -> "Typestore":
    """Message types for a bag without definitions: ROS's own, and ours if a workspace was entered."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        texts = sorted((Path(prefix) / "share" / PACKAGE / "msg").glob("*.msg")) if prefix else []
        if texts:
            for text in texts:
                store.register(get_types_from_msg(text.read_text("utf-8"), f"{PACKAGE}/msg/{text.stem}"))
            break
    return store
