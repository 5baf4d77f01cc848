# SPDX-License-Identifier: Apache-2.0
"""Accelerations to tilts: averages, their covariance, and everything an IMU may send that gives no tilt."""

import math
import signal
import time

import numpy as np
import pytest
from sensor_msgs.msg import Imu

from starpos.errors import TiltError
from starpos.messages.tilt import ForceAverager, MeanForce, acceleration_of
from starpos_interfaces.msg import Tilt
from starpos_testing.nodes import Listener, Process, take_domain

G = 9.80665
PERIOD_NS = 10_000_000
BEGIN_NS = 1_700_000_000_000_000_000


def up(x_deg, y_deg):
    """Unit vector up in an IMU of this tilt."""
    x, y = math.sin(math.radians(x_deg)), math.sin(math.radians(y_deg))
    return np.array([x, y, math.sqrt(1 - x * x - y * y)])


def message(force, stamp_ns=BEGIN_NS, rotation=(0.0, 0.0, 0.0), variance=0.0):
    imu = Imu()
    imu.header.stamp.sec, imu.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    a, w = imu.linear_acceleration, imu.angular_velocity
    a.x, a.y, a.z = map(float, force)
    w.x, w.y, w.z = map(float, rotation)
    imu.linear_acceleration_covariance = np.diag([variance] * 3).ravel()
    return imu


def average(forces, **options):
    return MeanForce.of(
        [acceleration_of(message(f, BEGIN_NS + k * PERIOD_NS, **options)) for k, f in enumerate(forces)]
    )


@pytest.mark.parametrize("tilt", [(0, 0), (3, -11), (-29, 20), (50, -35)])
def test_tilt_is_the_direction_of_the_specific_force(tilt):
    """Whatever its length: an accelerometer's scale does not matter."""
    got = average(np.tile(1.02 * G * up(*tilt), (10, 1)))
    assert np.degrees(got.tilt())[:2] == pytest.approx(tilt, abs=1e-9)
    assert np.linalg.norm(np.sin(got.tilt())) == pytest.approx(1)
    hanging = average(np.tile(G * up(*tilt) * [1, 1, -1], (10, 1)))
    assert hanging.tilt() == pytest.approx(np.array(got.tilt()) * [1, 1, -1])
    assert got.mid_ns == BEGIN_NS + 45_000_000
    assert got.unrest(0.05, 0.1) == ""


def test_a_placeholder_variance_shows_as_many_times_the_scatter():
    forces = G * up(0, 0) + np.random.default_rng(1).normal(0, 0.007, (50, 3))
    assert average(forces, variance=0.017).excess == pytest.approx(math.sqrt(0.017) / 0.007, rel=0.4)
    assert average(forces, variance=0.007**2).excess < 2
    assert average(np.tile(G * up(1, 2), (10, 1)), variance=0.017).excess == 0


@pytest.mark.parametrize("tilt", [(20, -20), (45, -40)])
def test_covariance_is_that_of_the_averages(tilt):
    rng = np.random.default_rng(1)
    averages = [average(G * up(*tilt) + rng.normal(0, [0.02, 0.05, 0.1], (50, 3))) for _ in range(400)]
    scatter = np.cov(np.array([a.tilt() for a in averages]), rowvar=False)
    claimed = np.mean([a.covariance() for a in averages], axis=0)
    assert claimed == pytest.approx(scatter, rel=0.2, abs=0.1 * np.sqrt(np.prod(np.diag(scatter))))


@pytest.mark.parametrize("lean_deg", [0.2, 1.5])
def test_the_vertical_axis_of_a_level_imu_errs_as_the_level_does(lean_deg):
    rng = np.random.default_rng(5)
    averages = [average(G * up(lean_deg, 0) + rng.normal(0, 0.01, (25, 3))) for _ in range(300)]
    scatter = np.std([a.tilt()[2] for a in averages])
    claimed = np.sqrt(np.mean([a.covariance()[2, 2] for a in averages]))
    assert claimed == pytest.approx(scatter, rel=0.15)


