# SPDX-License-Identifier: Apache-2.0
"""The node `record`: writes the messages of topics to a bag."""

import shutil
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module

import rclpy
from rclpy.node import Node

from starpos_bringup.recording.bag_writer import BagWriteError, BagWriter
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.topics import subscription

# Free space on the disk below which there is a warning.
LITTLE_BYTES = 1_000_000_000
# An image may have 42 MB.
DEPTH, IMAGE_DEPTH = 1000, 3
# Topics that are published transient_local.
LATCHED = ("camera/camera_info",)


class Recorder(Node):
    """Writes each message as it comes, with the node's time; ends the program if the bag cannot be written any more.

    topics: types by relative names.  say: takes a sentence for the person at the terminal.
    """

    def __init__(self, writer: BagWriter, topics: Mapping[str, str], say: Callable[[str], None]) -> None:
        super().__init__("record", start_parameter_services=False)
        # Why the recording broke off.
        self.trouble = ""
        self._writer, self._say = writer, say
        for name, type_name in topics.items():
            package, message = type_name.split("/msg/")
            kind = getattr(import_module(f"{package}.msg"), message)
            topic = self.resolve_topic_name(name)
            writer.add_topic(topic, type_name, latched=name in LATCHED)
            depth = IMAGE_DEPTH if message == "Image" else DEPTH
            subscription(self, kind, topic, partial(self._keep, name, topic), depth, raw=True)
        self._counts = dict.fromkeys(topics, 0)
        self._diagnostics = Diagnostics(self, {"Bag": self._report}, str(writer.folder))
        say(f"{writer.folder}: recording {len(topics)} topics until Ctrl-C")

    def destroy_node(self) -> None:
        super().destroy_node()
        try:
            self._writer.close()
            self._say(f"{self._writer.folder}: {self._writer.count} messages")
        except BagWriteError as error:
            self.trouble = str(error)
            self._say(self.trouble)

    def _keep(self, name: str, topic: str, data: bytes) -> None:
        if self.trouble:
            return
        try:
            self._writer.write(topic, self.get_clock().now().nanoseconds, data)
            self._counts[name] += 1
        except BagWriteError as error:
            self.trouble = str(error)
            self._say(self.trouble)
            rclpy.shutdown()

    def _report(self) -> Diagnosis:
        free_bytes = shutil.disk_usage(self._writer.folder).free
        values = {"messages": self._writer.count, "free (MB)": free_bytes // 10**6, **self._counts}
        if free_bytes < LITTLE_BYTES:
            return Diagnosis(
                Level.WARN,
                f"the disk has {free_bytes // 10**6} MB left: make room or end the recording.",
                values,
            )
        return Diagnosis(Level.OK, f"recording to {self._writer.folder}.", values)
