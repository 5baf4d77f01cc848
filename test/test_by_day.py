# SPDX-License-Identifier: Apache-2.0
"""A day and the night after it at a known place, by one camera: the Sun until it sets, then the stars; no restart."""

import math
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.fix.solution import Status
from starpos.frames.frame import Disc, Frame, no_stars
from starpos.instrument.camera import Camera
from starpos.session.driver import Answered
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos.simulation.scene import Scene, scene_of
from starpos.sky.bodies import SUN, body_at
from starpos_bringup.bag import BagWriter
from starpos_common.messages import camera_to_message, frame_to_message, stars_to_message, unix_to_stamp
from starpos_interfaces.msg import Attitude, Capture, Solution
from starpos_testing.graph.shots import (
    FRAME,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    NOISE_DEG,
    SMALL,
    SimulatedShot,
    focal_of,
    photograph_of,
    scene_at,
)
from starpos_testing.headings import yaw_deg
from starpos_testing.skies.bags import Quiet, typestore
from starpos_testing.skies.suns import disc_frame
from starpos_testing.voyages import BEGIN_S, INDUSTRIAL, made

# 2024-11-03, UTC: the Sun sinks from 37 deg to 1, stands 5 deg below the horizon, and is 10 and 20 deg below it
DAY = 1730664000.0 + 3600 * np.array([0.0, 1.0, 2.0, 2.4, 2.64])
DUSK = 1730664000.0 + 3600 * np.array([3.05])
NIGHT = 1730664000.0 + 3600 * np.array([3.5, 4.0])
LEAN_DEG, MOUNTED_ARCSEC = -30.0, 20.0
SOLVER = (
    "refraction.pressure:=95000.0",
    "refraction.temperature:=8.0",
    "refraction.humidity:=0.5",
    f"misalignment:=[{LEAN_DEG}, 0.0, 0.0]",
    f"misalignment_stddev:={MOUNTED_ARCSEC / 3600}",
    "inclinometer.model:=sca100t_calibrated",
    f"site.latitude:={LATITUDE_DEG}",
    f"site.longitude:={LONGITUDE_DEG}",
)


def scene_towards(azimuth_deg: float, altitude_deg: float) -> Scene:
    return scene_of(
        SMALL,
        focal_of(SMALL),
        LATITUDE_DEG,
        LONGITUDE_DEG,
        scene_at().site.atmosphere,
        pointing_deg=(azimuth_deg, altitude_deg, 15.0),
        misalignment_deg=(LEAN_DEG, 0.0, 0.0),
        tilt_noise_deg=NOISE_DEG,
    )


def risen(true: np.ndarray) -> np.ndarray:
    """The direction (3,) as it is seen; near the horizon as almanacs have it (Bennett 1982), in the air of the place."""
    if true[2] > 0.06:
        return scene_at().site.atmosphere.refraction().bend(true)
    altitude = np.degrees(np.arcsin(true[2]))
    seen = altitude
    for _ in range(20):
        seen = altitude + 1 / np.tan(np.radians(seen + 7.31 / (seen + 4.4))) / 60 * 950 / 1010 * 283 / 281
    level = true[:2] / np.hypot(*true[:2]) * np.cos(np.radians(seen))
    return np.array([*level, np.sin(np.radians(seen))])


def photographs() -> list[tuple[SimulatedShot, object, Capture]]:
    """Each exposure's messages, in order of time."""
    made = []
    place = scene_at().site.place
    for k, start in enumerate((*DAY, *DUSK, *NIGHT)):
        rng = np.random.default_rng(k)
        true = place.axes @ body_at(SUN, earth_state(start + 0.25)).from_place(place.zenith)
        sun = risen(true)
        azimuth, altitude = np.degrees([np.arctan2(sun[0], sun[1]), np.arcsin(sun[2])])
        scene = scene_towards(azimuth + 0.4, altitude - 0.3) if start in DAY else scene_towards(70.0, 40.0)
        shot, image, capture = photograph_of(scene, start, rng)
        if start not in NIGHT:
            x, y = scene.camera.project(sun @ scene.attitude) if start in DAY else (-5000.0, 0.0)
            radius = scene.camera.fx * body_at(SUN, earth_state(start)).radius
            frame = Frame(
                disc_frame(x, y, radius, SMALL[::-1], seed=k), mid_unix_s=start + 0.25, exposure_s=0.5
            )
            image = frame_to_message(frame, FRAME)
        made.append((shot, image, capture))
    return made


