# SPDX-License-Identifier: Apache-2.0
"""What is kept for a calibration: bounded whatever comes, one entry a pose, and a bad tilt in it does no harm."""

import numpy as np
import pytest
from fixes import NOISE, T0, fix_at, seen_at, tilt_at

from starpos.errors import TiltError
from starpos.session.calibrating import MAX_POSES, MAX_TILTS, PoseMemory, arguments_of, mean_tilt


def poses_of(*frames) -> PoseMemory:
    """Frames of (seconds, azimuth)."""
    poses = PoseMemory()
    for seconds, azimuth in frames:
        poses.keep(seen_at(seconds), fix_at(seconds, azimuth))
    return poses


def test_a_camera_that_stands_still_is_one_pose_with_its_last_stars_and_mean_tilt():
    poses = poses_of(*((10.0 * k, 40.0) for k in range(5)), (50.0, 130.0), (60.0, 40.0))
    # Back at a heading is another pose: the instrument was touched.
    first, second, third = poses.frames()
    assert [s.stars.mid_unix_s - T0 for s in (first, second, third)] == [40.0, 50.0, 60.0]
    np.testing.assert_allclose(first.tilt.covariance, np.eye(2) * NOISE**2 / 25, rtol=1e-6)
    assert first.tilt.samples == 25
    assert first.tilt.utc_unix_s == T0 + 20


def test_many_frames_of_one_pose_and_many_poses_stay_bounded():
    poses = poses_of(*((k, 40.0) for k in range(3000)))
    assert len(poses) == 1 and poses.frames()[0].tilt.samples == 5 * MAX_TILTS
    poses = poses_of(*((k, k) for k in range(5000)))
    assert len(poses) == MAX_POSES == len(poses.frames())
    assert poses.frames()[-1].stars.mid_unix_s == T0 + 4999


def test_it_is_worth_a_look_at_a_new_pose_and_each_time_its_frames_have_doubled():
    poses = PoseMemory()
    worth = [poses.keep(seen_at(k), fix_at(k)) for k in range(20)]
    assert [k + 1 for k, w in enumerate(worth) if w] == [1, 2, 4, 8, 16]
    assert poses.keep(seen_at(20), fix_at(20, 90.0))


def test_one_bad_tilt_does_not_move_a_pose():
    tilts = [tilt_at(k, x_deg=1.0 + 1e-4 * k) for k in range(5)] + [tilt_at(5, x_deg=1.5)]
    assert np.degrees(mean_tilt(tilts).theta_x) == pytest.approx(1.0002, abs=1e-6)


def test_two_tilts_that_contradict_each_other_make_no_pose():
    with pytest.raises(TiltError):
        mean_tilt([tilt_at(0), tilt_at(1, x_deg=1.5)])
    poses = poses_of((0.0, 90.0), (10.0, 40.0))
    poses.keep(seen_at(20.0, x_deg=1.5), fix_at(20.0))
    assert len(poses) == 2 and [s.stars.mid_unix_s - T0 for s in poses.frames()] == [0.0]


def test_poses_of_before_a_move_are_forgotten():
    poses = poses_of((0.0, 10.0), (10.0, 60.0), (20.0, 110.0))
    poses.forget_before(T0 + 10.0)
    assert [s.stars.mid_unix_s - T0 for s in poses.frames()] == [10.0, 20.0]
    poses.clear()
    assert len(poses) == 0 and poses.frames() == []


def test_each_frame_gets_its_own_tilt():
    frames = [seen_at(0.0, x_deg=1.0), seen_at(10.0, x_deg=2.0)]
    tilts = arguments_of(frames)["tilts"]
    assert [np.degrees(tilts.average(f.stars.mid_unix_s, 0.5).theta_x) for f in frames] == pytest.approx(
        [1.0, 2.0]
    )
