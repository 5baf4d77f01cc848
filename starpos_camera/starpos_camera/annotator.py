# SPDX-License-Identifier: Apache-2.0
"""Annotated image of the detector, made only for subscribers, one frame at a time."""

import math
from dataclasses import dataclass

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from starpos.frames.annotate import Identified, annotate
from starpos.frames.frame import Frame, Stars
from starpos_common.diagnostics import Troubles
from starpos_common.messages import frame_to_message
from starpos_common.topics import publisher, subscription
from starpos_common.worker import Worker
from starpos_interfaces.msg import Solution

# Time that a frame waits for its solution; then it is shown without one.
PATIENCE_S = 2.0
# Maximum length of a text from outside.
NAME_LETTERS, SENTENCE_LETTERS = 24, 300


@dataclass(frozen=True, eq=False)
class Subject:
    """A frame to be annotated, the stars found in it, and the header of both."""

    frame: Frame
    stars: Stars
    header: Header


class Annotator:
    """Publishes sensor_msgs/Image on `~/image_annotated` for a node that detects stars.

    If there is a solver, the frame waits for its solver/solution. Frames that come meanwhile are left out, so that at
    most one is kept, and none without subscribers. The node calls `offer` and `stop` in its executor.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._troubles = Troubles(node)
        self._publisher = publisher(node, Image, "~/image_annotated", 1)
        # The subscription, while somebody looks at the image.
        self._solutions: Subscription | None = None
        # Subscribe once now, so that a wrong qos_override is refused at the start.
        node.destroy_subscription(self._subscribe_solutions())
        self._waiting: Subject | None = None
        self._drawing = False
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._patience = node.create_timer(PATIENCE_S, self._give_up, clock=steady, autostart=False)
        self._worker = Worker(_draw, node.create_guard_condition(self._on_wake).trigger, "annotation")
        self._worker.start()

    def stop(self) -> None:
        self._worker.stop()

    def offer(self, frame: Frame, stars: Stars, header: Header) -> None:
        """Offer a frame whose stars have just been published under `header`."""
        if not self._publisher.get_subscription_count():
            self._forget()
            return
        if self._solutions is None:
            self._solutions = self._subscribe_solutions()
        if self._waiting or self._drawing:
            return
        self._waiting = Subject(frame, stars, header)
        if self._solutions.get_publisher_count():
            self._patience.reset()
        else:
            self._begin(Identified(), ["no solver"])

    def _subscribe_solutions(self) -> Subscription:
        return subscription(self._node, Solution, "solver/solution", self._on_solution, 10)

    def _forget(self) -> None:
        self._patience.cancel()
        self._waiting = None
        if self._solutions is not None:
            self._node.destroy_subscription(self._solutions)
            self._solutions = None

    def _on_solution(self, message: Solution) -> None:
        if self._waiting and message.header.stamp == self._waiting.header.stamp:
            self._begin(_identified(message, len(self._waiting.stars)), _remarks(message))

    def _give_up(self) -> None:
        # The solution may have come in the same turn of the executor.
        if self._waiting:
            self._begin(Identified(), [f"no solution within {PATIENCE_S:g} s"])

    def _begin(self, identified: Identified, remarks: list[str]) -> None:
        """Draw the frame that waits."""
        self._patience.cancel()
        subject, self._waiting = self._waiting, None
        if self._publisher.get_subscription_count():
            self._drawing = True
            self._worker.offer((subject, identified, remarks))

    def _on_wake(self) -> None:
        for result in self._worker.fetch():
            self._drawing = False
            if isinstance(result, Image):
                self._publisher.publish(result)
                self._troubles.right("annotation")
            else:
                kind = type(result).__name__
                self._troubles.wrong(
                    "annotation",
                    f"a frame could not be annotated ({kind}: {result}); keep it and report this.",
                )


def _draw(job: tuple[Subject, Identified, list[str]]) -> Image:
    """Draw a frame, in the worker's thread."""
    subject, identified, remarks = job
    picture = annotate(subject.frame, subject.stars, identified, remarks)
    message = frame_to_message(Frame(picture), "")
    message.header = subject.header
    return message


def _identified(message: Solution, count: int) -> Identified:
    """Read the names of `count` stars from a solution; no names if it is inconsistent."""
    rows = np.array(message.indices, int)
    if not len(rows) == len(message.ids) == len(message.magnitudes) or np.any(rows >= count):
        return Identified()
    return Identified(rows.tolist(), [name[:NAME_LETTERS] for name in message.ids], message.magnitudes)


def _remarks(message: Solution) -> list[str]:
    """Write fix and heading, or the reason why they are missing."""
    if message.status != Solution.OK:
        return [message.status_text[:SENTENCE_LETTERS]]
    north, east = message.latitude_geodetic, message.longitude_geodetic
    variance = max(message.covariance_geodetic[0], message.covariance_geodetic[4])
    error = f"{math.sqrt(variance):.0f} m" if variance >= 0 else "unknown"
    place = f"{abs(north):.5f} {'NS'[north < 0]}  {abs(east):.5f} {'EW'[east < 0]}"
    return [
        f"{place}  +- {error}",
        f"heading {message.heading:.3f} +- {message.heading_stddev:.3f} deg",
    ]
