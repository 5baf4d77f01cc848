# SPDX-License-Identifier: Apache-2.0
"""The launch files, started by launch where it is installed: it is no part of the ROS that PyPI carries.

What they would start, test_launch_files.py says anywhere.
"""

import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest
from sensor_msgs.msg import NavSatFix

from starpos_testing.nodes import Listener, take_domain
from starpos_testing.patience import WAIT_S

pytest.importorskip(
    "launch_ros", reason="nothing is launched: ROS's launch_ros is not installed, and PyPI has none"
)

FOLDER = Path(__file__).parent.parent / "launch"
NIGHT = Path(__file__).parents[3] / "test" / "data" / "night"
LAUNCH = """
import sys
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
service = LaunchService()
source = PythonLaunchDescriptionSource(sys.argv[1])
arguments = [a.split(":=", 1) for a in sys.argv[2:]]
service.include_launch_description(
    __import__("launch").LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)])
)
sys.exit(service.run())
"""


@pytest.fixture
def run():
    take_domain()
    processes = []

    def run(name, *arguments):
        command = [sys.executable, "-c", LAUNCH, str(FOLDER / f"{name}.launch.py"), *arguments]
        processes.append(
            subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                # A process group of its own, with its nodes.
                start_new_session=True,
            )
        )
        return processes[-1]

    yield run
    for process in processes:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def ctrl_c(process) -> None:
    """What a terminal does: SIGINT to launch and to all it has started, which end cleanly."""
    os.killpg(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=WAIT_S)
    assert "Traceback" not in out and "has died" not in out, out


def test_the_demo_gives_its_place_in_a_namespace_and_ends_cleanly(run):
    listener = Listener()
    try:
        fixes = listener.hear(NavSatFix, "/rover/fix")
        process = run("demo", "namespace:=rover", "dashboard:=false", "latitude:=-30", "longitude:=100")
        listener.wait(lambda: fixes and fixes[-1].status.status >= 0)
    finally:
        listener.close()
    fix = fixes[-1]
    sigma_deg = (fix.position_covariance[0] + fix.position_covariance[4]) ** 0.5 / 111e3
    assert abs(fix.latitude + 30) < 5 * sigma_deg and abs(fix.longitude - 100) < 6 * sigma_deg
    ctrl_c(process)


def test_a_process_that_is_killed_is_started_again_where_that_is_asked_for(run):
    process = run("starpos", "respawn:=true", "camera:=simulated", "port:=/nowhere")
    patience = threading.Timer(WAIT_S, os.killpg, (process.pid, signal.SIGKILL))
    patience.start()

    def pid_of_next_inclinometer() -> int:
        """Once it speaks: launch says its pid before it can end it."""
        pid = 0
        for line in process.stdout:
            if match := re.search(r"\[inclinometer-\d+\]: process started with pid \[(\d+)\]", line):
                pid = int(match[1])
            elif pid and re.match(r"\[inclinometer-\d+\] .*/nowhere", line):
                return pid
        raise AssertionError(f"not started within {WAIT_S} s")

    first = pid_of_next_inclinometer()
    os.kill(first, signal.SIGKILL)
    assert pid_of_next_inclinometer() != first
    patience.cancel()
    ctrl_c(process)


def test_a_replay_that_fails_is_no_success_of_launch(run, tmp_path):
    process = run("replay", f"bag:={tmp_path}", "rate:=0")
    out, _ = process.communicate(timeout=WAIT_S)
    assert process.returncode == 1 and "the replay ended with exit status 2" in out, out


@pytest.mark.skipif(not NIGHT.is_dir(), reason="no bag beside the package")
def test_a_replay_ends_with_its_bag(run):
    process = run("replay", f"bag:={NIGHT}", "rate:=0")
    out, _ = process.communicate(timeout=WAIT_S)
    assert process.returncode == 0, out
    assert "fixes are coming" in out and "messages in" in out, out
    assert "Traceback" not in out and "has died" not in out