def test_stated_noise_counts_where_it_is_more_and_minus_one_is_none():
    rng = np.random.default_rng(1)
    forces = G * up(0, 0) + rng.normal(0, 0.02, (50, 3))
    plain = np.sqrt(np.diag(average(forces).covariance()))[:2]
    assert plain == pytest.approx([0.02 / G / math.sqrt(50)] * 2, rel=0.3)
    more = np.sqrt(np.diag(average(forces, variance=0.1**2).covariance()))[:2]
    assert more == pytest.approx([0.1 / G / math.sqrt(50)] * 2, rel=0.01)
    assert np.diag(average(forces, variance=0.001**2).covariance())[:2] == pytest.approx(plain**2)
    none = message(forces[0])
    none.linear_acceleration_covariance[0] = -1.0
    assert acceleration_of(none).variance == (0.0, 0.0, 0.0)
    still = average(np.tile(G * up(1, 2), (10, 1)), variance=0.1**2).covariance()
    assert np.sqrt(np.diag(still))[:2] == pytest.approx([0.1 / G / math.sqrt(10)] * 2, rel=0.01)
    assert np.linalg.eigvalsh(average(np.tile(G * up(1, 2), (10, 1))).covariance()).min() > 0


def test_not_at_rest():
    forces = np.tile(G * up(0, 0), (10, 1))
    assert "m/s2" in average(forces * 1.06).unrest(0.05, 0.1)
    assert "m/s2" in average(forces * 0.0).unrest(0.05, 0.1)
    assert "deg/s" in average(forces, rotation=(0.0, 0.08, 0.08)).unrest(0.05, 0.1)
    no_gyroscope = message(forces[0], rotation=(9.0, 9.0, 9.0))
    no_gyroscope.angular_velocity_covariance[0] = -1.0
    assert acceleration_of(no_gyroscope).rotation == 0.0


@pytest.mark.parametrize(
    "bad",
    [
        message((math.nan, 0, G)),
        message((0, math.inf, G)),
        message((0, 0, G), rotation=(math.nan, 0, 0)),
        message((0, 0, G), variance=math.nan),
        message((0, 0, G), stamp_ns=0),
        message((0, 0, G), stamp_ns=-5_000_000_000),
    ],
)
def test_messages_that_are_none(bad):
    with pytest.raises(TiltError):
        acceleration_of(bad)


def averaged(averager, stamps_ns):
    got = [averager.include(acceleration_of(message((0, 0, G), BEGIN_NS + s))) for s in stamps_ns]
    return [a for a in got if a]


def test_doubled_and_disordered_messages_are_left_out():
    averager = ForceAverager(0.1)
    stamps = [k * PERIOD_NS for k in range(11)]
    disturbed = [*stamps[:4], stamps[3], stamps[2], *stamps[4:]]
    (got,) = averaged(averager, disturbed)
    assert len(got.forces) == 10 and got.mid_ns == BEGIN_NS + 45_000_000
    assert (averager.duplicates, averager.disordered, averager.breaks) == (1, 1, 0)


def test_gaps_and_a_clock_that_was_set_break_the_sequence():
    averager = ForceAverager(0.1)
    averaged(averager, [k * PERIOD_NS for k in range(12)])
    assert averager.breaks == 0
    assert len(averaged(averager, [5 * 10**9 + k * PERIOD_NS for k in range(12)])) == 1
    # The silence, and what had begun before it.
    assert averager.breaks == 2
    assert len(averaged(averager, [k * PERIOD_NS for k in range(12)])) == 1
    assert averager.breaks == 3 and averager.disordered == 0
    # Too few for a scatter.
    assert averaged(averager, [10 * 10**9 + k * 90_000_000 for k in range(5)]) == []


@pytest.fixture(scope="module", autouse=True)
def domain():
    take_domain()


@pytest.fixture
def listener():
    listener = Listener()
    yield listener
    listener.close()


