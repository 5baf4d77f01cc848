# SPDX-License-Identifier: Apache-2.0
"""The node `navigator`: a rover's messages become the command line's answer, and what cannot be is said."""

from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import TwistWithCovarianceStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.fix.attitude import CameraAttitude
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import adjust_voyage
from starpos_common.messages import attitude_to_message, unix_to_stamp
from starpos_interfaces.msg import Attitude
from starpos_testing.graph.graph import stamp_of
from starpos_testing.voyages import CAMERA_TO_BODY, INDUSTRIAL, made

SECONDS = 60
# of readings between two reports while the adjustment catches up
STEP_S = 0.1
EARTH_M = 6.37e6
AGE = "time since the newest frame that is adjusted (s)"


@pytest.fixture(scope="module")
def record():
    return made("rover", SECONDS, 3, rate_hz=50)


@pytest.fixture
def transforms(graph, listen):
    """Messages on /tf: stamp, names of the frames, translation and quaternion, one after another."""
    heard = listen("/tf")
    graph.wait(lambda: graph.node.count_subscribers("/tf") == 1)
    return heard


@pytest.fixture
def ears(graph, tf2, run, tmp_path):
    """A navigator that knows its IMU, who feeds it, and what it publishes."""
    model = tmp_path / "imu.yaml"
    model.write_text(yaml.safe_dump({name: float(value) for name, value in asdict(INDUSTRIAL).items()}))
    heard = SimpleNamespace(
        fixes=graph.hear(NavSatFix, "navigator/fix"),
        headings=graph.hear(Imu, "navigator/heading"),
        odometry=graph.hear(Odometry, "navigator/odometry"),
    )
    run(
        "starpos_solver",
        "navigator",
        f"imu_model:={model}",
        "vehicle:=rover",
        "publish_tf:=true",
        "rate:=2.0",
        "adjust_period:=1.0",
        "refraction.pressure:=0.0",
        "clock_stddev:=1e-4",
        "deflection.stddev:=0.0",
        # a test sends in a second what an IMU sends in a minute
        "qos_overrides./imu/data.subscription.reliability:=reliable",
        "qos_overrides./twist.subscription.reliability:=reliable",
    )
    kinds = (("imu", Imu, "imu/data"), ("attitude", Attitude, "attitude"))
    kinds += (("twist", TwistWithCovarianceStamped, "twist"),)
    publishers = {
        name: graph.node.create_publisher(kind, topic, QoSProfile(depth=5000)) for name, kind, topic in kinds
    }
    vars(heard).update(publishers)
    graph.wait(
        lambda: (
            all(p.get_subscription_count() == 1 for p in publishers.values())
            and all(graph.node.count_publishers(f"navigator/{n}") for n in ("fix", "heading", "odometry"))
            and graph.node.count_publishers("/tf") == 1
        )
    )
    yield heard
    for publisher in publishers.values():
        graph.node.destroy_publisher(publisher)


def vector(values):
    return Vector3(**dict(zip("xyz", map(float, values), strict=True)))


def reading(unix_s, gyro=(0, 0, 0), force=(0, 0, 9.8)):
    return Imu(
        header=Header(stamp=unix_to_stamp(unix_s)),
        angular_velocity=vector(gyro),
        linear_acceleration=vector(force),
    )


def send_stars_and_wheels(ears, record):
    for frame in record.frames:
        seen, state = frame.camera, earth_state(frame.utc_unix_s)
        found = CameraAttitude(
            utc_unix_s=frame.utc_unix_s,
            stamp_stddev_s=0.0,
            clock_stddev_s=1e-4,
            frame_id="camera",
            camera_to_gcrs=state.gcrs_to_itrs.T @ seen.rotation,
            covariance=seen.covariance_about_own,
            stars=30,
            log_odds=50.0,
        )
        ears.attitude.publish(attitude_to_message(found))
    for t, v, sigma in zip(
        record.velocity.utc_unix_s, record.velocity.velocity, record.velocity.sigma, strict=True
    ):
        message = TwistWithCovarianceStamped(header=Header(stamp=unix_to_stamp(t)))
        message.twist.twist.linear = vector(v)
        message.twist.covariance = (np.eye(6) * sigma**2).ravel()
        ears.twist.publish(message)


def send_readings(ears, record, begin_s, end_s):
    """Send the readings of some seconds since the record began."""
    imu = record.imu
    since = imu.utc_unix_s - record.frames_s[0] + 0.5
    for k in np.flatnonzero((since > begin_s + 1e-6) & (since < end_s + 1e-6)):
        ears.imu.publish(reading(imu.utc_unix_s[k], imu.gyro[k], imu.force[k]))


