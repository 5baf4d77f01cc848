# SPDX-License-Identifier: Apache-2.0
"""What a replay refuses of a bag, in a sentence that names it."""

import math

import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from starpos.errors import BagError
from starpos.recording import bag as bounds
from starpos.recording.topics import DRIVER_INPUTS
from starpos_bringup.bag import Bag, BagWriter
from starpos_bringup.record import parser_of
from starpos_bringup.replay import INPUTS, WAIT_FOR_INPUTS_S, WAIT_S
from starpos_testing.skies.bags import NightBag

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


FIRST_TILT = """
uint8 OUT_OF_RANGE=1
uint8 STUCK=2
uint8 SATURATED=4
uint8 GAP=8
std_msgs/Header header
float64 x
float64 y
float64[4] covariance
float64 temperature
uint32 sequence
uint8 flags
"""
FIRST_CAPTURE = """
std_msgs/Header header
float64 exposure
float64 stamp_stddev
float64 clock_stddev
uint8 stamp_source
"""
FIRST_STARS = """
std_msgs/Header header
uint32 width
uint32 height
float64 exposure
float64 stamp_stddev
float64 clock_stddev
starpos_interfaces/Star[] stars
"""
FIRST = {"Tilt": FIRST_TILT, "Capture": FIRST_CAPTURE, "StarArray": FIRST_STARS}


class NoWarningsBag(NightBag):
    """Writes a bag as of before Solution had `warnings`."""

    def __init__(self, path):
        super().__init__(path)
        kind = "starpos_interfaces/msg/Solution"
        constants, fields = self.store.fielddefs.pop(kind)
        self.store.register({kind: (constants, [f for f in fields if f[0] != "warnings"])})


class FirstReleaseBag(NoWarningsBag):
    """Writes a bag as the first release did, whose Tilt had no third axis, and which knew of no shutter."""

    def __init__(self, path):
        super().__init__(path)
        for name, text in FIRST.items():
            del self.store.fielddefs[f"starpos_interfaces/msg/{name}"]
            self.store.register(get_types_from_msg(text, f"starpos_interfaces/msg/{name}"))


@pytest.mark.parametrize("kind", [NoWarningsBag, NightBag])
def test_solutions_that_knew_of_no_warnings_are_played_without_any(tmp_path, kind):
    from rclpy.serialization import deserialize_message

    with kind(tmp_path / "night") as bag:
        tilt = bag.message("Tilt", 1000.5, x=0.1, z=0.75, z_variance=1e-9)
        bag.write("solver/solution", bag.message("Solution", 1001.0, tilt=tilt, ids=["a"], status=7), 1001.0)
    with Bag(tmp_path / "night") as bag:
        topics = bag.topics(None, left_out=pytest.fail)
        [(topic, _, data)] = bag.played(topics)
    solved = deserialize_message(data, topic.kind)
    assert (solved.status, solved.ids, solved.warnings) == (7, ["a"], [])
    assert (solved.tilt.x, solved.tilt.z, solved.tilt.z_variance) == (0.1, 0.75, 1e-9)


@pytest.mark.parametrize("frame_id", ["", "s", "starpos_inclinometer_frame"])
def test_tilts_and_solutions_of_the_first_release_are_played_as_those_of_two_axes(tmp_path, frame_id):
    from rclpy.serialization import deserialize_message

    with FirstReleaseBag(tmp_path / "night") as bag:
        tilt = bag.message(
            "Tilt", 1000.5, x=0.1, y=-0.2, covariance=np.array([1e-9, 0, 0, 2e-9]), sequence=7, flags=8
        )
        tilt.header.frame_id = frame_id
        bag.write("tilt", tilt, 1000.5)
        ids = ["TYC 1", "a"]
        terms = [bag.message("ErrorTerm", name="tilt", east=1.5, common=True)]
        solution = bag.message(
            "Solution", 1001.0, tilt=tilt, tilt_samples=3, ids=ids, budget=terms, fix_seconds=0.25, xi=4.0
        )
        bag.write("solver/solution", solution, 1001.0)
    with Bag(tmp_path / "night") as bag:
        topics = bag.topics(None, left_out=pytest.fail)
        said = {t.name: deserialize_message(data, t.kind) for t, _, data in bag.played(topics)}
    played, solved = said["/tilt"], said["/solver/solution"]
    for got in (played, solved.tilt):
        assert (got.x, got.y, got.sequence, got.flags) == (0.1, -0.2, 7, 8)
        assert got.header.frame_id == frame_id and got.covariance.tolist() == [1e-9, 0, 0, 2e-9]
        assert math.isnan(got.z) and math.isnan(got.z_variance)
    assert (solved.tilt_samples, solved.ids, solved.xi, solved.fix_seconds) == (3, ids, 4.0, 0.25)
    assert solved.warnings == []
    assert [(t.name, t.east, t.common) for t in solved.budget] == [("tilt", 1.5, True)]


def test_stars_of_the_first_release_are_played_as_those_of_an_unknown_shutter(tmp_path):
    from rclpy.serialization import deserialize_message

    with FirstReleaseBag(tmp_path / "night") as bag:
        star = bag.message("Star", x=3.0, y=4.0, covariance=np.array([0.01, 0, 0, 0.01]), flags=2)
        stars = bag.message("StarArray", 1000.5, width=10, height=20, stars=[star], clock_stddev=0.02)
        capture = bag.message("Capture", 1000.5, exposure=0.5, stamp_stddev=0.01, stamp_source=3)
        bag.write("stars", stars, 1000.5)
        bag.write("camera/capture", capture, 1000.5)
    with Bag(tmp_path / "night") as bag:
        topics = bag.topics(None, left_out=pytest.fail)
        said = {t.name: deserialize_message(data, t.kind) for t, _, data in bag.played(topics)}
    got, taken = said["/stars"], said["/camera/capture"]
    assert (got.width, got.height, got.clock_stddev) == (10, 20, 0.02)
    assert [(s.x, s.y, s.flags) for s in got.stars] == [(3.0, 4.0, 2)]
    assert (taken.exposure, taken.stamp_stddev, taken.stamp_source) == (0.5, 0.01, 3)
    assert not got.shutter_known and not taken.shutter_known


def test_a_broken_tilt_of_the_first_release_is_left_to_the_player(tmp_path):
    with FirstReleaseBag(tmp_path / "night") as bag:
        bag.write("tilt", bag.message("Tilt", 1000.5), 1000.5)
        bag._writer.write(bag._connections["/tilt"], 2, b"\0\1\0\0short")
    with Bag(tmp_path / "night") as bag:
        *_, (_, _, data) = sorted(bag.played(bag.topics(None, left_out=pytest.fail)), key=lambda m: -m[1])
        assert data == b"\0\1\0\0short"


def test_the_row_of_replay_names_the_inputs_that_the_code_has():
    help_ = " ".join(parser_of("replay").format_help().split())
    assert all(name in help_ for name in DRIVER_INPUTS)
    assert (
        f"{{{','.join(INPUTS)}}}" in help_ and f"({WAIT_S:g}; with --inputs {WAIT_FOR_INPUTS_S:g}," in help_
    )
