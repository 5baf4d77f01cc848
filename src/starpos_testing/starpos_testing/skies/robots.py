# SPDX-License-Identifier: Apache-2.0
"""The bag of a robot that has never heard of starpos: a camera driver's images, its intrinsics, and an IMU."""

from dataclasses import replace

import cv2
import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.simulation.scene import Optics, Scene, expose, render, scene_of
from starpos.sky.catalogue import load_catalogue
from starpos_testing.skies.bags import NightBag

# 2024-11-03T18:00:00Z
START_S = 1730656800.0
FRAMES, CADENCE_S, EXPOSURE_S = 3, 2.0, 0.2
# from the end of an exposure until the driver's message is recorded
LATE_S = 0.15
IMU_HZ, IMU_NOISE = 100.0, 0.002
SIZE, FOCAL_PX = (640, 448), 2967.0
LATITUDE_DEG, LONGITUDE_DEG = 46.5475, 7.9852
TURNS_DEG = 25.0
IMAGE, PICTURE, INFO, IMU = "cam0/image_raw", "cam0/image_raw/compressed", "cam0/camera_info", "imu/data"
MSG = "sensor_msgs/msg"


def scene() -> Scene:
    """The robot's camera, 15 deg across, and its IMU along the camera's axes."""
    air = Atmosphere(pressure_pa=95000.0, temperature_c=8.0, humidity=0.5)
    made = scene_of(SIZE, FOCAL_PX, LATITUDE_DEG, LONGITUDE_DEG, air)
    return replace(made, optics=Optics(limit_mag=7.5, sky_mag_arcsec2=20.0, fwhm_px=2.2))


def write(folder, compressed: bool = False, prefix: str = "") -> Scene:
    """Write the bag of FRAMES frames, at each of which the robot stands and has turned; stamps are of the start.

    compressed: PNG alone, without raw images.  prefix: of all topics.
    """
    rng, robot = np.random.default_rng(20241103), scene()
    messages = [*_frames(robot, compressed, rng), *_readings(robot, rng)]
    with NightBag(folder, prefix) as bag:
        for log_s, topic, kind, stamp_s, fields in sorted(messages, key=lambda m: m[0]):
            make = bag.message
            made = make(f"{MSG}/{kind}", stamp_s, **fields(make) if callable(fields) else fields)
            made.header.frame_id = "imu_link" if kind == "Imu" else "cam0"
            bag.write(topic, made, log_s)
    return robot


def _frames(robot, compressed, rng):
    camera = robot.camera
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], float)
    info = {"width": SIZE[0], "height": SIZE[1], "distortion_model": "plumb_bob", "k": k, "d": np.zeros(5)}
    for n in range(FRAMES):
        start_s = START_S + 1.0 + n * CADENCE_S
        turned = replace(robot, azimuth_deg=robot.azimuth_deg + n * TURNS_DEG)
        exposed = expose(turned, load_catalogue(), start_s, EXPOSURE_S, rng)
        pixels = render(turned, exposed, start_s, EXPOSURE_S, rng).pixels
        log_s = start_s + EXPOSURE_S + LATE_S
        yield log_s, INFO, "CameraInfo", start_s, info
        if compressed:
            data = cv2.imencode(".png", pixels)[1].ravel()
            yield (
                log_s,
                PICTURE,
                "CompressedImage",
                start_s,
                {"format": "mono16; png compressed", "data": data},
            )
        else:
            about = {"width": SIZE[0], "height": SIZE[1], "encoding": "mono16", "step": 2 * SIZE[0]}
            yield log_s, IMAGE, "Image", start_s, about | {"data": pixels.view(np.uint8).ravel()}


def _readings(robot, rng):
    up = robot.instrument.calibration.a3 @ robot.attitude[2]
    for n in range(round((FRAMES * CADENCE_S + 2.0) * IMU_HZ)):
        at_s = START_S + n / IMU_HZ
        x, y, z = (9.81 * up + rng.normal(0, IMU_NOISE, 3)).tolist()

        def fields(make, x=x, y=y, z=z):
            return {"linear_acceleration": make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)}

        yield at_s + 0.004, IMU, "Imu", at_s, fields
