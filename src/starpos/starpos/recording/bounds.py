# SPDX-License-Identifier: Apache-2.0
"""Bounds for rosbag2 files that `rosbags` reads: a small file must not unpack to more than there is memory or disk.

rosbags (0.11) unpacks whatever a chunk, a message or a file holds, with no limit of its own, so its ways to do that are
replaced by bounded ones.
"""

import shutil
import tempfile
from pathlib import Path

from starpos.errors import StarposError

MOST_METADATA = 1 << 24
MOST_UNPACKED = 1 << 29  # of a chunk or a message; a frame of 21 megapixels is a twelfth of it
MOST_AT_ONCE = 1 << 30  # of the chunks of a file that overlap in time: all are in memory then
MCAP = b"\x89MCAP0\r\n"  # its first bytes, and its last
LEFT_ON_DISK = 1 << 30  # by a bag that is packed as a file, and unpacked beside the others of /tmp


class BagError(StarposError):
    """What is read from a bag goes beyond a bound, or was never ended; what, not where."""


def check_folder(path: Path) -> None:
    """Before a bag is opened. BagError where its metadata.yaml is none, or an MCAP has a beginning and no end."""
    for file in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        if file.suffix == ".mcap" and _is_cut_off(file):
            raise BagError(
                f"{file.name} was cut off, by a kill or a power failure, or is being recorded still: `mcap recover "
                f"{file.name} -o whole.mcap` (https://mcap.dev) gets back what is in it, to the last second or minute"
            )
    metadata = path / "metadata.yaml"
    if metadata.is_file() and metadata.stat().st_size > MOST_METADATA:
        raise BagError(f"its metadata.yaml has over {MOST_METADATA >> 20} MB, not the description of a bag")


def _is_cut_off(file: Path) -> bool:
    with file.open("rb") as content:
        if content.read(len(MCAP)) != MCAP:
            return False
        content.seek(-len(MCAP), 2)
        return content.tell() == 0 or content.read() != MCAP


def bound_rosbags() -> None:
    """Before a bag is opened; from then on rosbags raises BagError for what unpacks to too much, for all of the process.

    BagError where this version of rosbags unpacks in another way.
    """
    from rosbags.rosbag2 import reader, storage_mcap

    try:
        table, zstd = storage_mcap.DECOMPRESSORS, reader.zstd
        if isinstance(zstd, _Zstd):
            return
        table["lz4"], table["zstd"] = _lz4, lambda data, size: _unpacked(zstd, data, size)
        reader.zstd = _Zstd(zstd)
    except AttributeError:
        raise BagError(
            "this version of rosbags unpacks as none we know, without bounds: pip install rosbags==0.11.9"
        ) from None


def check_chunks(reader) -> None:
    """Of an open rosbags.rosbag2.Reader. BagError where so many chunks overlap that they are too much together."""
    storages = getattr(reader.storage, "storages", [reader.storage])
    for storage in storages:
        edges = []
        for chunk in getattr(storage, "chunks", ()):  # of MCAP with an index; others are read one by one
            first, size = chunk.message_start_time, chunk.uncompressed_size
            edges += [(first, 0, size), (max(first, chunk.message_end_time), 1, -size)]
        at_once = 0
        for _, _, size in sorted(edges):
            at_once += size
            if at_once > MOST_AT_ONCE:
                raise BagError(
                    f"chunks of over {MOST_AT_ONCE >> 20} MB have the same times: write it anew, in the order of time"
                )


class _Zstd:
    """What rosbags' reader calls of its zstd module, bounded."""

    def __init__(self, zstd):
        self._zstd = zstd

    def decompress(self, data: bytes) -> bytes:
        """A message."""
        return _unpacked(self._zstd, data, MOST_UNPACKED)

    def open(self, file, mode: str):
        """A file of a bag, which rosbags unpacks into the folder for temporary files."""
        room = shutil.disk_usage(tempfile.gettempdir()).free - LEFT_ON_DISK
        return _Bounded(self._zstd.open(file, mode), room)


class _Bounded:
    """A file that is read, up to so many bytes."""

    def __init__(self, file, most: int):
        self._file, self._left, self._most = file, most, most

    def __enter__(self):
        return self

    def __exit__(self, *exception):
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


def _unpacked(zstd, data: bytes, size: int) -> bytes:
    """The frames of zstd in data, at most `size` bytes; BagError where there are more."""
    _check_size(size)
    parts, left = [], size
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
    """As rosbags calls it, with the size that the chunk states."""
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
    if size > MOST_UNPACKED:
        raise BagError(f"a part of it unpacks to {size >> 20} MB, over {MOST_UNPACKED >> 20} MB")


def _too_large(size: int) -> BagError:
    return BagError(f"a part of it unpacks to more than the {size} bytes it may have")
