# SPDX-License-Identifier: Apache-2.0
"""Messages to starpos' types and back, and messages that do not hold together."""

import array
import math
from dataclasses import replace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image

from starpos.errors import FrameError, InstrumentError, TiltError, TimeError
from starpos.frames.exposure import GLOBAL_SHUTTER, Shutter
from starpos.frames.frame import EDGE, Disc, Frame, FrameTrail, Stars, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.messages import tilt as tilts
from starpos.messages.camera import message_to_camera, message_to_frame
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars, message_to_trails
from starpos.messages.tilt import message_to_tilt
from starpos_common import messages
from starpos_interfaces import msg

MID = 1_795_168_800.123456
RNG = np.random.default_rng(1)


@pytest.fixture(params=["node", "bag"])
def heard(request):
    """A message as a node hears it, and as `rosbags` reads it from a bag: one reader takes both."""
    if request.param == "node":
        return lambda message: message
    pytest.importorskip("rosbags")
    from starpos_testing.skies.bags import typestore

    store = typestore()

    def from_bag(message):
        package, name = type(message).__module__.split(".")[0], type(message).__name__
        return store.deserialize_cdr(serialize_message(message), f"{package}/msg/{name}")

    return from_bag


@pytest.mark.parametrize("microseconds", [0, 1, 123_456, 500_000, 999_999])
@pytest.mark.parametrize("seconds", [1, 1_000_000_000, 1_795_168_800, 2**31 - 1])
def test_stamps_are_exact_to_the_microsecond(seconds, microseconds):
    stamp = Time(sec=seconds, nanosec=microseconds * 1000)
    assert messages.unix_to_stamp(stamp_to_unix(stamp)) == stamp


def test_stamps_that_are_none_and_that_cannot_be():
    assert stamp_to_unix(Time()) is None
    assert messages.unix_to_stamp(None) == Time()
    assert messages.unix_to_stamp(1.9999999) == Time(sec=2)
    for bad in (math.nan, math.inf, -1.0, 2.0**31):
        with pytest.raises(TimeError):
            messages.unix_to_stamp(bad)


def stars(n=5):
    flux = np.sort(RNG.uniform(100, 1e5, n))[::-1]
    covariance = np.tile([[0.01, 0.002], [0.002, 0.02]], (n, 1, 1))
    x, y = RNG.uniform(0, 100, (2, n))
    return Stars(
        x=x,
        y=y,
        flux=flux,
        snr=np.sqrt(flux),
        covariance=covariance,
        flags=np.full(n, EDGE),
        width=200,
        height=100,
        mid_unix_s=MID,
        exposure_s=0.5,
        stamp_stddev_s=1e-3,
        clock_stddev_s=0.02,
    )


def test_stars_round_trip(heard):
    sent = stars()
    message = messages.stars_to_message(sent, "optical")
    assert (message.header.frame_id, message.stamp_stddev, message.exposure) == ("optical", 1e-3, 0.5)
    got = message_to_stars(heard(message))
    for name in ("x", "y", "covariance", "flags"):
        assert np.array_equal(getattr(got, name), getattr(sent, name))
    assert got.flux == pytest.approx(sent.flux, rel=1e-6)
    assert (got.width, got.height, got.exposure_s) == (200, 100, 0.5)
    assert (got.stamp_stddev_s, got.clock_stddev_s) == (1e-3, 0.02)
    assert got.mid_unix_s == pytest.approx(MID, abs=1e-6)


@pytest.mark.parametrize("shutter", [None, GLOBAL_SHUTTER, Shutter(-0.03, 0.001)])
def test_the_shutter_of_stars_round_trips(heard, shutter):
    message = heard(messages.stars_to_message(replace(stars(), shutter=shutter), "c"))
    assert message_to_stars(message).shutter == shutter
    assert message.shutter_known == (shutter is not None)


