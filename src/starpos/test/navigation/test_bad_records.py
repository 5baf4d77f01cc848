# SPDX-License-Identifier: Apache-2.0
"""Records with faults: each is reported in a sentence, and the claim holds or there is no answer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from voyage_calls import navigated, nees, sigma_m

from starpos.errors import VoyageError
from starpos.fix.attitude import ITRS
from starpos.navigation.records import ImuLog, in_order
from starpos_testing.voyages import made


@pytest.fixture(scope="module")
def record():
    return made("rover", 100, 11, rate_hz=50)


def with_imu(record, gyro=None, force=None, keep=slice(None), shift_s=0.0):
    imu = record.imu
    gyro, force = imu.gyro if gyro is None else gyro, imu.force if force is None else force
    return replace(record, imu=ImuLog.of(imu.utc_unix_s[keep] + shift_s, gyro[keep], force[keep]))


def with_velocity(record, change):
    log = record.velocity
    return replace(
        record,
        velocity=replace(log, velocity=change(log.utc_unix_s - log.utc_unix_s[0], log.velocity.copy())),
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda r: with_imu(r, force=r.imu.force / 9.80665), "in g: give m/s2"),
        (lambda r: with_imu(r, force=r.imu.force * [1, 1, 0]), "no axis is missing"),
        (lambda r: with_imu(r, force=r.imu.force - [0, 0, 9.8]), "gravity is not taken off"),
        (lambda r: with_imu(r, force=r.imu.force[:, [2, 1, 0]]), "accelerometer's axes"),
        (lambda r: with_imu(r, force=-r.imu.force), "accelerometer's axes"),
        (lambda r: with_imu(r, gyro=np.degrees(r.imu.gyro)), "in deg/s: give rad/s"),
        (
            lambda r: with_imu(r, gyro=r.imu.gyro[:, [1, 0, 2]] * [1, -1, 1]),
            "its x, y, z seem to be -y, .x, .z of the file",
        ),
        (lambda r: with_imu(r, shift_s=500.0), "clocks of camera and IMU agree"),
        (lambda r: with_imu(r, shift_s=15.0), "clocks of camera and IMU agree"),
    ],
)
def test_what_no_place_can_come_from_is_refused(record, change, said):
    with pytest.raises(VoyageError, match=said):
        navigated(change(record))


def test_a_gyro_in_degrees_is_named_where_nothing_turns():
    still = made("parked", 20, 3, rate_hz=50)
    with pytest.raises(VoyageError, match=r"gyro.* as if it was in deg/s: give rad/s"):
        navigated(with_imu(still, gyro=np.degrees(still.imu.gyro)), "parked")
    # with hardly any bias only the noise shows it
    unbiased = still.imu.gyro - still.imu.gyro.mean(0)
    with pytest.raises(VoyageError, match=r"scatters by [0-9]+ times the noise of its model"):
        navigated(with_imu(still, gyro=np.degrees(unbiased)), "parked")
    assert nees(navigated(still, "parked"), still) < 16


def test_a_gap_widens_the_claim(record):
    t = record.imu.utc_unix_s - record.imu.utc_unix_s[0]
    whole, gap = navigated(record), navigated(with_imu(record, keep=(t < 40) | (t > 46)))
    assert "1 gaps" in gap.faults[0]
    assert nees(gap, record) < 16 and sigma_m(gap) > 1.1 * sigma_m(whole)


def test_saturated_readings_are_left_out(record):
    force = record.imu.force.copy()
    for shock in (1000, 2000, 3000):
        force[shock : shock + 10, 0] = 19.6
    clipped = with_imu(record, force=force)
    assert any("saturated" in fault for fault in clipped.imu.faults)
    assert nees(navigated(clipped), record) < 16


def test_a_wheel_that_slips_is_left_out(record):
    def slip(t, velocity):
        velocity[(t > 50) & (t < 56), 0] += 0.6
        return velocity

    slipped = navigated(with_velocity(record, slip))
    assert nees(slipped, record) < 16
    assert 50 < slipped.left_out["velocities"] < 70 and "velocities contradict the rest" in slipped.faults[0]


def test_single_wild_velocities_are_left_out_and_their_neighbours_stay(record):
    def wild(t, velocity):
        velocity[100::50, 1] += 5.0
        return velocity

    number = len(range(100, len(record.velocity.velocity), 50))
    voyage = navigated(with_velocity(record, wild))
    assert nees(voyage, record) < 16 and voyage.left_out["velocities"] == number


def test_a_log_that_is_worse_on_one_axis_loses_few_velocities(record, rng):
    """A wheel that measures the way ahead worse than stated, and that it neither slides nor jumps far better."""
    noisy = navigated(with_velocity(record, lambda t, v: v + rng.normal(0, 1, v.shape) * [0.2, 0.0, 0.0]))
    assert nees(noisy, record) < 16
    assert noisy.left_out["velocities"] < 0.05 * len(record.velocity.velocity)


def test_velocities_worse_than_stated_widen_the_claim(record, rng):
    poor = navigated(with_velocity(record, lambda t, v: v + rng.normal(0, 0.2, v.shape)))
    assert nees(poor, record) < 16 and sigma_m(poor) > 1.2 * sigma_m(navigated(record))
    assert poor.excess["velocities"] > 10 and "the velocities scatter" in poor.faults[0]


def test_an_accelerometer_noisier_than_stated_widens_the_claim(record, rng):
    noisy = navigated(with_imu(record, force=record.imu.force + rng.normal(0, 0.02, record.imu.force.shape)))
    assert noisy.excess["forces"] > 10
    assert nees(noisy, record) < 16 and sigma_m(noisy) > 1.5 * sigma_m(navigated(record))


@pytest.mark.parametrize(("degrees", "wrong"), [(2.5, (30,)), (90, (20, 50, 80)), (170, (0, 99))])
def test_frames_identified_wrongly_are_left_out(record, degrees, wrong):
    frames, turn = (
        list(record.frames),
        Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix(),
    )
    for k in wrong:
        frames[k] = replace(frames[k], camera=frames[k].camera.then(turn, ITRS))
    voyage = navigated(replace(record, frames=frames))
    assert voyage.left_out["frames"] == len(wrong) and nees(voyage, record) < 16


def test_a_late_camera_is_found(record):
    """Stamps of the IMU that are 4 ms early: the lag is estimated, so that turns do not spoil the place."""
    late = navigated(with_imu(record, shift_s=-0.004))
    assert nees(late, record) < 16
    assert late.motion.lag_s == pytest.approx(-0.004, abs=0.002)


def test_rows_that_cannot_be_used_are_told():
    t = np.array([1e9, 1e9 + 1, 1e9 + 1, 1e9 + 2, 1e9 + 0.5, 1e9 + 3, np.nan])
    values = np.arange(14.0).reshape(7, 2)
    values[3, 1] = np.inf
    kept, _, faults = in_order(t, values, "imu.csv")
    assert (kept - 1e9).tolist() == [0, 1, 3]
    assert len(faults) == 2 and "2 rows are without a finite number" in faults[0]
    assert "2 rows are not later than all before" in faults[1]


def test_a_current_that_is_stated_widens_the_claim():
    """A ship's log through water that flows at 0.5 m/s to the east."""
    record = made("ship", 120, 5, rate_hz=25, cadence_s=2.0)
    east = np.array([-np.sin(record.longitude[0]), np.cos(record.longitude[0]), 0.0])
    nearest = np.abs(record.velocity.utc_unix_s[:, None] - record.frames_s).argmin(1)
    carried = with_velocity(
        record, lambda t, v: v - 0.5 * np.einsum("kij,i->kj", record.body_to_itrs[nearest], east)
    )
    stated = navigated(carried, "ship", drift_stddev=0.5)
    assert nees(stated, record) < 16 and sigma_m(stated) > 1.3 * sigma_m(navigated(record, "ship"))
    assert np.linalg.norm(stated.fixes[-1].velocity) == pytest.approx(5.0, abs=1.5)
