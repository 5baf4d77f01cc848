# SPDX-License-Identifier: Apache-2.0
"""The node `detector` as a process of its own."""

import math
import signal

import numpy as np
import pytest
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image

from starpos.detection import detect
from starpos.frames.frame import Frame
from starpos.messages.stars import message_to_stars
from starpos_camera.detector import DetectorNode
from starpos_common.messages import frame_to_message
from starpos_interfaces.msg import Capture, StarArray
from starpos_interfaces.srv import SetCapture
from starpos_testing.nodes import Listener, Process, refusal

OK, WARN = 0, 1


class Feed:
    """A camera that shows the detector what a test gives it, and the stars that come back."""

    def __init__(self, listener, start, *parameters):
        self.listener = listener
        self.stars = listener.hear(StarArray, "stars")
        node = listener.node
        self.images = node.create_publisher(Image, "camera/image_raw", QoSProfile(depth=100))
        self.captures = node.create_publisher(Capture, "camera/capture", 10)
        self.process = start("detector", *parameters)
        listener.wait(
            lambda: (
                self.images.get_subscription_count()
                and self.captures.get_subscription_count()
                and node.count_publishers("stars")
            )
        )
        self.stamp = 0

    def message(self, frame):
        message = frame_to_message(frame, "optical")
        self.stamp += 1
        message.header.stamp.sec, message.header.stamp.nanosec = 1793642400 + self.stamp, 123456789
        return message

    def send(self, frame, **told):
        """Send a frame and what is known of it: exposure, errors, shutter."""
        message = self.message(frame)
        self.captures.publish(Capture(header=message.header, **told))
        self.images.publish(message)
        return message

    def show(self, frame):
        """Stars of a frame."""
        return self.wait_for(self.send(frame))

    def wait_for(self, message):
        self.listener.wait(lambda: any(s.header == message.header for s in self.stars))
        return next(s for s in self.stars if s.header == message.header)


@pytest.fixture
def feed(listener, start):
    return Feed(listener, start)


def test_stars_are_those_of_starpos_under_the_header_of_the_image(feed, frame):
    shown = []

    def show():
        message = feed.message(frame)
        feed.images.publish(message)
        # Two topics keep no order.
        feed.captures.publish(
            Capture(
                header=message.header,
                exposure=0.75,
                stamp_stddev=0.003,
                clock_stddev=0.02,
                shutter_known=True,
                readout=-0.03,
                readout_stddev=0.001,
            )
        )
        shown.append(feed.wait_for(message))

    # the first Captures go before the detector has found who sends them
    feed.listener.wait(lambda: show() or shown[-1].exposure)
    got = shown[-1]
    assert (got.width, got.height, got.exposure) == (640, 480, 0.75)
    assert (got.stamp_stddev, got.clock_stddev) == (0.003, 0.02)
    assert (got.shutter_known, got.readout, got.readout_stddev) == (True, -0.03, 0.001)
    want = detect(frame).stars
    stars = message_to_stars(got)
    assert len(want) >= 10
    for name in ("x", "y", "flags", "covariance"):
        np.testing.assert_array_equal(getattr(stars, name), getattr(want, name))
    np.testing.assert_allclose(stars.flux, want.flux, rtol=1e-6)
    assert feed.process.end(signal.SIGINT, signal.SIGINT)[0] == 0


def bad(**changes):
    def spoil(message):
        for name, value in changes.items():
            if name == "stamp":
                message.header.stamp.sec, message.header.stamp.nanosec = value
            else:
                setattr(message, name, value)
        return message

    return spoil


def test_bad_images_are_said_and_the_next_good_one_gives_stars(feed, frame):
    cases = (
        (bad(encoding="32FC1"), "'32FC1' is unknown"),
        (bad(data=b"\x00" * 1000), "truncated"),
        (bad(width=0, height=0, step=0, data=b""), "0 x 0"),
        (bad(step=10), "step is 10"),
        (bad(height=2**31), "truncated"),
        (bad(stamp=(0, 0)), "no time stamp"),
        (bad(stamp=(-5, 0)), "no time after 1970"),
        (bad(stamp=(1793642400, 4_000_000_000)), "no time after 1970"),
    )
    for count, (spoil, sentence) in enumerate(cases, 1):
        message = spoil(feed.message(frame))
        # which it need not wait for
        feed.captures.publish(Capture(header=message.header))
        feed.images.publish(message)
        state = feed.listener.wait_for_state("detector: Stars", WARN, sentence)
        assert state["bad frames"] == str(count)
    assert not feed.stars
    assert feed.show(frame).stars
    feed.listener.wait_for_state("detector: Stars", OK, "stars in")
    status, out = feed.process.end(signal.SIGTERM)
    assert status == 0 and "Traceback" not in out
    assert 1 <= len(out.splitlines()) <= len(cases) + 1


