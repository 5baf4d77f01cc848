# SPDX-License-Identifier: Apache-2.0
"""Messages become values, or are refused with what is wrong: each field is spoilt by itself."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import FrameError, InstrumentError, StarposError, TiltError
from starpos.gnss.receiver import message_to_gnss
from starpos.messages.camera import leaves_size_open, message_to_camera
from starpos.messages.stamp import PlainHeader, PlainStamp, stamp_to_unix
from starpos.messages.stars import (
    MAX_STARS,
    MAX_TRAILS,
    message_to_attitude,
    message_to_stars,
    message_to_trails,
)
from starpos.messages.tilt import Reading, message_to_tilt

HEADER = PlainHeader(PlainStamp(1_793_642_400, 250_000_000), "frame")
UNSTAMPED = PlainHeader(PlainStamp(0, 0), "frame")
TRAIL = SimpleNamespace(ends=[1.0, 2.0, 30.0, 40.0], covariance=np.eye(4).ravel() * 0.1, snr=9.0, flags=5)
THIRD = math.asin(math.sqrt(1 - math.sin(0.1) ** 2 - math.sin(0.2) ** 2))
STAR = SimpleNamespace(x=3.0, y=4.0, flux=100.0, snr=20.0, covariance=[0.01, 0.0, 0.0, 0.02], flags=1)
TURN = SimpleNamespace(x=0.0, y=0.0, z=math.sin(0.1), w=math.cos(0.1))
ROI = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
WHOLE = {
    "stars": {"header": HEADER, "width": 10, "height": 8, "stars": [STAR], "exposure": 2.0, "stamp_stddev": 0.01},
    "attitude": {"header": HEADER, "orientation": TURN, "covariance": np.eye(3).ravel() * 1e-10, "stamp_stddev": 0.01,
                 "clock_stddev": 0.02, "stars_matched": 9, "log_odds": 80.0},
    "tilt": {"header": HEADER, "x": 0.1, "y": -0.2, "covariance": [1e-9, 0.0, 0.0, 2e-9], "temperature": 12.0,
             "z": math.nan, "z_variance": math.nan, "flags": 0},
    "camera": {"header": HEADER, "k": [100.0, 0, 4.5, 0, 100.0, 3.5, 0, 0, 1], "d": [], "distortion_model": "",
               "width": 10, "height": 8, "roi": ROI, "binning_x": 0, "binning_y": 0},
    "trails": {"header": HEADER, "trails": [TRAIL]},
    "gnss": {"header": HEADER, "status": SimpleNamespace(status=0), "latitude": 47.0, "longitude": 8.0,
             "position_covariance": np.diag([4.0, 9.0, 25.0]).ravel(), "position_covariance_type": 2},
}  # fmt: skip
# tilts whose third axis is filled in, or left at 0
WHOLE["three axes"] = WHOLE["tilt"] | {"z": THIRD, "z_variance": 1e-9}
WHOLE["third axis left at 0"] = WHOLE["tilt"] | {"z": 0.0, "z_variance": 0.0}
READERS = {
    "stars": message_to_stars,
    "attitude": message_to_attitude,
    "tilt": message_to_tilt,
    "camera": message_to_camera,
    "trails": message_to_trails,
    "gnss": message_to_gnss,
    "three axes": message_to_tilt,
    "third axis left at 0": message_to_tilt,
}


def read(kind, **changed):
    return READERS[kind](SimpleNamespace(**(WHOLE[kind] | changed)))


def star(**changed):
    return SimpleNamespace(**(vars(STAR) | changed))


@pytest.mark.parametrize(
    ("kind", "changed", "error", "said"),
    [
        ("stars", {"width": 0}, FrameError, "width"),
        ("stars", {"stars": [STAR] * (MAX_STARS + 1)}, FrameError, "brightest"),
        ("stars", {"stars": [star(x=math.nan)]}, StarposError, "stars"),
        ("stars", {"stars": [star(covariance=[-1.0, 0, 0, 1.0])]}, StarposError, "covariance"),
        ("stars", {"exposure": -1.0}, StarposError, "exposure"),
        ("stars", {"shutter_known": True, "readout": 99.0, "readout_stddev": 0.0}, StarposError, "readout"),
        ("attitude", {"header": UNSTAMPED}, FrameError, "time stamp"),
        ("attitude", {"orientation": SimpleNamespace(x=0, y=0, z=0, w=0)}, FrameError, "length 1"),
        ("attitude", {"orientation": SimpleNamespace(x=math.nan, y=0, z=0, w=1)}, FrameError, "length 1"),
        ("attitude", {"covariance": [math.inf] * 9}, FrameError, "finite"),
        ("attitude", {"covariance": np.zeros(9)}, FrameError, "positive"),
        ("attitude", {"covariance": np.eye(3).ravel()}, FrameError, "0.01 rad2"),
        ("attitude", {"clock_stddev": -1.0}, FrameError, "at least 0"),
        ("tilt", {"header": UNSTAMPED}, TiltError, "time stamp"),
        ("tilt", {"x": math.nan}, TiltError, "tilt"),
        ("tilt", {"x": 1.2, "y": 1.2}, TiltError, "tilt"),
        ("tilt", {"covariance": [1e-9, 5e-9, 5e-9, 1e-9]}, TiltError, "positive"),
        ("tilt", {"covariance": [2.0, 0, 0, 2.0]}, TiltError, "beyond 1 rad2"),
        ("tilt", {"x": math.inf, "z": 0.0, "z_variance": 0.0}, TiltError, "finite"),
        ("tilt", {"x": 1.3, "z": 0.0, "z_variance": 0.0}, TiltError, "on its side"),
        ("trails", {"trails": [TRAIL] * (MAX_TRAILS + 1)}, FrameError, "brightest"),
        ("trails", {"trails": [SimpleNamespace(**(vars(TRAIL) | {"ends": [1.0, 2.0, 1.0, 2.0]}))]}, FrameError, "ends"),
        ("trails", {"trails": [SimpleNamespace(**(vars(TRAIL) | {"snr": math.nan}))]}, FrameError, "SNR"),
        ("tilt", {"z": math.inf}, TiltError, "finite"),
        ("tilt", {"z": 0.9, "z_variance": -1.0}, TiltError, "z_variance"),
        ("camera", {"k": [0.0] * 9}, InstrumentError, "not calibrated"),
        ("camera", {"k": [math.nan] * 9}, InstrumentError, "NaN"),
        ("camera", {"k": [100.0, 5.0, 4.5, 0, 100.0, 3.5, 0, 0, 1]}, InstrumentError, "skew"),
        ("camera", {"roi": SimpleNamespace(x_offset=8, y_offset=0, width=9, height=0)}, InstrumentError, "region"),
        ("camera", {"distortion_model": "fancy"}, InstrumentError, "fancy"),
    ],
)  # fmt: skip
def test_what_cannot_be_right_is_refused_by_name(kind, changed, error, said):
    read(kind)
    with pytest.raises(error, match=said):
        read(kind, **changed)


# numbers that are whole in their messages; numbers that may be NaN or infinity, where they are unknown
COUNTED = {"sec", "nanosec", "flags", "width", "height", "x_offset", "y_offset", "binning_x", "binning_y", "status",
           "stars_matched", "position_covariance_type"}  # fmt: skip
UNCHECKED = {"temperature", "z", "z_variance", "log_odds", "position_covariance"}


def numbers_in(message, *path):
    """The way to each number of a message: names of fields, and positions in lists."""
    if isinstance(message, (int, float, np.number)):
        yield path
    elif isinstance(message, dict):
        for name, value in message.items():
            yield from numbers_in(value, *path, name)
    elif isinstance(message, (list, np.ndarray)):
        for k, value in enumerate(message):
            yield from numbers_in(value, *path, k)
    elif not isinstance(message, str):
        yield from numbers_in(vars(message), *path)


def spoilt(message, path, value):
    """The message with another number there."""
    if not path:
        return value
    first, *rest = path
    if isinstance(message, dict):
        return message | {first: spoilt(message[first], rest, value)}
    if isinstance(message, (list, np.ndarray)):
        return [spoilt(v, rest, value) if k == first else v for k, v in enumerate(message)]
    return SimpleNamespace(**spoilt(vars(message), path, value))


@pytest.mark.parametrize("kind", WHOLE)
def test_any_number_that_is_spoilt_gives_a_value_without_nan_or_an_error_of_one_sentence(kind):
    """A driver may send anything: what is read is never an exception of another kind, which would end a node."""
    read(kind)
    for path in numbers_in(WHOLE[kind]):
        counted = path[-1] in COUNTED
        for value in (0, 1, 255) if counted else (math.nan, math.inf, -math.inf, -1.0, 0.0, 1.0, 100.0):
            try:
                found = READERS[kind](SimpleNamespace(**spoilt(WHOLE[kind], path, value)))
            except StarposError as error:
                assert str(error) and "\n" not in str(error)
                continue
            assert found is not None and (math.isfinite(value) or UNCHECKED & set(path)), path


def test_the_first_releases_messages_of_stars_and_tilts_are_read():
    """They lack the clock's error, the shutter and the third axis."""
    stars = read("stars")
    assert (stars.clock_stddev_s, stars.shutter, stars.mid_unix_s) == (0.0, None, 1_793_642_400.25)
    old = {k: v for k, v in WHOLE["tilt"].items() if not k.startswith("z")}
    assert message_to_tilt(SimpleNamespace(**old)).axes == 2


