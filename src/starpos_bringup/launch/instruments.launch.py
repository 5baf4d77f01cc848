# SPDX-License-Identifier: Apache-2.0
"""Several instruments on one robot, each in a namespace of its own, with one parameter file.

    ros2 launch starpos_bringup instruments.launch.py instruments:=left,right params_file:=robot.yaml

In the file /**/solver stands for each solver, /left/solver for the one of `left`. The frames of `left` are
left_starpos_link and so on,
unless the file names others: tf knows no namespaces.
"""

from launch.actions import GroupAction
from launch_ros.actions import PushRosNamespace

from starpos_bringup import launching
from starpos_bringup.launch_arguments import names

FRAMES = {
    "camera": "starpos_camera_optical_frame",
    "inclinometer": "starpos_inclinometer_frame",
    "solver": "starpos_link",
}


def nodes(told):
    groups = []
    for name in names(told, "instruments"):
        frames = {node: {"frame_id": f"{name.replace('/', '_')}_{frame}"} for node, frame in FRAMES.items()}
        # security's policies are of one namespace each
        own = {**told, "enclaves": f"{told['enclaves'].rstrip('/')}/{name}"}
        groups.append(
            GroupAction(
                [PushRosNamespace(name), *launching.instrument(own, launching.clock_of(told), frames)]
            )
        )
    return groups


def generate_launch_description():
    return launching.described("instruments", nodes)