@pytest.mark.parametrize("cut", [(False, False), (True, False), (False, True)])
def test_trails_round_trip(heard, cut):
    root = RNG.normal(0, 1, (4, 4))
    sent = FrameTrail(
        ends=RNG.uniform(0, 100, (2, 2)),
        covariance=root @ root.T,
        snr=25.0,
        cut=np.array(cut),
        steady=not cut[0],
    )
    header = messages.stars_to_message(stars(), "c").header
    message = heard(messages.trails_to_message([sent], header))
    (got,) = message_to_trails(message)
    assert message.header.stamp.sec == header.stamp.sec and np.array_equal(got.ends, sent.ends)
    assert np.array_equal(got.covariance, sent.covariance)
    assert (got.cut.tolist(), got.steady, got.snr) == (list(cut), sent.steady, 25.0)


@pytest.mark.parametrize("sharp", [True, False])
def test_what_looks_like_the_sun_round_trips_beside_the_stars(heard, sharp):
    error = np.array([[0.04, 0.01], [0.01, 0.09]])
    disc = Disc(x=120.5, y=33.25, covariance=error, radius_px=17.0, sharp=sharp)
    got = message_to_stars(heard(messages.stars_to_message(replace(stars(), disc=disc), "c")))
    assert len(got) == len(stars())
    assert (got.disc.x, got.disc.y, got.disc.sharp) == (120.5, 33.25, sharp)
    assert got.disc.radius_px == pytest.approx(17.0, rel=1e-6)
    assert np.array_equal(got.disc.covariance, error)
    both = replace(stars(), disc=replace(disc, other=replace(disc, x=20.0, sharp=True)))
    got = message_to_stars(heard(messages.stars_to_message(both, "c")))
    assert (got.disc.x, got.disc.other.x, got.disc.other.sharp, got.disc.other.other) == (
        120.5,
        20.0,
        True,
        None,
    )


@pytest.mark.parametrize(("field", "value"), [("flux", -1.0), ("x", math.nan), ("covariance", [0.0] * 4)])
def test_a_disc_that_cannot_be_is_refused(heard, field, value):
    disc = Disc(x=1.0, y=2.0, covariance=np.eye(2), radius_px=9.0, sharp=True)
    message = messages.stars_to_message(replace(stars(), disc=disc), "c")
    setattr(message.stars[-1], field, value)
    with pytest.raises(FrameError, match="disc"):
        message_to_stars(heard(message))


def test_a_shutter_that_cannot_be_is_refused(heard):
    message = messages.stars_to_message(replace(stars(), shutter=GLOBAL_SHUTTER), "c")
    message.readout = math.nan
    with pytest.raises(FrameError, match="readout"):
        message_to_stars(heard(message))


def test_no_stars_and_no_time_round_trip(heard):
    got = message_to_stars(heard(messages.stars_to_message(no_stars(10, 10), "c")))
    assert len(got) == 0 and got.mid_unix_s is None and got.exposure_s is None


@pytest.mark.parametrize(
    ("field", "value"), [("x", math.nan), ("flux", math.inf), ("covariance", [0.0] * 4), ("flux", 1e9)]
)
def test_bad_stars_are_refused(field, value, heard):
    message = messages.stars_to_message(stars(), "c")
    setattr(message.stars[-1], field, value)
    with pytest.raises(FrameError, match="stars"):
        message_to_stars(heard(message))


def test_empty_star_message_is_refused(heard):
    with pytest.raises(FrameError, match="width"):
        message_to_stars(heard(msg.StarArray()))


def test_tilt_round_trip_and_unknown_covariance(heard):
    tilt = Tilt(
        0.1, -0.2, np.array([[4e-9, 1e-9], [1e-9, 5e-9]]), utc_unix_s=MID, samples=1, temperature_c=21.5
    )
    message = messages.tilt_to_message(tilt, "s", 7, 8)
    assert (message.sequence, message.flags, message.header.frame_id) == (7, 8, "s")
    got = message_to_tilt(heard(message))
    assert (got.theta_x, got.theta_y, got.temperature_c) == (0.1, -0.2, 21.5)
    assert np.array_equal(got.covariance, tilt.covariance)
    message.temperature = 1e300
    assert math.isnan(message_to_tilt(heard(message)).temperature_c)
    message.covariance = [0.0] * 4
    assert np.array_equal(message_to_tilt(heard(message), 1e-4).covariance, np.eye(2) * 1e-8)


def leaning(**third):
    """A message of x, y at 40 and 30 deg."""
    x, y = math.radians(40), math.radians(30)
    message = messages.tilt_to_message(Tilt(x, y, np.eye(2) * 1e-9, utc_unix_s=MID), "s")
    for name, value in third.items():
        setattr(message, name, value)
    return message


