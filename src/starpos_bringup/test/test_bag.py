# SPDX-License-Identifier: Apache-2.0
"""What a replay refuses of a bag, in a sentence that names it."""

import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_typestore

from starpos.errors import BagError
from starpos.recording import bounds
from starpos_bringup.recording.bag import Bag
from starpos_bringup.recording.bag_writer import BagWriter

KIND = "std_msgs/msg/UInt8MultiArray"


def test_a_message_that_unpacks_to_too_much_ends_the_replay(tmp_path, monkeypatch):
    writer = Writer(tmp_path / "night", version=9)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/a", KIND, typestore=get_typestore(Stores.ROS2_JAZZY))
        for size in (1 << 20, 1 << 21):
            writer.write(topic, size, bytes(size))
    monkeypatch.setattr(bounds, "MOST_UNPACKED", 1 << 20)
    with Bag(tmp_path / "night") as bag:
        messages = bag.messages(bag.topics(None, left_out=pytest.fail))
        assert next(messages)[2] == bytes(1 << 20)
        with pytest.raises(BagError, match="night: a part of it unpacks to more than"):
            next(messages)


def test_metadata_of_many_megabytes_is_not_read(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as file:
        file.truncate(bounds.MOST_METADATA + 1)
    with pytest.raises(BagError, match="not the description of a bag"), Bag(tmp_path):
        pass


def test_a_recording_that_was_killed_says_how_to_get_it_back(tmp_path):
    writer = BagWriter(tmp_path / "night")
    writer.add_topic("/tilt", "starpos_interfaces/msg/Tilt")
    for k in range(20000):
        writer.write("/tilt", k, bytes(120))  # what is in the file now is there after kill -9 too
    for path in (tmp_path / "night", tmp_path / "night" / "night.mcap"):
        with pytest.raises(BagError, match=r"mcap recover night\.mcap"), Bag(path):
            pass
    writer.close()
    with Bag(tmp_path / "night"):
        pass