@pytest.fixture(scope="module")
def frames():
    return photographs()


def is_right(shot: SimulatedShot, heading_deg: float, sigma_deg: float) -> bool:
    return abs(shot.heading_error_deg(heading_deg)) < 4 * sigma_deg


def test_nodes_give_headings_by_day_and_by_night(graph, run, tmp_path, frames):
    run("starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    run("starpos_camera", "detector")
    graph.wait_for_detector(lambda: frames[0])
    said = []
    for shot, image, capture in frames:
        graph.send(shot, image, capture)
        answer, _, imu = graph.result(shot.stamp)
        if shot.stamp == frames[0][0].stamp:
            state = graph.state("solver: Solution", "by the Sun")
            assert ("source", "sun") in [(v.key, v.value) for v in state.values]
        said.append("the Sun" if "by the Sun" in answer.status_text else answer.stars_matched)
        if shot.stamp == frames[len(DAY)][0].stamp:
            assert answer.status != Solution.OK
            assert math.isnan(answer.heading)
            assert imu is None
            continue
        assert answer.status == Solution.OK
        assert is_right(shot, answer.heading, answer.heading_stddev)
        assert abs((yaw_deg(imu) - (90 - answer.heading) + 180) % 360 - 180) < 0.02
        assert answer.heading_stddev < 0.05
    assert said[: len(DAY)] == ["the Sun"] * len(DAY)
    assert min(said[len(DAY) + 1 :]) >= 4


def test_a_bag_of_a_day_and_a_night_is_replayed_without_a_gap(tmp_path, frames):
    store, bag = typestore(), BagWriter(tmp_path / "bag")
    for shot, image, capture in frames:
        end_s = shot.stamp[0] + 1.0
        rows = [("/camera/camera_info", shot.info), *(("/tilt", t) for t in shot.tilts)]
        for k, (topic, message) in enumerate(
            (*rows, ("/camera/capture", capture), ("/camera/image_raw", image))
        ):
            kind = "/".join((type(message).__module__.split(".")[0], "msg", type(message).__name__))
            bag.add_topic(topic, kind)
            data = store.serialize_cdr(store.deserialize_cdr(serialize_message(message), kind), kind)
            bag.write(topic, round((end_s + 0.01 * k) * 1e9), bytes(data))
    bag.close()
    answers = [
        made.solution
        for made in Replay(Settings.of(None, SOLVER), Quiet()).play(tmp_path / "bag")
        if isinstance(made, Answered)
    ]
    assert [s.bodies for s in answers] == [("sun",)] * len(DAY) + [()] * (len(DUSK) + len(NIGHT))
    for (shot, *_), answer in zip(frames, answers, strict=True):
        if answer.status is Status.OK:
            north = answer.at_place.true_north
            heading_deg, sigma = (
                math.degrees(north.heading),
                math.degrees(north.angles_covariance[0, 0] ** 0.5),
            )
            assert is_right(shot, heading_deg, sigma)
    assert [s.ok for s in answers] == [True] * len(DAY) + [False] + [True] * len(NIGHT)


def disc_message(optics: Camera, ray: np.ndarray, unix_s: float, radius: float) -> SimpleNamespace:
    """The detector's messages of a frame that shows the Sun along a ray (3,) in C."""
    (x, y), wide = optics.project(ray[None])[0], optics.fx * radius / ray[2] ** 1.5
    disc = Disc(x=x, y=y, covariance=np.eye(2) * 0.01, radius_px=wide, sharp=True)
    stars = replace(no_stars(optics.width, optics.height, mid_unix_s=unix_s, exposure_s=0.0), disc=disc)
    info = camera_to_message(optics, FRAME, unix_s)
    return SimpleNamespace(info=info, stars=stars_to_message(stars, FRAME), tilts=[])


def test_the_solvers_sun_gives_the_navigator_a_heading_without_a_level(graph, run, tmp_path):
    """A parked vehicle: the detector's discs through the solver, with an IMU's readings to the navigator."""
    seconds, latitude_deg, longitude_deg = 30, -10.0, -8.0
    record = made(
        "parked",
        seconds,
        4,
        rate_hz=50,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        mount_deg=0.05,
    )
    model = tmp_path / "imu.yaml"
    model.write_text(yaml.safe_dump({name: float(value) for name, value in asdict(INDUSTRIAL).items()}))
    site = (f"site.latitude:={latitude_deg}", f"site.longitude:={longitude_deg}", "refraction.pressure:=0.0")
    run("starpos_solver", "solver", "tilt_timeout:=0.05", *site)
    graph.wait_for_solver()
    reliable = "qos_overrides./imu/data.subscription.reliability:=reliable"
    own = (f"imu_model:={model}", "vehicle:=parked", "rate:=2.0", "adjust_period:=1.0", "mount_stddev:=0.1")
    run("starpos_solver", "navigator", *own, *site, reliable)
    attitudes, headings = graph.hear(Attitude, "attitude"), graph.hear(Imu, "navigator/heading")
    imu = graph.node.create_publisher(Imu, "imu/data", QoSProfile(depth=5000))
    graph.wait(
        lambda: (
            imu.get_subscription_count() == 1
            and graph.node.count_publishers("attitude") == 1
            and graph.node.count_subscribers("attitude") == 2
            and graph.node.count_publishers("navigator/heading") == 1
        )
    )
    optics = Camera(width=1936, height=1216, fx=900.0, fy=900.0, cx=967.5, cy=607.5)
    rng = np.random.default_rng(1)
    for k, unix_s in enumerate(record.frames_s):
        sun = body_at(SUN, earth_state(unix_s))
        zenith = rotation.unit_vector(record.longitude[k], record.latitude[k])
        ray = sun.from_place(zenith) @ (record.body_to_itrs[k] @ record.mount)
        ray = rotation.normalised(ray + rng.normal(0, 1e-4, 3))
        graph.send(disc_message(optics, ray, unix_s, sun.radius))
        graph.wait(lambda n=k + 1: len(attitudes) == n, "for the attitude of a frame")
    assert all(seen.stars_matched == 0 for seen in attitudes)
    readings = iter(zip(record.imu.utc_unix_s, record.imu.gyro, record.imu.force, strict=True))

    def send_until(end_s):
        for unix_s, gyro, force in readings:
            message = Imu(header=Header(stamp=unix_to_stamp(unix_s)))
            for to, values in ((message.angular_velocity, gyro), (message.linear_acceleration, force)):
                to.x, to.y, to.z = map(float, values)
            imu.publish(message)
            if unix_s > BEGIN_S + end_s:
                return

    send_until(seconds - 5)
    # an adjustment begins with a reading and may be of a part only: some readings at a time until one is of nearly all
    for tenth in range(50):
        send_until(seconds - 5 + 0.1 * (tenth + 1))
        if graph.comes(lambda: headings, 0.5):
            break
    assert headings
    error = (90 - yaw_deg(headings[-1]) - math.degrees(record.heading[-1]) + 180) % 360 - 180
    claim_deg = math.degrees(headings[-1].orientation_covariance[8] ** 0.5)
    assert abs(error) < 4 * claim_deg < 2.0
    graph.state("navigator: Navigation", "by the Sun, at a given place")
