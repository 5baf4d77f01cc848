# SPDX-License-Identifier: Apache-2.0
"""A frame's trail by a gyro: as the stars move in the simulated sky; none where anything lacks."""

from dataclasses import replace

import numpy as np
import pytest
from imu_readings import reading
from scipy.spatial.transform import Rotation

from starpos.errors import InstrumentError, VoyageError
from starpos.frames.frame import Frame
from starpos.instrument.instrument import TOP_OF_FRAME
from starpos.session import gyro_readings
from starpos.session.gyro_readings import Trails

MID_S, EXPOSURE_S, FOCAL_PX = 1793642400.0, 0.02, 4636.0
FRAME = Frame(np.zeros((400, 500), np.uint8), mid_unix_s=MID_S, exposure_s=EXPOSURE_S)


@pytest.fixture
def told(monkeypatch):
    """Trails of a camera; CameraInfo is its test's own."""
    camera = type("Camera", (), {"fx": FOCAL_PX})
    monkeypatch.setattr(gyro_readings, "message_to_camera", lambda message, **_: camera)
    told = Trails("")
    told.receive_camera(None)
    return told


def turn(told, rate, begin_s=MID_S - 0.1, end_s=MID_S + 0.1):
    for t in np.arange(begin_s, end_s, 0.005):
        told.receive_imu(reading(t, rate))


@pytest.mark.parametrize(
    ("rate", "way"),
    [
        # x is the top of the frame, y its right: about x the axis goes to the left, and stars to the right
        ((0.1, 0.0, 0.0), (1, 0)),
        # about y it goes to the top, and stars down
        ((0.0, 0.1, 0.0), (0, 1)),
        ((-0.1, 0.1, 0.0), (-1, 1)),
        ((0.0, 0.0, 0.1), (0, 0)),
    ],
)
def test_stars_move_as_the_camera_turns(told, rate, way):
    turn(told, rate)
    trail = told.with_trail(FRAME).trail
    assert trail.middle_px == pytest.approx(np.multiply(way, 0.1 * EXPOSURE_S * FOCAL_PX), abs=0.02)


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.8), (0.05, -0.1, -0.6), (0.2, 0.1, 0.05)])
def test_each_star_moves_along_its_own_trail(told, rate):
    """Against directions that the body's turn carries into the camera's axes, projected at both ends of the exposure."""
    turn(told, rate)
    trail = told.with_trail(FRAME).trail
    link, size = np.array(TOP_OF_FRAME), np.array([1936, 1216])
    ends = [Rotation.from_rotvec(np.array(rate) * t).as_matrix() for t in (-EXPOSURE_S / 2, EXPOSURE_S / 2)]
    for at in ([967.5, 607.5], [300.0, 200.0], [1900.0, 100.0], [5.0, 1210.0]):
        away = np.array(at) - (size - 1) / 2
        seen = [link @ end.T @ link.T @ [*away, FOCAL_PX] for end in ends]
        begin, end = (FOCAL_PX * v[:2] / v[2] for v in seen)
        found = trail.at(*np.array(at)[:, None], *size)[0]
        # what a trail of the middle and a roll leave out: the tangent's share, 4 % in the corner
        assert found == pytest.approx(end - begin, abs=0.05 + 0.08 * np.hypot(*trail.middle_px))


@pytest.mark.parametrize("rate", [(90.0, 0.0, 0.0), (0.0, 0.0, 90.0), (9.0, 9.0, 0.0), (0.0, 78.54, 0.0)])
def test_a_frame_whose_stars_cross_it_is_as_it_is(told, rate):
    """No node may stumble over turns of 90 deg and more, or over stars that leave it."""
    turn(told, rate)
    assert told.with_trail(FRAME).trail is None


def test_where_anything_lacks_there_is_none(told):
    assert told.with_trail(FRAME).trail is None
    turn(told, (0.1, 0.0, 0.0), end_s=MID_S)
    assert told.with_trail(FRAME).trail is None
    turn(told, (0.1, 0.0, 0.0), begin_s=MID_S)
    assert told.with_trail(FRAME).trail is not None
    assert told.with_trail(replace(FRAME, exposure_s=None)).trail is None
    assert told.with_trail(replace(FRAME, mid_unix_s=None)).trail is None
    with pytest.raises(VoyageError, match="NaN"):
        told.receive_imu(reading(MID_S + 1.0, (np.nan, 0.0, 0.0)))
    unknown = Trails("")
    turn(unknown, (0.1, 0.0, 0.0))
    assert unknown.with_trail(FRAME).trail is None


@pytest.mark.parametrize(("largest", "is_known"), [(2.0, False), (9.0, True)])
def test_clipped_readings_give_no_trail(told, largest, is_known):
    for t in np.arange(-0.5, 0.5, 0.01):
        told.receive_imu(reading(MID_S + t, (0.0, 0.0, np.clip(5.0 * np.cos(8.0 * t), -largest, largest))))
    assert (told.with_trail(FRAME).trail is not None) == is_known


def test_a_reading_without_rates_or_time_is_refused(told):
    with pytest.raises(VoyageError, match="measures no rates"):
        told.receive_imu(reading(MID_S, (0.0, 0.0, 0.0), measured=False))
    with pytest.raises(VoyageError, match="no time stamp"):
        told.receive_imu(reading(0.0, (0.0, 0.0, 0.0)))


def test_a_clock_that_is_set_back_begins_anew(told):
    told.receive_imu(reading(MID_S + 3600.0, (0.1, 0.0, 0.0)))
    turn(told, (0.1, 0.0, 0.0))
    assert told.with_trail(FRAME).trail is not None


def test_a_broken_instrument_file_is_told(tmp_path):
    with pytest.raises(InstrumentError):
        Trails(f"{tmp_path / 'none.yaml'}")
