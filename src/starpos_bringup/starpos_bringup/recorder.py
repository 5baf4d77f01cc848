# SPDX-License-Identifier: Apache-2.0
"""The nodes behind `record` and `folder`."""

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from math import degrees, sqrt
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from starpos.errors import BagError, StarposError
from starpos.frames.tables import TILTS, write_star_list
from starpos.messages.camera import message_to_camera
from starpos.messages.stars import message_to_stars
from starpos.messages.tilt import UNUSABLE, message_to_tilt
from starpos.units import date_obs
from starpos_bringup.bag import BagWriter
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.topics import subscription
from starpos_interfaces.msg import StarArray, Tilt

# Free space on the disk below which there is a warning.
LITTLE_BYTES = 1_000_000_000
DEPTH = 1000


class Recorder(Node):
    """Writes each message as it comes, with the node's time; ends the program if the bag cannot be written any more.

    topics: rows of data/recorded.yaml.  say: takes a sentence for the person at the terminal.
    """

    def __init__(self, writer: BagWriter, topics: Mapping[str, Mapping], say: Callable[[str], None]) -> None:
        super().__init__("record", start_parameter_services=False)
        # Why the recording broke off.
        self.trouble = ""
        self._writer, self._say = writer, say
        for name, row in topics.items():
            package, message = row["type"].split("/msg/")
            kind = getattr(import_module(f"{package}.msg"), message)
            topic = self.resolve_topic_name(name)
            writer.add_topic(topic, row["type"], latched=row.get("latched", False))
            keep, depth = partial(self._keep, name, topic), row.get("depth", DEPTH)
            subscription(self, kind, topic, keep, depth, raw=True)
        self._counts = dict.fromkeys(topics, 0)
        self._diagnostics = Diagnostics(self, {"Bag": self._report}, str(writer.folder))
        say(f"{writer.folder}: recording {len(topics)} topics until Ctrl-C")

    def close(self) -> None:
        try:
            self._writer.close()
            self._say(f"{self._writer.folder}: {self._writer.count} messages")
        except BagError as error:
            self.trouble = str(error)
            self._say(self.trouble)

    def _keep(self, name: str, topic: str, data: bytes) -> None:
        if self.trouble:
            return
        try:
            self._writer.write(topic, self.get_clock().now().nanoseconds, data)
            self._counts[name] += 1
        except BagError as error:
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


COLUMNS = "utc_unix_s,theta_x_deg,theta_y_deg,temperature_c,sigma_deg\n"


class FolderWriter(Node):
    """Writes each list of stars and each usable tilt as it comes; see docs/tutorials/first_night.md."""

    def __init__(self, folder: Path) -> None:
        super().__init__("folder", start_parameter_services=False)
        self._folder = folder
        self._focal_px: float | None = None
        self._fwhm_px: float | None = None
        self._trouble = ""
        self._frames = len(list(folder.glob("stars_*.csv")))
        self._tilts = (folder / TILTS).open("a", buffering=1)
        if not self._tilts.tell():
            self._tilts.write(COLUMNS)
        subscription(self, StarArray, "stars", self._on_stars, 10)
        subscription(self, Tilt, "tilt", self._on_tilt, 100)
        subscription(self, CameraInfo, "camera/camera_info", self._on_camera, 10)
        subscription(self, DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._diagnostics = Diagnostics(self, {"Night": self._report}, str(folder))
        self.get_logger().info(f"{folder}: stars and tilts go there until Ctrl-C")

    def close(self) -> None:
        self._tilts.close()

    def _on_camera(self, message: CameraInfo) -> None:
        with suppress(StarposError):
            self._focal_px = message_to_camera(message).fx

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        named = f"{self.get_namespace().strip('/')}/detector: Stars".lstrip("/")
        for status in message.status:
            if status.name == named:
                values = {v.key: v.value for v in status.values}
                with suppress(KeyError, ValueError):
                    self._fwhm_px = float(values["fwhm (px)"])

    def _on_stars(self, message: StarArray) -> None:
        try:
            stars = message_to_stars(message)
            if stars.mid_unix_s is None or not stars.exposure_s:
                raise StarposError("stars without a time of their exposure: set the detector's `stamp`")
            begin_s = stars.mid_unix_s - stars.exposure_s / 2
            stars = replace(stars, focal_px=self._focal_px, fwhm_px=self._fwhm_px)
            # A reader must never see half of a list.
            whole = self._folder / f"stars_{self._frames:04d}.csv"
            part = whole.with_suffix(".part")
            write_star_list(part, stars, date_obs(begin_s))
            part.rename(whole)
            self._frames += 1
            self._trouble = ""
        except (StarposError, OSError) as error:
            self._trouble = str(error)

    def _on_tilt(self, message: Tilt) -> None:
        if message.flags & UNUSABLE:
            return
        try:
            tilt = message_to_tilt(message)
            sigma = sqrt((tilt.covariance[0][0] + tilt.covariance[1][1]) / 2)
            row = (
                tilt.utc_unix_s,
                *map(degrees, (tilt.theta_x, tilt.theta_y)),
                tilt.temperature_c,
                degrees(sigma),
            )
            self._tilts.write(",".join(f"{value:.6f}" for value in row) + "\n")
        except (StarposError, OSError) as error:
            self._trouble = str(error)

    def _report(self) -> Diagnosis:
        values = {"frames": self._frames}
        if self._trouble:
            return Diagnosis(Level.WARN, self._trouble, values)
        return Diagnosis(Level.OK, f"writing to {self._folder}.", values)
