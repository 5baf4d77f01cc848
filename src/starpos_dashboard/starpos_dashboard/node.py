# SPDX-License-Identifier: Apache-2.0
"""The node `dashboard`: a read-only web page that shows the running instrument."""

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image, Imu, NavSatFix

from starpos.errors import FrameError
from starpos.messages.camera import message_to_frame
from starpos.messages.stamp import stamp_to_unix
from starpos.parameters.table import parameters_of
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.parameters import declare
from starpos_common.topics import steady_timer, subscription
from starpos_dashboard import board, server
from starpos_interfaces.msg import GnssCheck, Solution, Tilt

ENCODINGS = ("bgr8", "mono8")
LARGEST_PX = 1 << 26
QUALITY = 82


def jpeg(message: Image, side: int) -> bytes:
    """Convert a picture to a JPEG of at most `side` px; FrameError if it is not a consistent picture of 8 bits."""
    if message.encoding not in ENCODINGS:
        raise FrameError(
            f"the frame's encoding is {message.encoding[:32]!r}: only {', '.join(ENCODINGS)} are shown"
        )
    if message.width * message.height > LARGEST_PX:
        raise FrameError(f"the frame has {message.width} x {message.height} px: it is too large to be shown")
    pixels = message_to_frame(message, "the frame").pixels
    height, width = pixels.shape[:2]
    scale = side / max(height, width)
    if scale < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = cv2.resize(np.ascontiguousarray(pixels), size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise FrameError(f"the frame of {width} x {height} px cannot be made a JPEG")
    return data.tobytes()


# type, topic, name for the page, and what reads it
SHOWN: tuple[tuple[type, str, str, Callable[[Any], dict | None]], ...] = (
    (NavSatFix, "fix_averaged", "averaged", board.position),
    (Imu, "heading/imu", "heading", board.heading),
    (Tilt, "tilt", "tilt", board.tilt),
    (Solution, "solver/solution", "solution", board.solution),
    (GnssCheck, "gnss/check", "gnss", board.gnss),
)
# Maximum interval between states sent to an open page, because ages grow even if no message comes.
HEARTBEAT_S = 1.0


class DashboardNode(Node):
    """Serves the page of the instrument; see README.md."""

    def __init__(self) -> None:
        super().__init__("dashboard")
        self._values = declare(self, parameters_of("dashboard"), apply=self._apply)
        self._board = board.Board(self._values, namespace=self.get_namespace())
        address = self._values["address"]
        self._server = server.DashboardServer(
            server.listen(address, self._values["port"]),
            server.own_names() | {address.lower()} | {n.lower() for n in board.names(self._values["hosts"])},
            self._values["clients"],
        )
        # The newest that is not shown yet.
        self._image: Image | None = None
        # The subscription, while a page shows the frame.
        self._images: Subscription | None = None
        # How many frames were shown.
        self._shown = 0
        # In seconds of monotonic time.
        self._shown_at = self._told_at = 0.0
        self._pages = 0
        self._connect()
        self._server.start()
        self._announce(address)

    def _connect(self) -> None:
        subscription(self, NavSatFix, "fix", self._board.hear_fix, 10)
        for kind, topic, name, read in SHOWN:
            subscription(
                self, kind, topic, lambda m, name=name, read=read: self._board.show(name, read(m)), 10
            )
        self.create_subscription(DiagnosticArray, "/diagnostics", self._board.hear_diagnostics, 50)
        # Subscribe once now, so that a wrong qos_override is refused at the start.
        self.destroy_subscription(self._subscribe_frames())
        self._timer = steady_timer(self, 1 / self._values["rate"], self._update_page)
        self._diagnostics = Diagnostics(self, {"Page": self._report})

    def _announce(self, address: str) -> None:
        host = f"[{address}]" if ":" in address else address
        self._url = f"http://{host}:{self._server.port}"
        self.get_logger().info(f"the instrument is shown at {self._url}")
        if not server.is_loopback(address):
            self.get_logger().warning(
                f"every machine that reaches {address} can read there, without a password, where the instrument is"
            )

    def _apply(self, changed: frozenset[str]) -> None:
        if "rate" in changed:
            self._timer.timer_period_ns = round(1e9 / self._values["rate"])
        self._server.clients = self._values["clients"]

    def _on_image(self, message: Image) -> None:
        self._image = message

    # the page --------------------------------------------------------------------------------------------------------

    def _update_page(self) -> None:
        now = time.monotonic()
        self._follow_viewers()
        if self._image is not None and now - self._shown_at >= 1 / self._values["image_rate"]:
            self._show_frame(self._image, now)
        pages = self._server.pages
        more, self._pages = pages > self._pages, pages
        if pages and (more or self._board.changed or now - self._told_at >= HEARTBEAT_S):
            self._told_at = now
            unix_s = self.get_clock().now().nanoseconds * 1e-9
            self._server.show(self._board.as_json(unix_s, self._values["stale_after"]), self._board.track)

    def _follow_viewers(self) -> None:
        """Subscribe to the frames only while a page is open, because the detector draws them for subscribers."""
        pages = self._server.pages
        if pages and self._images is None:
            self._images = self._subscribe_frames()
        elif not pages and self._images is not None:
            self.destroy_subscription(self._images)
            self._images = self._image = None
            self._server.frame = None
            self._board.show("frame", None)

    def _subscribe_frames(self) -> Subscription:
        return subscription(self, Image, "detector/image_annotated", self._on_image, 1)

    def _show_frame(self, image: Image, now_s: float) -> None:
        self._image = None
        self._shown_at = now_s
        self._shown += 1
        trouble = ""
        try:
            self._server.frame = jpeg(image, self._values["image_side"])
        except FrameError as e:
            trouble, self._server.frame = str(e), None
        stamp_s = stamp_to_unix(image.header.stamp)
        self._board.show("frame", {"number": self._shown, "stamp": stamp_s, "trouble": board.text(trouble)})

    # diagnostics -----------------------------------------------------------------------------------------------------

    def _report(self) -> Diagnosis:
        values = {
            "pages": self._server.pages,
            "pages refused": self._server.refused,
            "frames shown": self._shown,
            "loopback only": server.is_loopback(self._values["address"]),
        }
        if not self._server.alive:
            trouble = self._server.trouble or "the server has ended"
            return Diagnosis(Level.ERROR, f"{trouble}: start the dashboard again", values)
        return Diagnosis(Level.OK, f"shown at {self._url}", values)

    def close(self) -> None:
        self._server.stop()
