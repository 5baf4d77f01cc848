# SPDX-License-Identifier: Apache-2.0
"""What the launch files would start: read by launch where it is installed, else by its stand-in; nothing is started."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from starpos_bringup.launch_arguments import LaunchError

pytestmark = pytest.mark.usefixtures("launch")

FOLDER = Path(__file__).parent.parent / "launch"
INSTRUMENT = ["camera_detector", "inclinometer", "solver"]


@dataclass(frozen=True)
class Process:
    """A process that would be started; parameters by node, from files before and after the user's."""

    namespace: str
    executable: str
    words: list[str]
    user_file: str
    less: dict[str, dict]
    more: dict[str, dict]
    respawn: bool
    on_exit: Any


def visited(entities, context):
    """The processes among the steps of a launch file, with the namespace that each is in."""
    from launch.actions import ExecuteProcess

    for entity in entities:
        if isinstance(entity, ExecuteProcess):
            yield process_of(entity, context)
        else:
            yield from visited(entity.visit(context) or (), context)


def process_of(action, context) -> Process:
    def text(parts):
        return "".join(context.perform_substitution(part) for part in parts)

    def parameters(paths):
        files = [yaml.safe_load(Path(path).read_text()) for path in paths]
        return {node: values["ros__parameters"] for file in files for node, values in file.items()}

    executable, *words = (text(word) for word in action.cmd)
    # launch has no public way to what begins with an underscore
    files = [text(file.param_file) for file in getattr(action, "_Node__parameters", ())]
    users = context.launch_configurations["params_file"]
    place = files.index(users) if files else 0
    return Process(
        namespace=context.launch_configurations.get("ros_namespace", "/"),
        executable=Path(executable).name,
        words=words,
        user_file=users,
        less=parameters(files[:place]),
        more=parameters(files[place + 1 :]),
        respawn=action._ExecuteLocal__respawn,
        on_exit=action._ExecuteLocal__on_exit,
    )


