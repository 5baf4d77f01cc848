# SPDX-License-Identifier: Apache-2.0
"""What the detector does with a frame once the solver has answered it: the annotated image, and the trails."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from starpos.frames.annotate import Identified, annotate
from starpos.frames.frame import Frame, Stars
from starpos_common.diagnostics import Troubles
from starpos_common.messages import frame_to_message, trails_to_message
from starpos_common.topics import publisher, steady_timer, subscription
from starpos_common.worker import Worker
from starpos_interfaces.msg import Solution, TrailArray

# Time that a frame waits for its solution; then it goes on without one.
PATIENCE_S = 2.0
# Maximum length of a text from outside.
NAME_LETTERS, SENTENCE_LETTERS = 24, 300


@dataclass(frozen=True, eq=False)
class Subject:
    """A frame, the stars found in it, the header of both, and what the solver says of them, or why it says nothing."""

    frame: Frame
    stars: Stars
    header: Header
    identified: Identified = field(default_factory=Identified)
    remarks: Sequence[str] = ()


class AfterSolution:
    """Works on a frame of a node that detects stars once its solver/solution has come, and publishes the result.

    Frames that come meanwhile are left out, so that at most one is kept. The node calls `offer` and `stop` in its
    executor.
    """

    def __init__(self, node: Node, kind: type, topic: str, depth: int, name: str) -> None:
        self.node = node
        self._kind, self._name = kind, name
        self._troubles = Troubles(node)
        self.publisher = publisher(node, kind, topic, depth)
        # The subscription, while solutions are wanted.
        self._solutions: Subscription | None = None
        # Subscribe once now, so that a wrong qos_override is refused at the start.
        node.destroy_subscription(self._subscribe_solutions())
        self._waiting: Subject | None = None
        self._patience = steady_timer(node, PATIENCE_S, self._give_up, autostart=False)
        self._worker = Worker(self.work, node.create_guard_condition(self._on_wake).trigger, name)
        self._worker.start()

    @property
    def wanted(self) -> bool:
        return self.publisher.get_subscription_count() > 0

    def work(self, subject: Subject) -> Any:
        """The message on a frame, in the worker's thread; None: there is nothing to be said."""
        raise NotImplementedError

    def stop(self) -> None:
        self._worker.stop()

    def offer(self, frame: Frame, stars: Stars, header: Header) -> None:
        """Offer a frame whose stars have just been published under `header`."""
        if not self.wanted:
            self._forget()
            return
        if self._solutions is None:
            self._solutions = self._subscribe_solutions()
        if self._waiting or not self._worker.idle:
            return
        self._waiting = Subject(frame, stars, header)
        if self._solutions.get_publisher_count():
            self._patience.reset()
        else:
            self._begin(None, "no solver")

    def _subscribe_solutions(self) -> Subscription:
        return subscription(self.node, Solution, "solver/solution", self._on_solution, 10)

    def _forget(self) -> None:
        self._patience.cancel()
        self._waiting = None
        if self._solutions is not None:
            self.node.destroy_subscription(self._solutions)
            self._solutions = None

    def _on_solution(self, message: Solution) -> None:
        if self._waiting and message.header.stamp == self._waiting.header.stamp:
            self._begin(message)

    def _give_up(self) -> None:
        # The solution may have come in the same turn of the executor.
        if self._waiting:
            self._begin(None, f"no solution within {PATIENCE_S:g} s")

    def _begin(self, solution: Solution | None, without: str = "") -> None:
        self._patience.cancel()
        subject, self._waiting = self._waiting, None
        if subject is None or not self.wanted:
            return
        if solution is None:
            self._worker.offer(replace(subject, remarks=[without]))
        else:
            identified = _identified(solution, len(subject.stars))
            self._worker.offer(replace(subject, identified=identified, remarks=_remarks(solution)))

    def _on_wake(self) -> None:
        for result in self._worker.fetch():
            if isinstance(result, self._kind):
                self.publisher.publish(result)
                self._troubles.right(self._name)
            elif result is not None:
                kind = type(result).__name__
                self._troubles.wrong(
                    self._name,
                    f"the {self._name} of a frame failed ({kind}: {result}); keep it and report this.",
                )


class Annotator(AfterSolution):
    """Publishes sensor_msgs/Image on `~/image_annotated`, for subscribers only; without a solution it says why."""

    def __init__(self, node: Node) -> None:
        super().__init__(node, Image, "~/image_annotated", 1, "annotation")

    def work(self, subject: Subject) -> Image:
        picture = annotate(subject.frame, subject.stars, subject.identified, subject.remarks)
        message = frame_to_message(Frame(picture), "")
        message.header = subject.header
        return message


class TrailFinder(AfterSolution):
    """Publishes the trails that no star explains as starpos_interfaces/TrailArray on `trails`, of identified frames."""

    def __init__(self, node: Node) -> None:
        super().__init__(node, TrailArray, "trails", 10, "search for trails")

    def work(self, subject: Subject) -> TrailArray | None:
        from starpos.detection.trails import find_trails

        stars, rows = subject.stars, subject.identified.star
        if not rows:
            return None
        found = find_trails(subject.frame, stars, stars.x[rows], stars.y[rows], stars.flux[rows])
        return trails_to_message(found, subject.header)


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
    return [f"{place}  +- {error}", f"heading {message.heading:.3f} +- {message.heading_stddev:.3f} deg"]