THIRD = math.asin(math.sqrt(1 - math.sin(math.radians(40)) ** 2 - 0.25))


def test_a_third_axis_comes_and_goes(heard):
    tilt = message_to_tilt(heard(leaning(z=-THIRD, z_variance=4e-9)))
    assert (tilt.axes, tilt.theta_z, tilt.variance_z) == (3, -THIRD, 4e-9)
    again = messages.tilt_to_message(tilt, "s")
    assert (again.z, again.z_variance) == (-THIRD, 4e-9)
    for unknown in (0.0, math.nan):
        assert math.isnan(message_to_tilt(heard(leaning(z=-THIRD, z_variance=unknown))).variance_z)


def test_a_third_axis_that_nobody_filled_in_is_none(heard):
    """A publisher that knows of two axes leaves new fields at 0, which would be a third axis that lies level."""
    assert math.isnan(leaning().z)
    for message in (leaning(), leaning(z=0.0, z_variance=0.0), leaning(z=math.nan, z_variance=1e-9)):
        tilt = message_to_tilt(heard(message))
        assert tilt.axes == 2 and tilt.up[2] == pytest.approx(math.sin(THIRD))


@pytest.mark.parametrize(
    ("third", "words"),
    [
        ({"z": 0.0, "z_variance": 1e-9}, "cannot hold together"),
        ({"z": 0.9, "z_variance": 1e-9}, "cannot hold together"),
        ({"x": math.radians(50), "y": math.radians(38), "z": 0.0, "z_variance": 0.0}, "on its side"),
        ({"z": math.inf}, "not a finite number"),
        ({"z": THIRD, "z_variance": -1e-9}, "z_variance"),
        ({"z": THIRD, "z_variance": math.inf}, "z_variance"),
    ],
)
def test_a_third_axis_that_cannot_be_is_refused(third, words, heard):
    with pytest.raises(TiltError, match=words):
        message_to_tilt(heard(leaning(**third)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("x", math.nan),
        ("y", 1.6),
        ("covariance", [1.0, 0.0, 0.0, -1.0]),
        ("covariance", [1.0, 2.0, 2.0, 1.0]),
        ("covariance", [1.0, 0.5, 0.0, 1.0]),
        ("covariance", [math.nan, 0.0, 0.0, 1.0]),
        ("covariance", [1e-9, 0.0, 0.0, 1e300]),
    ],
)
def test_bad_tilts_are_refused(field, value, heard):
    message = messages.tilt_to_message(Tilt(0.0, 0.0, np.eye(2), utc_unix_s=MID), "s")
    setattr(message, field, value)
    with pytest.raises(TiltError):
        message_to_tilt(heard(message))


def test_tilt_without_a_stamp_is_refused(heard):
    message = messages.tilt_to_message(Tilt(0.0, 0.0, np.eye(2), utc_unix_s=MID), "s")
    message.header.stamp = Time()
    with pytest.raises(TiltError, match="stamp"):
        message_to_tilt(heard(message))


def test_camera_round_trip(heard):
    camera = Camera(
        width=5616,
        height=3744,
        fx=93750.0,
        fy=93751.0,
        cx=2807.5,
        cy=1871.5,
        distortion=(0.1, -0.2, 1e-4, 2e-4, 0.3),
    )
    assert message_to_camera(heard(messages.camera_to_message(camera, "c", MID))) == camera
    message = messages.camera_to_message(camera, "c")
    message.d = []
    assert message_to_camera(heard(message)).distortion == (0.0,) * 5