def module_of(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def processes_of(name, **given) -> list[Process]:
    """All that a launch file starts with these arguments, in its order."""
    from launch import LaunchContext

    context = LaunchContext()
    context.launch_configurations.update(given)
    return list(visited(module_of(name).generate_launch_description().entities, context))


def started(name, **given) -> dict[str, Process]:
    """Processes by executable, of a file that starts each once."""
    processes = processes_of(name, **given)
    assert len({p.executable for p in processes}) == len(processes)
    return {p.executable: p for p in processes}


def enclave_of(process) -> str:
    return process.words[process.words.index("--enclave") + 1]


@pytest.fixture
def bag(tmp_path):
    """The path of a bag, which is not opened."""
    (tmp_path / "night").mkdir()
    return str(tmp_path / "night")


def test_the_instrument_takes_the_arguments_it_names():
    silent = started("starpos")
    assert list(silent) == INSTRUMENT
    # What is not given, the file says.
    assert all(p.less == p.more == {} and p.namespace == "/" and not p.respawn for p in silent.values())
    assert {Path(p.user_file).name for p in silent.values()} == {"starpos.yaml"}
    told = started(
        "starpos",
        namespace="rover",
        port="/dev/x",
        use_sim_time="true",
        camera="indi",
        log_level="warn",
        dashboard="true",
        navigator="true",
        respawn="true",
    )
    clock = {"/**": {"use_sim_time": True}}
    own = {"/**/camera": {"source": "indi"}, "/**/inclinometer": {"port": "/dev/x"}}
    assert all(told[name].more == clock | own for name in INSTRUMENT)
    assert told["dashboard"].more == told["navigator"].more == clock
    assert told["solver"].words[:5] == ["--ros-args", "--log-level", "warn", "--enclave", "/starpos/solver"]
    assert all(p.namespace == "/rover" and p.respawn for p in told.values())


def test_a_parameter_file_of_the_users_is_that_of_each_process(tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("")
    assert {p.user_file for p in processes_of("starpos", params_file=str(mine))} == {str(mine)}


def test_each_process_is_in_its_enclave_of_the_policy(bag):
    policy = ElementTree.parse(FOLDER.parent / "sros2" / "policies.xml")
    enclaves = {e.attrib["path"] for e in policy.iter("enclave")}
    for name, given in (
        ("starpos", {"dashboard": "true", "navigator": "true"}),
        ("replay", {"bag": bag, "detector": "true"}),
        ("demo", {}),
    ):
        # the emulator is a device
        named = {enclave_of(p) for p in processes_of(name, **given) if p.executable != "emulator"}
        assert len(named) >= 3 and named <= enclaves
    assert enclave_of(started("starpos", enclaves="/rover/")["solver"]) == "/rover/solver"


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
        ("starpos", {"navigator": "yes"}, "navigator:=yes: give true or false"),
        ("starpos", {"dashboard": "yes"}, "dashboard:=yes: give true or false"),
        ("instruments", {"instruments": "left,left"}, "instruments:=left,left: give different names"),
        (
            "instruments",
            {"instruments": "left", "use_sim_time": "perhaps"},
            "use_sim_time:=perhaps: give true or false",
        ),
        ("demo", {"latitude": "abc"}, "latitude:=abc: give a number from -90 to 90"),
        ("demo", {"longitude": "500"}, "longitude:=500: give a number from -180 to 360"),
        ("demo", {"azimuth": "nan"}, "azimuth:=nan: give a number"),
        ("demo", {"altitude": "0"}, "altitude:=0: give a number from 5 to 90"),
        ("demo", {"cadence": ""}, "cadence:=: give a number"),
        ("demo", {"dashboard": "yes"}, "dashboard:=yes: give true or false"),
        ("demo", {"log_level": "loud"}, "log_level:=loud: give debug, info, warn, error, fatal"),
        ("replay", {"detector": "on"}, "detector:=on: give true or false"),
        ("replay", {"rate": "quick"}, "rate:=quick: give a number from 0"),
        ("replay", {"rate": "-1"}, "rate:=-1: give a number from 0"),
        ("replay", {"bag": "/nowhere/night"}, "bag:=/nowhere/night: there is no such bag"),
    ],
)
def test_a_wrong_argument_is_refused_in_a_sentence_and_nothing_starts(name, given, words, bag, tmp_path):
    (tmp_path / "robot.yaml").write_text("")
    needed = {"replay": {"bag": bag}, "instruments": {"params_file": str(tmp_path / "robot.yaml")}}
    with pytest.raises(LaunchError, match=words):
        processes_of(name, **(needed.get(name, {}) | given))


@pytest.mark.parametrize(
    ("name", "given", "missing"),
    [
        ("replay", {}, "bag"),
        ("instruments", {"instruments": "left"}, "params_file"),
        ("instruments", {"params_file": "robot.yaml"}, "instruments"),
    ],
)
def test_what_has_no_default_has_to_be_given(name, given, missing):
    with pytest.raises(RuntimeError, match=f'"{missing}" was not provided'):
        processes_of(name, **given)


