# SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 files of a simulated night as the nodes would, for the tests of reading them."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MESSAGES = Path(__file__).resolve().parents[4] / "starpos_interfaces" / "msg"
EMPTY = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def typestore():
    """Message types of ROS and our own; skips the test if our own are not next to this package."""
    if not MESSAGES.is_dir():
        pytest.skip("starpos_interfaces is not beside this package")
    store = get_typestore(Stores.ROS2_JAZZY)
    for text in MESSAGES.glob("*.msg"):
        store.register(get_types_from_msg(text.read_text(), f"starpos_interfaces/msg/{text.stem}"))
    return store


def part_of(bag: Path, folder: Path, begin_s: float, seconds: float) -> Path:
    """Write the part of a bag from a time in s after its beginning, as a bag of its own."""
    with AnyReader([bag]) as reader, Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        begin_ns, made = reader.start_time + round(begin_s * 1e9), {}
        for c, log_ns, data in reader.messages(start=begin_ns, stop=begin_ns + round(seconds * 1e9)):
            if c.topic not in made:
                made[c.topic] = writer.add_connection(c.topic, c.msgtype, typestore=reader.typestore)
            writer.write(made[c.topic], log_ns, data)
    return folder


def knowing(truth: dict) -> list[str]:
    """Parameters of a solver that knows the instrument of the night test/data/night, from the JSON next to it."""
    values = {
        "use_sim_time": "true",
        "refraction.pressure": truth["pressure_pa"],
        "refraction.temperature": truth["temperature_c"],
        "refraction.humidity": truth["humidity"],
        "misalignment": truth["misalignment_deg"],
        "misalignment_stddev": 0.1,
        "inclinometer.model": "sca100t_calibrated",
    }
    return [f"{name}:={value}" for name, value in values.items()]


class Quiet:
    """A log and driver that take anything from a session."""

    def __getattr__(self, name):
        return lambda *_: None


class NightBag:
    """Writes a bag, by default MCAP, with its topics in `namespace`."""

    def __init__(self, path, namespace="", plugin=StoragePlugin.MCAP):
        self.store, self.namespace, self._connections = typestore(), namespace, {}
        self._writer = Writer(path, version=9, storage_plugin=plugin)

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *exception):
        self._writer.close()

    def message(self, name, unix_s=0.0, /, **fields):
        """A message of starpos_interfaces, or of another package by its full name; fields not given are 0."""
        kind = name if "/" in name else f"starpos_interfaces/msg/{name}"
        seconds, micro = divmod(round(unix_s * 1e6), 1_000_000)
        made = self._blank(kind)
        if hasattr(made, "header"):
            made.header.stamp.sec, made.header.stamp.nanosec = seconds, micro * 1000
        for field, value in fields.items():
            assert hasattr(made, field)
            setattr(made, field, value)
        return made

    def write(self, topic, message, unix_s):
        topic, kind = f"{self.namespace}/{topic}", message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        data = self.store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], round(unix_s * 1e9), data)

    def camera(self, focal_px, width, height):
        k = np.array([focal_px, 0, (width - 1) / 2, 0, focal_px, (height - 1) / 2, 0, 0, 1])
        name = "sensor_msgs/msg/CameraInfo"
        made = self.message(
            name, width=width, height=height, distortion_model="plumb_bob", k=k, d=np.zeros(5)
        )
        self.write("camera/camera_info", made, 1.0)

    def stars(self, stars):
        rows = [
            self.message("Star", x=x, y=y, flux=f, snr=s, covariance=c.ravel(), flags=int(g))
            for x, y, f, s, c, g in zip(
                stars.x.tolist(), stars.y.tolist(), stars.flux.tolist(), stars.snr.tolist(), stars.covariance,
                stars.flags, strict=True,
            )
        ]  # fmt: skip
        about = {"width": stars.width, "height": stars.height, "exposure": stars.exposure_s}
        self.write(
            "stars", self.message("StarArray", stars.mid_unix_s, stars=rows, **about), stars.mid_unix_s
        )

    def tilts(self, log):
        """Write the readings of a TiltLog."""
        for at, x, y, warm in zip(log.utc_unix_s, log.theta_x, log.theta_y, log.temperature_c, strict=True):
            self.write("tilt", self.message("Tilt", at, x=x, y=y, temperature=warm), at)

    def _blank(self, kind):
        _, fields = self.store.fielddefs[kind]
        return self.store.types[kind](**{name: self._empty(definition) for name, definition in fields})

    def _empty(self, definition):
        node, about = definition
        if node == Nodetype.BASE:
            return EMPTY.get(about[0], 0)
        if node == Nodetype.NAME:
            return self._blank(about)
        (element, inner), length = about
        count = length if node == Nodetype.ARRAY else 0
        if element == Nodetype.BASE and inner[0] != "string":
            return np.zeros(count, inner[0])
        return [self._empty((element, inner)) for _ in range(count)]
