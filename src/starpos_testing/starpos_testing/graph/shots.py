# SPDX-License-Identifier: Apache-2.0
"""Messages of an instrument at a known place: intrinsics, stars and tilts of one exposure, or an image."""

from dataclasses import dataclass, replace

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.refraction import Atmosphere
from starpos.frames.frame import no_stars
from starpos.instrument.inclinometer import Tilt
from starpos.simulation.scene import Scene, detected, expose, read_tilt, render, scene_of
from starpos.sky.catalogue import load_catalogue
from starpos_common.messages import camera_to_message, frame_to_message, stars_to_message, tilt_to_message
from starpos_interfaces import msg

# 2024-11-03T18:00:00Z: what lies in the future is refused.
START_S = 1730656800.0
EXPOSURE_S, CADENCE_S, SAMPLES = 0.5, 10.0, 5
PRESSURE_PA, TEMPERATURE_C, HUMIDITY = 95000.0, 8.0, 0.5
LATITUDE_DEG, LONGITUDE_DEG = -23.1, -68.25
NOISE_DEG = 0.0001
FULL, FULL_FOCAL_PX = (5616, 3744), 93750.0
SMALL = (1000, 700)
FRAME = "starpos_camera_optical_frame"

# Parameters of a solver that knows the air of this place and needs no long patience.
SOLVER = (
    f"refraction.pressure:={PRESSURE_PA}",
    f"refraction.temperature:={TEMPERATURE_C}",
    f"refraction.humidity:={HUMIDITY}",
    "misalignment_stddev:=0.5",
    "inclinometer.model:=sca100t_calibrated",
    "deflection.stddev:=0.0",
)


def focal_of(size) -> float:
    """Focal length in px that gives a frame the field of the full one, so that all share a catalogue of triangles."""
    return FULL_FOCAL_PX * float(np.hypot(*size) / np.hypot(*FULL))


@dataclass
class SimulatedShot:
    """One exposure as messages that tests may change, and the truth about it."""

    info: CameraInfo
    stars: msg.StarArray
    tilts: list[msg.Tilt]
    scene: Scene

    @property
    def stamp(self) -> tuple[int, int]:
        return self.stars.header.stamp.sec, self.stars.header.stamp.nanosec

    def error_m(self, solution) -> np.ndarray:
        """East, north (2,) in m of a solution's place from the true one, on a sphere."""
        east = np.radians(solution.longitude - LONGITUDE_DEG) * np.cos(np.radians(LATITUDE_DEG))
        return np.array([east, np.radians(solution.latitude - LATITUDE_DEG)]) * EARTH_RADIUS_M

    def heading_error_deg(self, heading_deg: float) -> float:
        return (heading_deg - np.degrees(self.scene.heading) + 180) % 360 - 180


def scene_at(azimuth_deg=40.0, size=FULL) -> Scene:
    air = Atmosphere(pressure_pa=PRESSURE_PA, temperature_c=TEMPERATURE_C, humidity=HUMIDITY)
    scene = scene_of(size, focal_of(size), LATITUDE_DEG, LONGITUDE_DEG, air, tilt_noise_deg=NOISE_DEG)
    return replace(scene, azimuth_deg=azimuth_deg)


def azimuth_for_heading(heading_deg: float) -> float:
    """Azimuth in deg of the optical axis for which the base link has this heading."""
    return heading_deg - float(np.degrees(scene_at(0.0).heading))


_count = iter(range(1, 100000))


def shoot(azimuth_deg=40.0, **changes) -> SimulatedShot:
    """A shot 10 s after the last one, so that each has its own stamp."""
    k = next(_count)
    scene = replace(scene_at(azimuth_deg), **changes)
    return shot_of(scene, START_S + k * CADENCE_S, np.random.default_rng(k))


def shot_of(scene: Scene, start: float, rng) -> SimulatedShot:
    """The messages for an exposure of a scene that begins at `start` (Unix s)."""
    light = expose(scene, load_catalogue(), start, EXPOSURE_S, rng)
    stars = detected(scene, light, start + EXPOSURE_S / 2, EXPOSURE_S, rng)
    return SimulatedShot(
        camera_to_message(scene.camera, FRAME, stars.mid_unix_s),
        stars_to_message(stars, FRAME),
        tilts_of(scene, start, rng),
        scene,
    )


def tilts_of(scene: Scene, start: float, rng) -> list[msg.Tilt]:
    return tilts_at(scene, start + (np.arange(SAMPLES) + 0.5) * EXPOSURE_S / SAMPLES, rng)


def tilts_at(scene: Scene, times_s, rng) -> list[msg.Tilt]:
    """The inclinometer's readings at these times (Unix s), numbered from 0."""
    covariance = np.eye(2) * np.radians(NOISE_DEG) ** 2
    return [
        tilt_to_message(
            Tilt(*read_tilt(scene, rng), covariance, utc_unix_s=float(t), temperature_c=TEMPERATURE_C),
            "starpos_inclinometer_frame",
            j,
        )
        for j, t in enumerate(times_s)
    ]


def photograph(azimuth_deg=40.0) -> tuple[SimulatedShot, Image, msg.Capture]:
    """A shot of the small camera as an image, with its stars not yet detected."""
    k = next(_count)
    return photograph_of(scene_at(azimuth_deg, SMALL), START_S + k * CADENCE_S, np.random.default_rng(k))


def photograph_of(scene: Scene, start: float, rng) -> tuple[SimulatedShot, Image, msg.Capture]:
    """An image of any scene and time; the frame is rendered, so a small one is quick."""
    light = expose(scene, load_catalogue(), start, EXPOSURE_S, rng)
    image = frame_to_message(render(scene, light, start, EXPOSURE_S, rng), FRAME)
    info = camera_to_message(scene.camera, FRAME, start + EXPOSURE_S / 2)
    size = scene.camera.width, scene.camera.height
    empty = stars_to_message(no_stars(*size, mid_unix_s=start + EXPOSURE_S / 2), FRAME)
    capture = msg.Capture(header=image.header, exposure=EXPOSURE_S, stamp_source=msg.Capture.SIMULATED)
    return SimulatedShot(info, empty, tilts_of(scene, start, rng), scene), image, capture
