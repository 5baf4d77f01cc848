# SPDX-License-Identifier: Apache-2.0
"""Makes data/night: a small rosbag2 (mcap) of a night at a known place, and data/night.json, the truth about it.

`make_bag.py [FOLDER]` in the workspace. Ten frames of the paper's camera as lists of stars, then three frames of a small
camera as images, tilts at 10 Hz throughout. Everything is seeded: the same code makes the same bytes.
"""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from starpos.earth.refraction import Atmosphere
from starpos.instrument.inclinometer import Tilt
from starpos.simulation.scene import Optics, detected, expose, read_tilt, render, scene_of
from starpos.sky.catalogue import load_catalogue
from starpos_bringup.bag import BagWriter
from starpos_common.messages import camera_to_message, frame_to_message, stars_to_message, tilt_to_message
from starpos_interfaces.msg import Capture

SEED = 20261102
# 2026-11-02T18:00:00Z
START_S = 1793642400.0
# Astronomic
LATITUDE_DEG, LONGITUDE_DEG = 46.5475, 7.9852
AIR = {"pressure_pa": 66000.0, "temperature_c": -4.0, "humidity": 0.4}
MISALIGNMENT_DEG = (0.31, -0.22, 0.53)
# A better sensor than the paper's: 0.7 arcsec, so that the test is sharp.
TILT_NOISE_DEG = 0.0002
EXPOSURE_S, CADENCE_S, TILT_PERIOD_S = 0.5, 5.0, 0.1
FULL_SIZE, FULL_FOCAL_PX, FULL_FRAMES = (5616, 3744), 93750.0, 10
SMALL_SIZE, SMALL_FRAMES = (1000, 700), 3
# The same field, the same triangles.
SMALL_FOCAL_PX = FULL_FOCAL_PX * np.hypot(*SMALL_SIZE) / np.hypot(*FULL_SIZE)
# Coarse grey levels: a camera's noise is what does not compress.
SMALL_OPTICS = Optics(zero_point_e_s=2.0e6, gain_e_dn=8.0, bias_dn=64.0, seeing_arcsec=0.5)
SMALL_START_S = START_S + 60.0
END_S = SMALL_START_S + SMALL_FRAMES * CADENCE_S
TURN_DEG = 36.0
CAMERA_FRAME, TILT_FRAME = "starpos_camera_optical_frame", "starpos_inclinometer_frame"
# From the end of an exposure to its stars.
SLOW_S = 0.3


class Bag:
    """A rosbag2 that is written in the order of time with the ROS messages of this workspace."""

    def __init__(self, folder: Path):
        self._writer = BagWriter(folder)
        self._messages = []

    def add(self, log_s: float, topic: str, message) -> None:
        kind = "/".join((type(message).__module__.split(".")[0], "msg", type(message).__name__))
        self._writer.add_topic(topic, kind)
        store = self._writer.store
        # rmw leaves whatever was in memory between the fields; rosbags writes zeros
        data = store.serialize_cdr(store.deserialize_cdr(serialize_message(message), kind), kind)
        self._messages.append((round(log_s * 1e6) * 1000, topic, bytes(data)))

    def write(self) -> None:
        for log_ns, topic, data in sorted(self._messages, key=lambda m: m[0]):
            self._writer.write(topic, log_ns, data)
        self._writer.close()


def scenes():
    """(kind, start of exposure, scene) of each frame; `kind` is stars or image."""
    full, small = (
        scene_of(size, focal, LATITUDE_DEG, LONGITUDE_DEG, Atmosphere(**AIR), misalignment_deg=MISALIGNMENT_DEG,
                 tilt_noise_deg=TILT_NOISE_DEG)
        for size, focal in ((FULL_SIZE, FULL_FOCAL_PX), (SMALL_SIZE, SMALL_FOCAL_PX))
    )  # fmt: skip
    small = replace(small, optics=SMALL_OPTICS)
    for k in range(FULL_FRAMES):
        yield "stars", START_S + k * CADENCE_S, replace(full, azimuth_deg=k * TURN_DEG)
    for k in range(SMALL_FRAMES):
        yield "image", SMALL_START_S + k * CADENCE_S, replace(small, azimuth_deg=20.0 + k * TURN_DEG)


def make(folder: Path) -> None:
    rng = np.random.default_rng(SEED)
    catalogue, bag, truth = load_catalogue(), Bag(folder), []
    for kind, start, scene in scenes():
        mid, end = start + EXPOSURE_S / 2, start + EXPOSURE_S
        light = expose(scene, catalogue, start, EXPOSURE_S, rng)
        bag.add(end + 0.01, "/camera/camera_info", camera_to_message(scene.camera, CAMERA_FRAME, mid))
        if kind == "stars":
            stars = detected(scene, light, mid, EXPOSURE_S, rng)
            bag.add(end + SLOW_S, "/stars", stars_to_message(stars, CAMERA_FRAME))
        else:
            image = frame_to_message(render(scene, light, start, EXPOSURE_S, rng), CAMERA_FRAME)
            header = Header(stamp=image.header.stamp, frame_id=CAMERA_FRAME)
            capture = Capture(header=header, exposure=EXPOSURE_S, stamp_source=Capture.SIMULATED)
            bag.add(end + 0.01, "/camera/capture", capture)
            bag.add(end + SLOW_S, "/camera/image_raw", image)
        truth.append({"kind": kind, "mid_unix_s": mid, "heading_deg": float(np.degrees(scene.heading))})
    # It turns about the vertical: the tilt stays.
    still = scene
    for n in range(round((END_S - START_S) / TILT_PERIOD_S)):
        moment = START_S + 0.05 + n * TILT_PERIOD_S + rng.uniform(-0.004, 0.004)
        x, y = read_tilt(still, rng)
        tilt = Tilt(
            x,
            y,
            np.eye(2) * np.radians(TILT_NOISE_DEG) ** 2,
            utc_unix_s=moment,
            samples=1,
            temperature_c=AIR["temperature_c"],
        )
        bag.add(moment + 0.03, "/tilt", tilt_to_message(tilt, TILT_FRAME, n))
    bag.write()
    about = {"latitude_deg": LATITUDE_DEG, "longitude_deg": LONGITUDE_DEG, **AIR, "misalignment_deg": MISALIGNMENT_DEG,
             "exposure_s": EXPOSURE_S, "tilt_noise_deg": TILT_NOISE_DEG, "frames": truth}  # fmt: skip
    folder.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent / "data" / "night")
    folder = parser.parse_args().folder
    # A bag, not whatever else was named.
    if (folder / "metadata.yaml").is_file():
        shutil.rmtree(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    make(folder)
    print(f"{folder}: {sum(f.stat().st_size for f in folder.iterdir()) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
