# SPDX-License-Identifier: Apache-2.0
"""Bags that unpack to more than they may are refused in a sentence; the frames of an honest night are not."""

import os
import struct

import pytest

pytest.importorskip("rosbags")

from lz4.frame import compress as lz4
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer, reader
from rosbags.typesys import Stores, get_typestore

from starpos.errors import BagError
from starpos.recording import bag
from starpos.recording.bag import BagReader

bag.bound_rosbags()
# The module that rosbags found.
zstd = reader.zstd._zstd
PACKERS = {"zstd": zstd.compress, "lz4": lz4, "": bytes}
MAGIC = b"\x89MCAP0\r\n"
TOPIC, KIND = "/stars", "std_msgs/msg/UInt8MultiArray"


@pytest.fixture
def small(monkeypatch):
    """Bounds of a megabyte, so that a test need not have gigabytes."""
    monkeypatch.setattr(bag, "MAX_UNPACKED", 1 << 20)
    monkeypatch.setattr(bag, "MAX_AT_ONCE", 1 << 21)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def part(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


def mcap(path, payloads, compression, stated=None, indexed=False):
    """An MCAP file of chunks with one message each, all of the same time; stated: the size that they claim to have."""
    about = part(3, struct.pack("<H", 1) + text(KIND) + text("ros2msg") + text("byte[] data"))
    about += part(4, struct.pack("<HH", 1, 1) + text(TOPIC) + text("cdr") + text(""))
    data, index = MAGIC + part(1, text("ros2") + text("")) + about, b""
    for payload in payloads:
        raw = part(5, struct.pack("<HIQQ", 1, 0, 5, 5) + payload)
        packed, size = PACKERS[compression](raw), len(raw) if stated is None else stated
        head = struct.pack("<QQQI", 5, 5, size, 0) + text(compression) + struct.pack("<Q", len(packed))
        chunk = part(6, head + packed)
        # Where channel 1 is in it.
        places = struct.pack("<IHQ", 10, 1, 0)
        index += part(8, struct.pack("<QQQQ", 5, 5, len(data), len(chunk)) + places + struct.pack("<Q", 0)
                      + text(compression) + struct.pack("<QQ", len(packed), size))  # fmt: skip
        data += chunk
    summary = len(data) if indexed else 0
    data += part(15, bytes(4)) + (about + index if indexed else b"")
    path.write_bytes(data + part(2, struct.pack("<QQI", summary + 13 * indexed, 0, 0)) + MAGIC)
    return path


def read(path) -> list[bytes]:
    """Read as replay does."""
    with Reader(path) as opened:
        bag.check_chunks(opened)
        return [bytes(data) for _, _, data in opened.messages()]


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("compression", PACKERS)
def test_honest_chunks_come_back_bit_for_bit(tmp_path, small, compression, indexed):
    payloads = [bytes([k]) * 100_000 for k in range(3)]
    assert read(mcap(tmp_path / "a.mcap", payloads, compression, indexed=indexed)) == payloads


@pytest.mark.parametrize("stated", [None, 100, 2**40])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_unpacks_to_too_much_is_refused_whatever_size_it_states(
    tmp_path, small, compression, stated
):
    path = mcap(tmp_path / "a.mcap", [bytes(1 << 23)], compression, stated)
    with pytest.raises(BagError, match="a part of it unpacks to"):
        read(path)
    for typed in (False, True):
        with (
            pytest.raises(BagError, match=r"a.mcap: a part of it unpacks to"),
            BagReader(path, typed=typed) as bag,
        ):
            list(bag.messages(bag.connections))


def test_chunks_of_one_time_are_refused_where_they_are_too_much_together(tmp_path, small):
    honest = mcap(tmp_path / "two.mcap", [bytes(1 << 19)] * 2, "zstd", indexed=True)
    assert len(read(honest)) == 2
    with pytest.raises(BagError, match="have the same times"):
        read(mcap(tmp_path / "ten.mcap", [bytes(1 << 19)] * 10, "zstd", indexed=True))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_breaks_off_is_no_endless_wait(tmp_path, monkeypatch, compression):
    whole = PACKERS[compression]
    monkeypatch.setitem(PACKERS, compression, lambda raw: whole(raw)[:-9])
    with pytest.raises((EOFError, RuntimeError)):
        read(mcap(tmp_path / "a.mcap", [bytes(range(256)) * 1000], compression))


def packed_as(mode, path, payload):
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        writer.write(writer.add_connection(TOPIC, KIND, typestore=store), 5, payload)
    return path


def test_a_compressed_message_is_bounded(tmp_path, small):
    fits = packed_as(CompressionMode.MESSAGE, tmp_path / "fits", bytes(1 << 20))
    assert read(fits) == [bytes(1 << 20)]
    with pytest.raises(BagError, match="a part of it unpacks to"):
        read(packed_as(CompressionMode.MESSAGE, tmp_path / "large", bytes(1 << 21)))


def test_a_compressed_file_is_unpacked_only_where_there_is_room(tmp_path, monkeypatch):
    path = packed_as(CompressionMode.FILE, tmp_path / "a", bytes(1 << 21))
    assert read(path) == [bytes(1 << 21)]
    # As on a disk that is nearly full.
    monkeypatch.setattr(bag, "LEFT_ON_DISK", 1 << 60)
    with pytest.raises(BagError, match="more than there is room for"):
        read(path)


@pytest.mark.parametrize("name", ["metadata.yaml", "a.mcap", "a.db3"])
def test_a_pipe_in_a_bag_is_not_waited_for(tmp_path, name):
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(BagError, match="no regular file"), BagReader(path):
            pass


@pytest.mark.parametrize("storage", ['""', "''", "", "parquet"])
def test_a_storage_that_is_not_named_or_not_known_is_said(tmp_path, storage):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        bag.add_connection("/told", "std_msgs/msg/String", typestore=store)
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(
        metadata.read_text().replace("storage_identifier: mcap", f"storage_identifier: {storage}")
    )
    with pytest.raises(BagError, match=r"storage_identifier.*mcap or sqlite3"), BagReader(tmp_path / "bag"):
        pass
