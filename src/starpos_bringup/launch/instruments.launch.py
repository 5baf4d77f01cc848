# SPDX-License-Identifier: Apache-2.0
"""Several instruments on one robot, each in a namespace of its own, with one parameter file.

    ros2 launch starpos_bringup instruments.launch.py instruments:=left,right params_file:=robot.yaml

In the file /**/solver stands for each solver, /left/solver for the one of `left`. The frames of `left` are
left_starpos_link and so on,
unless the file names others: tf knows no namespaces.
"""

from dataclasses import replace

from launch import LaunchDescription
from launch.actions import GroupAction, OpaqueFunction
from launch_ros.actions import PushRosNamespace

from starpos_bringup.launch_arguments import is_true, names
from starpos_bringup.launching import COMMON_ARGUMENTS, Common, declared, given, instrument

ARGUMENTS = (
    ("instruments", None, "names of the instruments, separated by commas: left,right"),
    ("params_file", None, "parameters of all nodes of all instruments"),
    *(argument for argument in COMMON_ARGUMENTS if argument[0] not in ("params_file", "namespace")),
    ("namespace", "", "of all of them: /NAMESPACE/left/fix and so on"),
    ("use_sim_time", "", "true: time from /clock"),
    ("respawn", "false", "true: a process that ends, for whatever reason, is started again 2 s later"),
)
FRAMES = {
    "camera": "starpos_camera_optical_frame",
    "inclinometer": "starpos_inclinometer_frame",
    "solver": "starpos_link",
}


def nodes(context):
    told = given(context, ARGUMENTS)
    clock = {"use_sim_time": is_true(told, "use_sim_time")} if told["use_sim_time"] else {}
    common = Common.of(told)
    groups = []
    for name in names(told, "instruments"):
        frames = {node: {"frame_id": f"{name.replace('/', '_')}_{frame}"} for node, frame in FRAMES.items()}
        # security's policies are of one namespace each
        own = replace(common, enclaves=f"{common.enclaves}/{name}")
        namespaces = [PushRosNamespace(part) for part in (told["namespace"], name) if part]
        groups.append(GroupAction([*namespaces, *instrument(own, {"**": clock}, frames)]))
    return groups


def generate_launch_description():
    return LaunchDescription([*declared(ARGUMENTS), OpaqueFunction(function=nodes)])