def test_an_unknown_covariance_of_a_tilt_is_the_callers():
    tilt = message_to_tilt(SimpleNamespace(**WHOLE["tilt"] | {"covariance": [0.0] * 4}), 1e-3)
    assert np.array_equal(tilt.covariance, np.eye(2) * 1e-6)
    assert math.isnan(read("tilt", temperature=400.0).temperature_c)


def test_a_reading_is_a_tilt_as_its_message_is():
    reading = Reading(
        stamp_ns=1_793_642_400_250_000_000, x=0.1, y=-0.2, covariance=(1e-9, 0.0, 0.0, 2e-9), temperature_c=12.0,
        sequence=7, flags=0, frame_id="frame",
    )  # fmt: skip
    assert reading.header == HEADER
    tilt, sent = message_to_tilt(reading), read("tilt")
    assert (tilt.theta_x, tilt.theta_y, tilt.utc_unix_s) == (sent.theta_x, sent.theta_y, sent.utc_unix_s)
    assert (
        np.array_equal(tilt.covariance, sent.covariance) and tilt.temperature_c == sent.temperature_c == 12.0
    )


@pytest.mark.parametrize(("binning", "offset", "cx"), [(0, 0, 4.5), (1, 2, 2.5), (2, 0, 2.0), (2, 2, 1.0)])
def test_the_principal_point_follows_region_and_binning(binning, offset, cx):
    roi = SimpleNamespace(x_offset=offset, y_offset=0, width=8, height=0)
    camera = read("camera", roi=roi, binning_x=binning, binning_y=binning)
    assert camera.cx == cx and camera.fx == 100.0 / max(binning, 1) and camera.width == 8 // max(binning, 1)


@pytest.mark.parametrize(("size", "left_open"), [((10, 8), False), ((0, 8), True), ((0, 0), True)])
def test_a_size_that_is_left_open_is_seen(size, left_open):
    message = SimpleNamespace(**WHOLE["camera"] | dict(zip(("width", "height"), size, strict=True)))
    assert leaves_size_open(message) == left_open
    if left_open:
        camera = message_to_camera(message, size=(20, 16))
        assert (camera.width, camera.height) == (20, 16)


@pytest.mark.parametrize("unix_ns", [1, 1_793_642_400_250_000_000])
def test_a_stamp_is_its_time(unix_ns):
    assert stamp_to_unix(PlainStamp.of_ns(unix_ns)) == pytest.approx(unix_ns * 1e-9)
    assert stamp_to_unix(PlainStamp(0, 0)) is None
