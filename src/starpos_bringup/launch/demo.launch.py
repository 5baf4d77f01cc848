# SPDX-License-Identifier: Apache-2.0
"""The whole instrument under a simulated sky, at a place that only the simulation knows.

    ros2 launch starpos_bringup demo.launch.py latitude:=48.1 longitude:=11.6
    ros2 topic echo /fix

Compare `fix` with the given place. The time is this computer's.
tools/demo/demo.py does the same with a place drawn at random.
"""

import atexit
import os
import shutil
import tempfile

import numpy as np
from launch.actions import ExecuteProcess
from launch_ros.substitutions import ExecutableInPackage

from starpos_bringup.launch_arguments import number
from starpos_bringup.launching import dashboard, described, process

# deg
POINTING = {"latitude": (-90, 90), "longitude": (-180, 360), "azimuth": (-360, 360), "altitude": (5, 90)}
CADENCE_S = 0.01, 86400
MISALIGNMENT_DEG = (0.4, -0.3, 12.0)
AIR = {"pressure": 95000.0, "temperature": 8.0, "humidity": 0.4}


def tilt_deg(place: dict[str, float], roll_deg: float):
    """Compute the readings of the inclinometer at a place and pointing, deg."""
    from starpos.earth.refraction import Atmosphere
    from starpos.simulation.scene import scene_of

    scene = scene_of(
        latitude_deg=place["latitude"],
        longitude_deg=place["longitude"],
        atmosphere=Atmosphere(
            pressure_pa=AIR["pressure"], temperature_c=AIR["temperature"], humidity=AIR["humidity"]
        ),
        pointing_deg=(place["azimuth"], place["altitude"], roll_deg),
        misalignment_deg=MISALIGNMENT_DEG,
    )
    return np.degrees(scene.tilt)


def nodes(told):
    place = {name: number(told, name, *bounds) for name, bounds in POINTING.items()}
    roll_deg = 15.0
    theta_x, theta_y = tilt_deg(place, roll_deg)
    folder = tempfile.mkdtemp(prefix="starpos_")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    link = os.path.join(folder, "inclinometer")
    simulated = {f"simulated.{name}": value for name, value in (place | AIR).items()} | {
        "simulated.roll": roll_deg
    }
    camera = {"source": "simulated", "cadence": number(told, "cadence", *CADENCE_S), **simulated}
    solver = {f"refraction.{name}": value for name, value in AIR.items()} | {
        "misalignment": list(MISALIGNMENT_DEG),
        "misalignment_stddev": 5.0,
        "inclinometer.model": "sca100t_calibrated",
    }
    emulator = ExecutableInPackage("emulator", "starpos_testing")
    device = [emulator, "--link", link, "--tilt-x", f"{theta_x:.9f}", "--tilt-y", f"{theta_y:.9f}"]
    return [
        # The emulator is a device, not a node.
        ExecuteProcess(cmd=device, name="emulator", output="screen"),
        process("starpos_inclinometer", "inclinometer", told, {"inclinometer": {"port": link}}),
        process("starpos_camera", "camera_detector", told, {"camera": camera}),
        process("starpos_solver", "solver", told, {"solver": solver}),
        *dashboard(told),
    ]


def generate_launch_description():
    return described("demo", nodes)