def test_exposure_is_the_parameter_where_no_capture_says_it(listener, start, frame):
    feed = Feed(listener, start, "exposure:=0.4")
    assert feed.show(frame).exposure == 0.4
    message = feed.message(frame)
    feed.captures.publish(
        Capture(header=message.header, exposure=math.nan, stamp_stddev=math.nan, clock_stddev=math.inf)
    )
    feed.images.publish(message)
    got = feed.wait_for(message)
    assert (got.exposure, got.stamp_stddev, got.clock_stddev) == (0.4, 0.0, 0.0)


def test_newest_frame_wins_and_the_others_are_counted(feed, frame):
    feed.show(frame)
    sent = [feed.send(frame) for _ in range(40)]
    feed.wait_for(sent[-1])
    # How good the state is, is not asked: on a busy machine the last frame is soon an old one.
    values = feed.listener.values_of(
        "detector: Stars", lambda v: int(v["frames"]) + int(v["dropped"]) == 1 + len(sent)
    )
    assert int(values["dropped"]) > 0


@pytest.mark.parametrize("parameter", ["threshold:=2", "min_snr:=.nan"])
def test_bad_parameters_are_refused(parameter):
    assert parameter.split(":")[0] in refusal(DetectorNode, parameter)


# After the tests that start a detector of their own: there may be one at a time.
@pytest.fixture(scope="module")
def standing(domain):
    """A detector for all tests below; what one of them sets it sets back."""
    listener, started = Listener(), []

    def start(executable, *parameters):
        started.append(Process("starpos_camera.main", executable, parameters))
        return started[-1]

    yield Feed(listener, start)
    for process in started:
        process.kill()
    listener.close()


def test_diagnostics_tell_what_the_frame_was_like(standing, scene, frame):
    stars = standing.show(frame).stars
    state = standing.listener.wait_for_state("detector: Stars", OK, f"{len(stars)} stars in")
    assert state["stars"] == str(len(stars))
    want = detect(frame)
    for name, value in (
        ("background (DN)", want.background),
        ("noise (DN)", want.noise),
        ("fwhm (px)", want.fwhm_px),
        ("chi2", want.typical_chi2),
        ("left out", 0),
    ):
        assert float(state[name]) == pytest.approx(value, rel=1e-8), name
    sky = np.median(frame.pixels)
    assert float(state["background (DN)"]) == pytest.approx(sky, abs=3)
    electrons = (sky - scene.optics.bias_dn) * scene.optics.gain_e_dn
    photons_dn = math.sqrt(electrons + scene.optics.read_noise_e**2) / scene.optics.gain_e_dn
    assert float(state["noise (DN)"]) == pytest.approx(photons_dn, rel=0.06)
    # The pixel's own width adds to it.
    assert float(state["fwhm (px)"]) == pytest.approx(scene.optics.fwhm_px, abs=0.25)
    assert 0 < float(state["cpu_ms"]) <= 1.01e3 * float(state["seconds"])


@pytest.mark.parametrize("value", [0, 1000, 65535])
def test_frames_without_stars_give_none(standing, value):
    got = standing.show(Frame(np.full((480, 640), value, np.uint16)))
    assert (got.width, got.height, len(got.stars)) == (640, 480, 0)
    standing.listener.wait_for_state("detector: Stars", OK, "no stars")
    assert standing.show(Frame(np.full((1, 1), value, np.uint16))).width == 1


def test_every_encoding_gives_the_same_places(standing, frame):
    want = message_to_stars(standing.show(frame))
    bright = slice(0, 5)
    swapped = standing.message(frame)
    swapped.is_bigendian = 1
    swapped.data = frame.pixels.byteswap().tobytes()
    standing.captures.publish(Capture(header=swapped.header))
    standing.images.publish(swapped)
    assert standing.wait_for(swapped).stars == standing.show(frame).stars
    grey = np.clip((frame.pixels.astype(float) - 400) / 8, 0, 255).astype(np.uint8)
    for other in (Frame(grey), Frame(np.dstack([grey] * 3)), Frame(frame.pixels, pattern="rggb")):
        got = message_to_stars(standing.show(other))
        away = np.hypot(want.x[bright, None] - got.x, want.y[bright, None] - got.y).min(1)
        assert away.max() < 0.3