def test_a_fisheye_round_trip(heard):
    lens = (-0.04, 5e-4, 1e-5, -2e-6)
    camera = Camera(
        width=2000, height=1900, fx=600.0, fy=601.0, cx=1003.5, cy=950.5, distortion=lens, model="equidistant"
    )
    message = messages.camera_to_message(camera, "c", MID)
    assert message.distortion_model == "equidistant" and len(message.d) == 4
    assert message_to_camera(heard(message)) == camera


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"k": [math.nan] * 9}, "NaN"),
        ({"d": [math.inf] * 5}, "NaN"),
        ({"k": [-9.0, 0, 49.5, 0, 9.0, 39.5, 0, 0, 1]}, "positive"),
        ({"k": [9.0, 0.1, 5, 0, 9.0, 5, 0, 0, 1]}, "skew"),
        ({"distortion_model": "equidistant"}, "equidistant"),
        ({"distortion_model": "rational_polynomial", "d": [0.0] * 8 + [1e-3] * 4}, "12 terms"),
        ({"d": [0.0] * 6}, "6 terms"),
        ({"width": 0}, "size"),
    ],
)
def test_cameras_that_are_not_understood_are_refused(change, word, heard):
    message = messages.camera_to_message(Camera.from_focal(100, 80, 1000.0), "c")
    for name, value in change.items():
        setattr(message, name, [float(v) for v in value] if isinstance(value, list) else value)
    with pytest.raises(InstrumentError, match=word):
        message_to_camera(heard(message))
    with pytest.raises(InstrumentError, match="not calibrated"):
        message_to_camera(heard(CameraInfo()))


def pixels(kind, channels=1):
    shape = (6, 4) if channels == 1 else (6, 4, channels)
    return RNG.integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)


SENT = {
    "mono8": (np.uint8, 1, ""),
    "mono16": (np.uint16, 1, ""),
    "bgr8": (np.uint8, 3, ""),
    **{f"bayer_{p}8": (np.uint8, 1, p) for p in ("rggb", "bggr", "grbg", "gbrg")},
    **{f"bayer_{p}16": (np.uint16, 1, p) for p in ("rggb", "bggr", "grbg", "gbrg")},
}


@pytest.mark.parametrize("encoding", SENT)
def test_frames_round_trip_without_a_copy_on_arrival(encoding, heard):
    kind, channels, pattern = SENT[encoding]
    frame = Frame(pixels(kind, channels), pattern=pattern, mid_unix_s=MID, exposure_s=0.5)
    sent = messages.frame_to_message(frame, "c")
    assert sent.encoding == encoding and isinstance(sent.data, array.array)
    message = heard(sent)
    got = message_to_frame(message)
    assert np.array_equal(got.pixels, frame.pixels) and got.pixels.dtype == kind
    assert got.pattern == pattern
    assert got.mid_unix_s == pytest.approx(MID, abs=1e-6)
    assert np.shares_memory(got.pixels, np.frombuffer(message.data, np.uint8))


def test_frames_that_are_views_are_sent_whole(heard):
    frame = Frame(pixels(np.uint16)[::2, ::-1])
    assert np.array_equal(message_to_frame(heard(messages.frame_to_message(frame, "c"))).pixels, frame.pixels)


@pytest.mark.parametrize("padding", [0, 2, 3])
def test_padded_rows_and_the_other_byte_order(padding, heard):
    truth = pixels(np.uint16)
    rows = np.zeros((6, 8 + padding), np.uint8)
    rows[:, :8] = truth.astype(">u2").view(np.uint8)
    message = Image(width=4, height=6, step=8 + padding, encoding="mono16", is_bigendian=1)
    message.data = array.array("B", rows.tobytes())
    got = message_to_frame(heard(message)).pixels
    assert np.array_equal(got, truth) and got.dtype == np.uint16 and got.dtype.isnative


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"encoding": "32FC1"}, "32FC1"),
        ({"encoding": ""}, "encoding"),
        ({"width": 0}, "empty"),
        ({"height": 0}, "empty"),
        ({"height": 7}, "truncated"),
        ({"height": 2**32 - 1}, "truncated"),
        ({"width": 2**32 - 1}, "step"),
        ({"step": 7}, "step"),
        ({"step": 0}, "step"),
        ({"step": 2**32 - 1}, "truncated"),
        ({"data": array.array("B")}, "truncated"),
    ],
)
def test_images_that_do_not_fit_together_are_refused(change, word, heard):
    message = messages.frame_to_message(Frame(pixels(np.uint16)), "c")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(FrameError, match=word):
        message_to_frame(heard(message))


def test_the_flags_that_the_reader_knows_are_the_messages():
    for name in ("OUT_OF_RANGE", "STUCK", "SATURATED", "TIME_UNKNOWN"):
        assert getattr(tilts, name) == getattr(msg.Tilt, name)
