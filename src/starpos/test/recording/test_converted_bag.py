# SPDX-License-Identifier: Apache-2.0
"""A bag that rosbags-convert made of one of ROS 1 is read, with the names that ROS 2 gives to a camera's matrix."""

import sys

import numpy as np
import pytest

from starpos.errors import BagError
from starpos.messages.camera import message_to_camera
from starpos.recording.bag import BagReader

T = 1_793_642_400


@pytest.fixture
def ros1(tmp_path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    header = types["std_msgs/msg/Header"](1, types["builtin_interfaces/msg/Time"](T, 0), "camera")
    k = np.array([900.0, 0, 320, 0, 901.0, 240, 0, 0, 1])
    p = np.array([900.0, 0, 320, 0, 0, 901.0, 240, 0, 0, 0, 1, 0])
    no_roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    kind = "sensor_msgs/msg/CameraInfo"
    info = types[kind](header, 480, 640, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, no_roi)
    with Writer(tmp_path / "one.bag") as writer:
        topic = writer.add_connection("/camera/camera_info", kind, typestore=store)
        writer.write(topic, T * 10**9, store.serialize_ros1(info, kind))
    return tmp_path / "one.bag"


def test_a_bag_of_ros_1_names_the_converter_and_what_it_makes_is_read(ros1, monkeypatch):
    from rosbags.convert.__main__ import main

    with pytest.raises(BagError, match=r"run `rosbags-convert --src one\.bag --dst one`"), BagReader(ros1):
        pass
    monkeypatch.setattr(
        sys, "argv", ["rosbags-convert", "--src", str(ros1), "--dst", str(ros1.with_suffix(""))]
    )
    with pytest.raises(SystemExit, match=r"^0$"):
        main()
    with BagReader(ros1.with_suffix(""), typed=True) as bag:
        ((_, _, message),) = bag.decoded(bag.connections)
    camera = message_to_camera(message)
    assert (camera.width, camera.fx, camera.fy, camera.cx) == (640, 900, 901, 320)
