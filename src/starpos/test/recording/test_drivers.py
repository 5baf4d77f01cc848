# SPDX-License-Identifier: Apache-2.0
"""Which topics of a robot's bag are its images, intrinsics and accelerations."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from starpos.errors import FrameError
from starpos.recording.topics import driver_topics, remaps_of

IMAGE, PICTURE, INFO, IMU = (
    f"sensor_msgs/msg/{n}" for n in ("Image", "CompressedImage", "CameraInfo", "Imu")
)
TILT = "starpos_interfaces/msg/Tilt"
RAW = "camera/image_raw"


@dataclass
class Topic:
    topic: str
    msgtype: str
    msgcount: int = 1


def found(*topics, remaps=(), namespace=None):
    bag = SimpleNamespace(path="the bag", connections=[Topic(*t) for t in topics])
    return driver_topics(bag, remaps_of(remaps), namespace)


ONE = (("/cam0/image_raw", IMAGE), ("/cam0/camera_info", INFO), ("/imu/data", IMU))


def test_the_only_topic_of_a_type_is_found_whatever_its_name():
    assert found(("/a", IMAGE), ("/b", INFO), ("/c", IMU)) == {
        RAW: "/a",
        "camera/camera_info": "/b",
        "imu/data": "/c",
    }
    assert found(("/b", INFO), ("/c", IMU)) == {}


def test_of_several_the_one_with_the_inputs_name_counts_and_intrinsics_beside_the_images():
    others = ("/imu/data_raw", IMU), ("/cam1/camera_info", INFO)
    assert found(*ONE, *others)["imu/data"] == "/imu/data"
    assert found(*ONE, *others)["camera/camera_info"] == "/cam0/camera_info"


def test_raw_images_count_more_than_compressed_ones_and_topics_without_messages_do_not():
    compressed = ("/cam0/image_raw/compressed", PICTURE)
    assert found(*ONE, compressed)[RAW] == "/cam0/image_raw"
    alone = found(("/cam0/image_raw", IMAGE, 0), compressed, *ONE[1:], ("/cam1/camera_info", INFO))
    assert alone[RAW] == compressed[0] and alone["camera/camera_info"] == "/cam0/camera_info"


def test_tilts_count_more_than_accelerations_unless_the_user_names_these():
    assert "imu/data" not in found(*ONE, ("/tilt", TILT))
    named = found(*ONE, ("/tilt", TILT), remaps=["imu/data:=/imu/data"])
    assert "tilt" not in named and named["imu/data"] == "/imu/data"


def test_where_several_may_be_meant_the_user_has_to_name_one():
    two = (*ONE, ("/cam1/image_raw", IMAGE))
    with pytest.raises(FrameError, match="choose one with --remap camera/image_raw:=/cam0/image_raw"):
        found(*two)
    assert found(*two, remaps=["camera/image_raw:=/cam1/image_raw"])[RAW] == "/cam1/image_raw"
    assert found(*two, namespace="cam1")[RAW] == "/cam1/image_raw"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("image:=/cam0/image_raw", "the inputs are camera/image_raw"),
        ("camera/image_raw", "write NAME:=TOPIC"),
        ("camera/image_raw:=/nothing", "no topic /nothing in it; it has /cam0/camera_info"),
        ("imu/data:=/cam0/image_raw", "imu/data takes sensor_msgs/msg/Imu"),
    ],
)
def test_a_topic_that_cannot_be_is_refused(text, said):
    with pytest.raises(FrameError, match=said):
        found(*ONE, remaps=[text])