def value(graph, task, key):
    state = graph.state(f"navigator: {task}", "")
    return {v.key: v.value for v in state.values}.get(key, "nan")


def test_a_rovers_place_is_the_command_lines(graph, transforms, ears, record):
    send_stars_and_wheels(ears, record)
    graph.wait(
        lambda: value(graph, "Navigation", "velocities in the window") == str(len(record.velocity.utc_unix_s))
    )
    send_readings(ears, record, 0, SECONDS - 6)
    # an adjustment begins with a reading and may be of a part only: some readings a report until one is of nearly all
    sent_s = SECONDS - 6.0
    while sent_s < SECONDS - STEP_S:
        send_readings(ears, record, sent_s, sent_s + STEP_S)
        sent_s += STEP_S
        if float(value(graph, "Navigation", AGE)) < 2.5:
            break
    send_readings(ears, record, sent_s, SECONDS)
    stamp = stamp_of(reading(record.frames_s[-1]))
    outputs = ears.fixes, ears.headings, ears.odometry
    graph.wait(lambda: all(stamp in map(stamp_of, m) for m in outputs), "for the output of the last frame")
    assert value(graph, "Inputs", "refused") == "0"

    fix, heading, odometry = (next(m for m in heard if stamp_of(m) == stamp) for heard in outputs)
    vessel = Vessel(
        vehicle="rover",
        model=INDUSTRIAL,
        camera_to_body=CAMERA_TO_BODY,
        mount_stddev=np.radians(1.0),
        atmosphere=Atmosphere(pressure_pa=0.0),
        clock_stddev_s=1e-4,
    )
    said = adjust_voyage(record.frames, record.imu, record.velocity, vessel).fixes[-1]
    claim = np.reshape(fix.position_covariance, (3, 3))[:2, :2]
    sigma_m = np.sqrt(np.trace(claim) / 2)
    apart = off_m(fix, np.degrees(said.latitude), np.degrees(said.longitude))
    truth = np.degrees([record.latitude[-1], record.longitude[-1]])
    error = off_m(fix, *truth)
    assert fix.status.status == NavSatStatus.STATUS_FIX and sigma_m < 1000
    assert np.linalg.norm(apart) < 2 * sigma_m
    # of two degrees of freedom one in a million is beyond 28
    assert error @ np.linalg.solve(claim, error) < 28
    q = heading.orientation
    yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    turn = (np.pi / 2 - yaw - record.heading[-1] + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) < 5 * heading.orientation_covariance[8] ** 0.5 < np.radians(1)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "starpos_link")
    assert odometry.pose.pose.orientation == q
    pose = odometry.pose.pose
    at = [pose.position.x, pose.position.y, pose.position.z, q.x, q.y, q.z, q.w]
    moment = [odometry.header.stamp.sec, odometry.header.stamp.nanosec]
    graph.wait(lambda: [moment, ["map", "starpos_link"], at] in transforms(), "for the pose on /tf")
    assert abs(odometry.twist.twist.linear.x - record.velocity.velocity[-1][0]) < 0.2
    state = graph.state("navigator: Navigation", "place to")
    assert {"place (m, 1 sigma an axis)", "heading (deg, 1 sigma)"} <= {v.key for v in state.values}


def off_m(fix, latitude_deg, longitude_deg):
    """East, north (2,) in m of a fix from a place."""
    east = np.radians(fix.longitude - longitude_deg) * np.cos(np.radians(latitude_deg))
    return EARTH_M * np.array([east, np.radians(fix.latitude - latitude_deg)])


def test_without_stars_and_of_bad_readings_there_is_no_fix_but_a_sentence(graph, ears, record):
    send_readings(ears, record, 0, 1)
    at = record.frames_s[0] + 1.0
    for bad in (reading(at, force=(0, 0, np.nan)), reading(at - 0.9)):
        ears.imu.publish(bad)
    graph.state("navigator: Inputs", "an inertial reading is not later than the one before")
    assert value(graph, "Inputs", "refused") == "2"
    graph.state("navigator: Navigation", "no frame with stars yet")
    graph.wait(lambda: ears.fixes, "for what there is without a fix")
    assert not ears.headings and not ears.odometry
    assert all(m.status.status == NavSatStatus.STATUS_NO_FIX and np.isnan(m.latitude) for m in ears.fixes)
    assert graph.call(Trigger, "navigator/reset", Trigger.Request()).success


def test_the_transform_is_published_as_long_as_it_is_asked_for(graph, ears):
    for wanted in (False, True):
        assert graph.set("navigator", publish_tf=wanted) == (True, "")
        graph.wait(lambda n=int(wanted): graph.node.count_publishers("/tf") == n, f"{wanted} on /tf")
