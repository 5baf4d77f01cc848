# SPDX-License-Identifier: Apache-2.0
"""What a replay refuses of a bag, in a sentence that names it."""

import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_typestore

from starpos.errors import BagError
from starpos.recording import bag as bounds
from starpos.recording.topics import DRIVER_INPUTS
from starpos_bringup.bag import Bag, BagWriter
from starpos_bringup.record import parser_of
from starpos_bringup.replay import INPUTS, WAIT_FOR_INPUTS_S, WAIT_S

KIND = "std_msgs/msg/UInt8MultiArray"


def test_a_message_that_unpacks_to_too_much_ends_the_replay(tmp_path, monkeypatch):
    writer = Writer(tmp_path / "night", version=9)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/a", KIND, typestore=get_typestore(Stores.ROS2_JAZZY))
        for size in (1 << 20, 1 << 21):
            writer.write(topic, size, bytes(size))
    monkeypatch.setattr(bounds, "MAX_UNPACKED", 1 << 20)
    with Bag(tmp_path / "night") as bag:
        messages = bag.played(bag.topics(None, left_out=pytest.fail))
        assert next(messages)[2] == bytes(1 << 20)
        with pytest.raises(BagError, match="night: a part of it unpacks to more than"):
            next(messages)


def test_metadata_of_many_megabytes_is_not_read(tmp_path):
    with (tmp_path / "metadata.yaml").open("wb") as file:
        file.truncate(bounds.MAX_METADATA + 1)
    with pytest.raises(BagError, match="not the description of a bag"), Bag(tmp_path):
        pass


def test_a_recording_that_was_killed_says_how_to_get_it_back(tmp_path):
    writer = BagWriter(tmp_path / "night")
    writer.add_topic("/tilt", "starpos_interfaces/msg/Tilt")
    for k in range(20000):
        # What is in the file now is there after kill -9 too.
        writer.write("/tilt", k, bytes(120))
    for path in (tmp_path / "night", tmp_path / "night" / "night.mcap"):
        with pytest.raises(BagError, match=r"mcap recover night\.mcap"), Bag(path):
            pass
    writer.close()
    with Bag(tmp_path / "night"):
        pass


def test_the_row_of_replay_names_the_inputs_that_the_code_has():
    help_ = " ".join(parser_of("replay").format_help().split())
    assert all(name in help_ for name in DRIVER_INPUTS)
    assert (
        f"{{{','.join(INPUTS)}}}" in help_ and f"({WAIT_S:g}; with --inputs {WAIT_FOR_INPUTS_S:g}," in help_
    )