@pytest.mark.parametrize(("above", "root"), [("", ""), ("rover", "/rover")])
def test_two_instruments_have_namespaces_frames_and_enclaves_of_their_own_and_one_file(above, root, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text("/left/solver:\n  ros__parameters: {min_stars: 7}\n")
    both = processes_of(
        "instruments",
        instruments="left,right",
        params_file=str(file),
        namespace=above,
        use_sim_time="true",
        respawn="true",
    )
    assert [p.executable for p in both] == 2 * INSTRUMENT
    for side, instrument in (("left", both[:3]), ("right", both[3:])):
        for process in instrument:
            assert process.namespace == f"{root}/{side}"
            assert process.user_file == str(file) and process.respawn
            assert process.more == {"/**": {"use_sim_time": True}}
            assert enclave_of(process) == f"/starpos/{side}/{process.executable}"
        # the file, which counts more, may name others
        frames = {
            f"/**/{node}": {"frame_id": f"{side}_{frame}"}
            for node, frame in (
                ("camera", "starpos_camera_optical_frame"),
                ("inclinometer", "starpos_inclinometer_frame"),
                ("solver", "starpos_link"),
            )
        }
        assert all(process.less == frames for process in instrument)


def test_a_robots_topics_are_remapped_and_its_own_fix_has_another_name():
    mine = str(FOLDER.parent / "config" / "existing_robot.yaml")
    topics = {"image": "/cam0/image_raw", "camera_info": "/cam0/camera_info", "imu": "/imu/data"}
    robot = started("robot", params_file=mine, use_sim_time="true", **topics)
    assert list(robot) == ["detector", "inclinometer", "solver"]
    remaps = {name: [w for w in p.words if ":=" in w] for name, p in robot.items()}
    image, info, imu = (
        f"{name}:={topics[key]}"
        for name, key in (
            ("camera/image_raw", "image"),
            ("camera/camera_info", "camera_info"),
            ("imu/data", "imu"),
        )
    )
    assert remaps == {"detector": [image, info, imu], "inclinometer": [imu], "solver": [info, imu]}
    assert robot["inclinometer"].more["/**/inclinometer"] == {"source": "imu"}
    assert {p.namespace for p in robot.values()} == {"/starpos"} and {
        p.user_file for p in robot.values()
    } == {mine}
    with pytest.raises(RuntimeError, match='"image" was not provided'):
        started("robot", params_file=mine)


def test_a_replay_takes_the_stars_or_finds_them_again(bag):
    stars = started("replay", bag=bag, rate="0", namespace="rover")
    assert list(stars) == ["solver", "replay"]
    assert stars["replay"].words[:6] == ["--rate", "0", "--inputs", "stars", "--", bag]
    assert stars["solver"].more == {"/**": {"use_sim_time": True}}
    # its own time is the bag's
    assert stars["replay"].more == {}
    assert {p.namespace for p in stars.values()} == {"/rover"}
    images = started("replay", bag=bag, detector="true", dashboard="true")
    assert list(images) == ["solver", "detector", "dashboard", "replay"]
    assert images["replay"].words[:4] == ["--rate", "1", "--inputs", "images"]
    assert images["detector"].more == images["dashboard"].more == {"/**": {"use_sim_time": True}}


def test_all_ends_with_the_player_and_a_replay_that_fails_is_an_error_of_launch(bag):
    from launch import LaunchContext
    from launch.actions import Shutdown

    replay = started("replay", bag=bag)
    assert replay["solver"].on_exit is None
    over = replay["replay"].on_exit
    assert isinstance(over(SimpleNamespace(returncode=0), LaunchContext()), Shutdown)
    for failed in (1, 2, -9):
        with pytest.raises(LaunchError, match=f"the replay ended with exit status {failed}:"):
            over(SimpleNamespace(returncode=failed), LaunchContext())


def test_the_demo_simulates_one_place_for_camera_solver_and_inclinometer():
    demo = started("demo", latitude="-30", longitude="100", cadence="5", namespace="rover")
    assert list(demo) == ["emulator", "inclinometer", "camera_detector", "solver", "dashboard"]
    assert "dashboard" not in started("demo", dashboard="false")
    camera, solver = demo["camera_detector"].more["/**/camera"], demo["solver"].more["/**/solver"]
    assert camera["source"] == "simulated" and camera["cadence"] == 5
    assert (camera["simulated.latitude"], camera["simulated.longitude"]) == (-30, 100)
    for air in ("pressure", "temperature", "humidity"):
        assert camera[f"simulated.{air}"] == solver[f"refraction.{air}"]
    device = dict(zip(demo["emulator"].words[::2], demo["emulator"].words[1::2], strict=True))
    assert demo["inclinometer"].more == {"/**/inclinometer": {"port": device["--link"]}}
    # at an altitude of 78 deg, 12 deg from the zenith; the misalignment is half a degree
    assert abs((float(device["--tilt-x"]) ** 2 + float(device["--tilt-y"]) ** 2) ** 0.5 - 12) < 0.6
    assert {p.namespace for p in demo.values()} == {"/rover"}
