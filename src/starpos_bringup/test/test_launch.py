# SPDX-License-Identifier: Apache-2.0
"""The launch files, where launch is installed: it is no part of the ROS that PyPI carries."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from sensor_msgs.msg import NavSatFix

from starpos_testing.nodes import Listener, take_domain
from starpos_testing.patience import WAIT_S

pytest.importorskip("launch_ros", reason="ros2/launch_ros is not installed here")

import launch
import launch_ros

from starpos_bringup.launch_arguments import LaunchError

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


def module_of(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def started(name, **given):
    """The executables it starts, each with the parameters that go over the file's, and its arguments."""
    module, context = module_of(name), launch.LaunchContext()
    for entity in module.generate_launch_description().entities:
        if isinstance(entity, launch.actions.DeclareLaunchArgument):
            default = launch.utilities.perform_substitutions(context, entity.default_value or [])
            context.launch_configurations[entity.name] = given.get(entity.name, default)
    processes = {}
    for action in module.nodes(context):
        if not isinstance(action, launch_ros.actions.Node):
            continue
        files = [
            launch.utilities.perform_substitutions(context, f.param_file)
            # launch_ros has no public way to them.
            for f in action._Node__parameters
        ]
        over = yaml.safe_load(Path(files[-1]).read_text()) if len(files) > 1 else {}
        words = [w for w in action._Node__arguments if isinstance(w, str)]
        processes[action.node_executable] = ({k: v["ros__parameters"] for k, v in over.items()}, words)
    return processes


def test_the_instrument_takes_the_arguments_it_names():
    assert {name for name, _, _ in module_of("starpos").ARGUMENTS} >= {
        "namespace", "params_file", "use_sim_time", "camera", "port", "log_level",
    }  # fmt: skip
    silent = started("starpos")
    assert list(silent) == ["camera_detector", "inclinometer", "solver"]
    # What is not given, the file says.
    assert all(over == {} for over, _ in silent.values())
    told = started(
        "starpos",
        port="/dev/x",
        use_sim_time="true",
        camera="indi",
        log_level="warn",
        dashboard="true",
        navigator="true",
    )
    assert told["camera_detector"][0] == {"/**": {"use_sim_time": True}, "/**/camera": {"source": "indi"}}
    assert told["inclinometer"][0]["/**/inclinometer"] == {"port": "/dev/x"}
    assert told["solver"][1] == ["--ros-args", "--log-level", "warn", "--enclave", "/starpos/solver"]
    assert told["dashboard"][0] == told["navigator"][0] == {"/**": {"use_sim_time": True}}


def test_each_process_is_in_its_enclave_of_the_policy():
    policy = ElementTree.parse(FOLDER.parent / "sros2" / "policies.xml")
    enclaves = {e.attrib["path"] for e in policy.iter("enclave")}
    for name, given in (
        ("starpos", {"dashboard": "true", "navigator": "true"}),
        ("replay", {"bag": str(NIGHT), "detector": "true"}),
        ("demo", {}),
    ):
        named = {words[words.index("--enclave") + 1] for _, words in started(name, **given).values()}
        assert len(named) >= 3 and named <= enclaves
    elsewhere = started("starpos", enclaves="/rover/")["solver"][1]
    assert elsewhere[-1] == "/rover/solver"


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        (
            "starpos",
            {"params_file": "/nowhere/mine.yaml"},
            "params_file:=/nowhere/mine.yaml: there is no such file",
        ),
        ("starpos", {"use_sim_time": "perhaps"}, "use_sim_time:=perhaps: give true or false"),
        ("starpos", {"respawn": "yes"}, "respawn:=yes: give true or false"),
        ("replay", {"bag": str(NIGHT), "detector": "on"}, "detector:=on: give true or false"),
        ("demo", {"latitude": "abc"}, "latitude:=abc: give a number from -90 to 90"),
        ("demo", {"cadence": ""}, "cadence:=: give a number"),
        ("demo", {"log_level": "loud"}, "log_level:=loud: give debug, info, warn, error, fatal"),
        ("replay", {"bag": str(NIGHT), "rate": "quick"}, "rate:=quick: give a number from 0"),
        ("replay", {"bag": "/nowhere/night"}, "bag:=/nowhere/night: there is no such bag"),
    ],
)
def test_a_wrong_argument_is_refused_in_a_sentence_and_nothing_starts(name, given, words):
    with pytest.raises(LaunchError, match=words):
        started(name, **given)


def test_two_instruments_have_frames_and_enclaves_of_their_own_and_one_file(tmp_path):
    (tmp_path / "robot.yaml").write_text("/left/solver:\n  ros__parameters: {min_stars: 7}\n")
    module, context = module_of("instruments"), launch.LaunchContext()
    given = {
        "instruments": "left,right",
        "params_file": str(tmp_path / "robot.yaml"),
        "enclaves": "/starpos",
        "log_level": "info",
    }
    for name, _, _ in module.ARGUMENTS:
        context.launch_configurations[name] = given.get(name, "false" if name == "respawn" else "")
    for side, group in zip(("left", "right"), module.nodes(context), strict=True):
        inside = group.get_sub_entities()
        processes = [a for a in inside if isinstance(a, launch_ros.actions.Node)]
        assert [p.node_executable for p in processes] == ["camera_detector", "inclinometer", "solver"]
        solver = processes[-1]
        defaults, file = (
            launch.utilities.perform_substitutions(context, f.param_file) for f in solver._Node__parameters
        )
        # A later one counts more.
        assert file == given["params_file"]
        frames = yaml.safe_load(Path(defaults).read_text())
        assert frames == {"/**/solver": {"ros__parameters": {"frame_id": f"{side}_starpos_link"}}}
        assert f"/starpos/{side}/solver" in solver._Node__arguments


def test_a_replay_takes_the_stars_or_finds_them_again():
    stars = started("replay", bag=str(NIGHT), rate="0")
    assert list(stars) == ["solver", "replay"]
    assert stars["replay"][1][:6] == ["--rate", "0", "--inputs", "stars", "--", str(NIGHT)]
    assert stars["solver"][0] == {"/**": {"use_sim_time": True}}
    images = started("replay", bag=str(NIGHT), detector="true")
    assert "detector" in images and "images" in images["replay"][1]


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