class Imitation:
    """Publishes an IMU's messages as fast as they are asked for, their stamps 10 ms apart up to now."""

    def __init__(self, listener, topic):
        self._publisher = listener.node.create_publisher(Imu, topic, 100)
        self._rng = np.random.default_rng(1)
        self._stamp_ns = time.time_ns() - 200_000_000_000
        listener.wait(lambda: self._publisher.get_subscription_count() == 1)

    def skip(self, seconds):
        """Say nothing for a while."""
        self._stamp_ns += seconds * 10**9

    def send(self, n, tilt=(3.0, -11.0), noise=0.01, scale=1.0, ahead_ns=0, **options):
        for _ in range(n):
            self._stamp_ns += PERIOD_NS
            force = scale * G * up(*tilt) + self._rng.normal(0, noise, 3)
            self._publisher.publish(message(force, self._stamp_ns + ahead_ns, **options))


def test_the_node_reads_an_imu(listener):
    tilts = listener.hear(Tilt, "tilt", 100)
    node = Process(
        "starpos_inclinometer.main", "inclinometer", ["source:=imu", "imu.average:=0.1", "frame_id:=imu_link"]
    )
    state = "inclinometer: Link"
    try:
        listener.wait_for_state(state, 2, "nothing comes on /imu/data")
        imu = Imitation(listener, "imu/data")

        def send_until(condition, **options):
            def met():
                imu.send(5, **options)
                return condition()

            listener.wait(met)

        send_until(lambda: len(tilts) >= 50)
        got = np.degrees([(t.x, t.y) for t in tilts])
        assert got.mean(0) == pytest.approx([3, -11], abs=0.005)
        sigma = np.degrees(np.sqrt([t.covariance[::3] for t in tilts]).mean())
        assert sigma == pytest.approx(math.degrees(0.01 / G / math.sqrt(10)), rel=0.3)
        assert {t.flags for t in tilts} == {0} and {t.header.frame_id for t in tilts} == {"imu_link"}
        assert np.diff([t.sequence for t in tilts]).tolist() == [1] * (len(tilts) - 1)
        stamps = [t.header.stamp.sec + t.header.stamp.nanosec * 1e-9 for t in tilts]
        assert np.diff(stamps) == pytest.approx(np.full(len(stamps) - 1, 0.1), abs=1e-6)

        def moving():
            return listener.states.get(state) and "not at rest" in listener.states[state].message

        send_until(moving, scale=1.2)
        n = len(tilts)
        send_until(lambda: len(tilts) >= n + 2)
        assert tilts[n].flags == Tilt.GAP and tilts[n + 1].flags == 0
        assert tilts[n].sequence > tilts[n - 1].sequence + 1

        imu.skip(5)
        n = len(tilts)
        send_until(lambda: len(tilts) >= n + 4 and any(t.flags for t in tilts[n:]))
        assert [t.flags for t in tilts[n:] if t.flags] == [Tilt.GAP]
        assert listener.set("inclinometer", noise_stddev=0.1).successful
        send_until(lambda: math.degrees(math.sqrt(tilts[-1].covariance[3])) == pytest.approx(0.1))
        send_until(lambda: math.degrees(tilts[-1].y) == pytest.approx(60, abs=1), tilt=(3.0, 60.0))
        assert not tilts[-1].flags & Tilt.OUT_OF_RANGE and math.degrees(tilts[-1].z) == pytest.approx(
            29.8, abs=1
        )
        send_until(lambda: tilts[-1].flags == Tilt.STUCK, noise=0.0)
        # Upside down.
        send_until(lambda: not tilts[-1].flags & Tilt.OUT_OF_RANGE and tilts[-1].z < 0, scale=-1.0)
        assert tilts[-1].z_variance > 0

        def unusable():
            return listener.states.get(state) and "no usable messages" in listener.states[state].message

        send_until(unusable, ahead_ns=3600 * 10**9)
        assert tilts[-1].header.stamp.sec < time.time() + 60
        values = {v.key: v.value for v in listener.states[state].values}
        assert int(values["messages from the future"]) > 0
        status, out = node.end(signal.SIGTERM)
        assert status == 0 and "Traceback" not in out
    finally:
        node.kill()
