# SPDX-License-Identifier: Apache-2.0
"""The detector's annotated image: for whom, of what, and its cost without subscribers."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from test_detector import Feed

from starpos.frames.annotate import DETECTED, IDENTIFIED
from starpos.messages.camera import message_to_frame
from starpos_camera.detector import DetectorNode
from starpos_interfaces.msg import Solution, StarArray
from starpos_testing.nodes import Listener, Process

TOPIC = "detector/image_annotated"


def has(picture, star, colour) -> bool:
    """Whether a circle of this colour is around a star of a frame that is shown as it is."""
    left, top = (max(round(v) - 11, 0) for v in (star.x, star.y))
    around = picture[top : top + 23, left : left + 23].astype(int)
    rows, columns = np.nonzero(np.abs(around - colour).max(2) < 40)
    away = np.hypot(left + columns - star.x, top + rows - star.y)
    return np.count_nonzero((away > 4) & (away < 10)) > 8


class Inside:
    """A detector in this process, to see what it keeps."""

    def __init__(self, frame):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.detector = DetectorNode(listens=False, context=self.context)
        self.viewer = rclpy.create_node("viewer", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.detector)
        self.executor.add_node(self.viewer)
        self.stars, self.images, self.alive, self.frame = [], [], weakref.WeakSet(), frame
        self.viewer.create_subscription(StarArray, "stars", self.stars.append, 10)
        self.wait(lambda: self.viewer.count_publishers("stars"))

    def close(self):
        self.executor.shutdown()
        self.detector.close()
        self.detector.destroy_node()
        self.viewer.destroy_node()
        rclpy.shutdown(context=self.context)

    def wait(self, condition):
        for _ in range(300):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.1)
        raise AssertionError("waited in vain")

    def show(self):
        """Have a frame's stars published; it is this process's to keep or to let go."""
        count, frame = len(self.stars), replace(self.frame, pixels=self.frame.pixels.copy())
        self.alive.add(frame)
        header = Header()
        header.stamp.sec = 1793642400 + count
        self.detector.submit(frame, header)
        del frame
        self.wait(lambda: len(self.stars) > count)

    def kept(self) -> int:
        gc.collect()
        return len(self.alive)


@pytest.fixture
def inside(frame):
    inside = Inside(frame)
    yield inside
    inside.close()


def test_where_nobody_looks_nothing_is_kept_drawn_or_listened_to(inside):
    solver = inside.viewer.create_publisher(Solution, "solver/solution", 10)
    inside.show()
    inside.show()
    assert inside.kept() == 0
    assert solver.get_subscription_count() == 0
    assert inside.viewer.count_subscribers("solver/solution") == 0


def test_one_frame_waits_for_its_solution_and_none_once_the_viewer_has_gone(inside):
    solver = inside.viewer.create_publisher(Solution, "solver/solution", 10)
    eye = inside.viewer.create_subscription(Image, TOPIC, inside.images.append, 10)
    inside.wait(lambda: inside.show() or inside.images)
    inside.wait(solver.get_subscription_count)
    # It waits, the others pass by.
    inside.wait(lambda: inside.show() or inside.kept() == 1)
    for _ in range(5):
        inside.show()
        assert inside.kept() <= 1
    inside.viewer.destroy_subscription(eye)
    inside.wait(lambda: inside.show() or solver.get_subscription_count() == 0)
    inside.show()
    assert inside.kept() == 0


class Viewer:
    """Somebody who looks at the annotated images of a feed."""

    def __init__(self, feed):
        self.feed = feed
        self.images = feed.listener.hear(Image, TOPIC)
        self.solver = None
        feed.listener.wait(lambda: feed.listener.node.count_publishers(TOPIC))

    def start_solver(self):
        """A topic of solutions that the detector listens to; it does so from the first frame that is looked at."""
        if self.solver:
            return
        self.solver = self.feed.listener.node.create_publisher(Solution, "solver/solution", 10)
        self.feed.show(self.feed.frame)
        self.feed.listener.wait(self.solver.get_subscription_count)

    def see(self, changes=None, wanted=lambda picture, stars: True):
        """The picture and the stars of a frame; changes: of the solution, None for no solution at all.

        Frames pass by while an earlier one waits or is drawn, and on a busy machine a solution may come when the frame
        has been shown without it: it is shown until there is a picture that is wanted.
        """
        shown, found = [], []

        def show():
            message = self.feed.message(self.feed.frame)
            shown.append(message.header)
            self.feed.images.publish(message)
            self.feed.wait_for(message)
            if changes is not None:
                said = {"ids": ["HIP 11"], "indices": [0], "magnitudes": [4.5], "status": Solution.NO_TILT}
                self.solver.publish(Solution(**{"header": message.header, **said, **changes}))

        def seen():
            for image in [image for image in self.images if image.header in shown]:
                self.images.remove(image)
                stars = next(s.stars for s in self.feed.stars if s.header == image.header)
                picture = message_to_frame(image).pixels
                if wanted(picture, stars):
                    found.append((picture, stars))
            return found

        self.feed.listener.wait(lambda: seen() or show())
        return found[-1]


# After the detectors in this process, which would hear its solver.
@pytest.fixture(scope="module")
def viewer(domain, frame):
    """Somebody who looks at the images of a detector that these tests share."""
    listener, started = Listener(), []

    def start(executable, *parameters):
        started.append(Process("starpos_camera.main", executable, parameters))
        return started[-1]

    feed = Feed(listener, start)
    feed.frame = frame
    viewer = Viewer(feed)
    # images are made from when the detector knows of the viewer
    listener.wait(lambda: feed.show(frame) and viewer.images)
    yield viewer
    for process in started:
        process.kill()
    listener.close()


def test_without_a_solver_every_star_is_circled_under_the_header_of_the_frame(viewer):
    picture, stars = viewer.see()
    assert picture.shape[1] == 640 and picture.shape[0] > 480
    clean = [s for s in stars if not s.flags]
    assert len(clean) > 10 and all(has(picture[:480], s, DETECTED) for s in clean)


def test_the_solution_of_the_frame_names_its_stars(viewer):
    viewer.start_solver()
    plain, stars = viewer.see({"ids": [], "indices": [], "magnitudes": []})
    row = next(k for k, s in enumerate(stars) if not s.flags and 100 < s.x < 500 and 50 < s.y < 430)
    named, _ = viewer.see(
        {"indices": [row]}, lambda picture, stars: has(picture[:480], stars[row], IDENTIFIED)
    )
    assert has(plain[:480], stars[row], DETECTED)
    rows, columns = np.nonzero((named[:480] != plain[:480]).any(2))
    away = np.hypot(columns - stars[row].x, rows - stars[row].y)
    # A text next to it, and nothing elsewhere.
    assert 30 < away.max() < 150


def test_a_solution_that_does_not_hold_together_or_is_of_another_frame_names_nobody(viewer):
    viewer.start_solver()
    for changes in (
        {"indices": [4_000_000_000]},
        {"indices": [0, 1]},
        {"magnitudes": []},
        {"ids": ["HIP 1"] * 50_000},
        {"header": Header()},
    ):
        picture, stars = viewer.see(changes)
        assert not has(picture[:480], stars[0], IDENTIFIED), changes.keys()


def test_strange_numbers_and_endless_names_are_drawn_all_the_same(viewer):
    viewer.start_solver()
    for unknown in (float("nan"), -1.0):
        strange = {
            "ids": ["\N{SNOWMAN}\n%s" * 10_000],
            "magnitudes": [float("inf")],
            "status": Solution.OK,
            "status_text": "x" * 100_000,
            "heading": float("nan"),
            "covariance_geodetic": [unknown] * 9,
        }
        viewer.see(strange, lambda picture, stars: stars[0].flags or has(picture[:480], stars[0], IDENTIFIED))
