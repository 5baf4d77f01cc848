# SPDX-License-Identifier: Apache-2.0
"""The package tf2_msgs, which PyPI's ROS lacks: its TFMessage, built from the definition that geometry2 has."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

FILES = {
    "msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
    "package.xml": """<package format="3">
  <name>tf2_msgs</name>
  <version>0.36.0</version>
  <description>The message of tf2, for tests.</description>
  <maintainer email="starpos@users.noreply.github.com">starpos maintainers</maintainer>
  <license>BSD-3-Clause</license>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
""",
    "CMakeLists.txt": """cmake_minimum_required(VERSION 3.16)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(tf2_msgs msg/TFMessage.msg DEPENDENCIES geometry_msgs)
ament_package()
""",
}


def built(folder: Path) -> dict[str, str]:
    """Variables that let a process import tf2_msgs: from a build in this folder, none where it is installed.

    It is built once: a whole build of the same files, which stands there already, is taken.
    """
    if find_spec("tf2_msgs"):
        return {}
    folder.mkdir(parents=True, exist_ok=True)
    stamp, wanted = folder / "stamp", repr((FILES, sys.executable))
    with (folder / "lock").open("w") as lock:
        # another part of the tests may be at it
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not stamp.is_file() or stamp.read_text() != wanted:
            _build(folder)
            stamp.write_text(wanted)
    return dict(_variables(folder / "install"))


def _build(folder: Path) -> None:
    for name, text in FILES.items():
        path = folder / "source" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    options = {
        "CMAKE_INSTALL_PREFIX": folder / "install",
        "Python3_EXECUTABLE": sys.executable,
        "CMAKE_CXX_FLAGS": "-O0",
    }
    for command in (
        ["cmake", "-S", "source", "-B", "build", *(f"-D{name}={value}" for name, value in options.items())],
        ["cmake", "--build", "build", "--target", "install"],
    ):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def _variables(prefix: Path) -> Iterator[tuple[str, str]]:
    [packages] = prefix.glob("lib/python*/site-packages")
    for name, path in (
        ("AMENT_PREFIX_PATH", prefix),
        ("PYTHONPATH", packages),
        ("LD_LIBRARY_PATH", prefix / "lib"),
    ):
        yield name, f"{path}{os.pathsep}{os.environ.get(name, '')}"