def test_captures_that_come_after_the_next_frame_are_still_of_their_frames(standing, frame):
    """A busy machine may lose a Capture; the middleware repeats it with the next one."""
    standing.show(frame)

    def exposures():
        sent = [standing.message(frame) for _ in range(2)]
        for message in sent:
            standing.images.publish(message)
            # the detector takes one image at a time
            standing.listener.wait(lambda: standing.images.wait_for_all_acked(Duration(seconds=0.1)))
        for number, message in enumerate(sent, 1):
            standing.captures.publish(Capture(header=message.header, exposure=0.1 * number))
        standing.wait_for(sent[1])
        return [s.exposure for s in standing.stars if s.header in [m.header for m in sent]]

    # where this takes longer than a frame waits for its Capture, the second frame replaces the first
    standing.listener.wait(lambda: exposures() == [0.1, 0.2])


def test_a_frame_whose_capture_is_lost_has_the_errors_of_the_last_and_does_not_wait_for_it(standing, frame):
    usual = {"stamp_stddev": 0.1, "clock_stddev": 0.2, "shutter_known": True, "readout": 0.02}
    got = []

    # the newest frame wins, so the one that waited may be dropped for the next, whose Capture is then the last
    def answered():
        standing.wait_for(standing.send(frame, exposure=0.5, **usual))
        lost = standing.message(frame)
        standing.images.publish(lost)
        standing.listener.wait(lambda: standing.images.wait_for_all_acked(Duration(seconds=0.1)))
        assert standing.show(frame).stars
        got.extend(s for s in standing.stars if s.header == lost.header)
        return got

    standing.listener.wait(answered)
    [got] = got
    assert got.exposure == 0 and {name: getattr(got, name) for name in usual} == usual


@pytest.mark.parametrize("told", ["exposure", "stamp_stddev", "clock_stddev"])
def test_a_capture_that_no_frame_can_have_costs_its_frame_only(standing, frame, told):
    standing.listener.states.clear()

    # The first Captures go before the detector has found who sends them.
    def absurd():
        message = standing.message(frame)
        standing.captures.publish(Capture(header=message.header, **{told: 1e300}))
        standing.images.publish(message)
        state = standing.listener.states.get("detector: Stars")
        return state and "1e+300" in state.message

    standing.listener.wait(absurd)
    assert standing.show(frame).stars


def test_parameters_apply_at_run_time(standing, frame):
    everything = len(standing.show(frame).stars)
    assert standing.listener.set("detector", max_stars=3).successful
    assert len(standing.show(frame).stars) <= 3
    assert standing.listener.set("detector", max_stars=10000, min_snr=100.0).successful
    assert len(standing.show(frame).stars) < everything
    assert standing.listener.set("detector", saturation=2000.0, min_snr=6.5).successful
    assert standing.show(frame).stars[0].flags & 1
    refusal = standing.listener.set("detector", threshold=1.0)
    assert not refusal.successful and "from 3 to 1000" in refusal.reason
    for name, value in (("saturation", -1.0), ("max_stars", 0), ("exposure", -1.0)):
        refusal = standing.listener.set("detector", **{name: value})
        assert not refusal.successful and name in refusal.reason


def test_by_day_the_camera_is_asked_for_a_shorter_exposure_and_by_night_for_its_own(listener, start):
    asked = []

    def answer(request, response):
        asked.append(request.exposure)
        response.success = True
        return response

    service = listener.node.create_service(SetCapture, "camera/set_capture", answer)
    feed = Feed(listener, start, "day_exposure:=true")
    white, dark = Frame(np.full((200, 300), 255, np.uint8)), Frame(np.full((200, 300), 3, np.uint8))
    # the service may not have been discovered at the first frames
    while not asked:
        feed.wait_for(feed.send(white, exposure=0.8))
    feed.wait_for(feed.send(dark, exposure=asked[0]))
    listener.wait(lambda: asked[-1] > asked[0])
    # a camera that does not follow is asked again
    assert asked == pytest.approx([0.1] * (len(asked) - 1) + [0.8])
    listener.node.destroy_service(service)
