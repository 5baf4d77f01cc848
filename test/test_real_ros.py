# SPDX-License-Identifier: Apache-2.0
"""The real `ros2 launch`, tf2, rosbag2 and robot_localization; each test skips where its program is absent.

PyPI's ROS has none of them: these tests run in a ros:jazzy container (.github/workflows/ci.yml).
"""

import json
import signal
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from sensor_msgs.msg import NavSatFix

from starpos_testing.graph.graph import Graph
from starpos_testing.patience import WAIT_S

PLACE = {"latitude": 48.1, "longitude": 11.6}
# the parameters that demo.launch.py gives its solver
AIR = ("refraction.pressure:=95000.0", "refraction.temperature:=8.0", "refraction.humidity:=0.4")
KNOWN = (*AIR, "misalignment:=[0.4, -0.3, 12.0]", "misalignment_stddev:=5.0")
CAMERA, INCLINOMETER, LINK = "starpos_camera_optical_frame", "starpos_inclinometer_frame", "starpos_link"


def has(package: str) -> bool:
    try:
        return bool(get_package_share_directory(package))
    except PackageNotFoundError:
        return False


def needs(*packages: str) -> pytest.MarkDecorator:
    """A mark of tests that skip without packages of ROS; with STARPOS_COMPLETE, too, unlike `lacking.needs`.

    No machine with PyPI's ROS can bring them, so a complete one lacks them as well.
    """
    absent = [package for package in packages if not has(package)]
    return pytest.mark.skipif(bool(absent), reason=f"ROS from apt alone has {', '.join(packages)}")


@contextmanager
def started(log: Path, *words: str):
    """A command that runs meanwhile and is ended as Ctrl-C ends it; yields how to read what it has said."""
    with log.open("w") as out, subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT) as process:
        try:
            yield log.read_text
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()


@pytest.fixture(scope="module")
def graph(domain):
    """A node that only listens: a second publisher of tilts would look like a second instrument."""
    graph = Graph()
    for publisher in (graph.info, graph.capture, graph.stars, graph.tilt):
        graph.node.destroy_publisher(publisher)
    yield graph
    graph.close()


@pytest.fixture(scope="module")
def fixes(graph):
    return graph.hear(NavSatFix, "fix")


@pytest.fixture(scope="module")
def demo(graph, fixes, tmp_path_factory):
    """The launch file of the simulated instrument, which has given a fix; its processes end cleanly."""
    log = tmp_path_factory.mktemp("demo") / "launch.log"
    place = [f"{name}:={value}" for name, value in PLACE.items()]
    with started(
        log, "ros2", "launch", "starpos_bringup", "demo.launch.py", "dashboard:=false", *place
    ) as said:
        graph.wait(lambda: any(fix.status.status >= 0 for fix in fixes), "for a fix of the demo")
        yield said
    assert said().count("process has finished cleanly") == said().count("process started with pid") == 4, (
        said()
    )


@needs("ros2launch")
def test_the_instrument_that_ros2_launch_starts_gives_its_place(demo, fixes):
    [fix] = [fix for fix in fixes if fix.status.status >= 0][-1:]
    sigma_deg = max(fix.position_covariance[0], fix.position_covariance[4]) ** 0.5 / 111e3
    assert abs(fix.latitude - PLACE["latitude"]) < 5 * sigma_deg < 0.1


@needs("ros2launch")
@pytest.mark.parametrize("name", ["starpos", "instruments", "replay", "demo"])
def test_ros2_launch_reads_every_launch_file(name):
    words = ["ros2", "launch", "starpos_bringup", f"{name}.launch.py", "--show-args"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0 and "'log_level'" in done.stdout, done.stderr


@needs("ros2launch", "tf2_ros")
@pytest.mark.usefixtures("demo")
def test_tf2_knows_how_camera_and_inclinometer_sit_on_the_robot(graph):
    from rclpy.time import Time
    from tf2_ros import Buffer, TransformListener

    tree = Buffer()
    TransformListener(tree, graph.node)
    for frame in (CAMERA, INCLINOMETER):
        graph.wait(lambda frame=frame: tree.can_transform(LINK, frame, Time()), f"for {LINK} -> {frame}")


@pytest.fixture(scope="module")
def recorded(demo, graph, fixes, tmp_path_factory):
    """A bag of the demo by `ros2 bag record`."""
    folder = tmp_path_factory.mktemp("recorded")
    topics, before = ["/stars", "/tilt", "/camera/camera_info"], len(fixes)
    with started(folder / "log", "ros2", "bag", "record", "-o", str(folder / "night"), *topics):
        # the frame that is under way when the recorder begins may lack its tilts
        graph.wait(lambda: len(fixes) >= before + 5, "for fixes while a bag is recorded")
    return folder / "night"


@needs("ros2launch", "ros2bag")
def test_a_night_that_ros2_bag_records_is_worked_by_starpos_replay(recorded):
    words = ["starpos", "replay", str(recorded), "--json", *(word for p in KNOWN for word in ("-p", p))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 0, done.stderr
    whole = json.loads(done.stdout.splitlines()[-1])
    assert whole["combined"] and abs(whole["latitude"] - PLACE["latitude"]) < 0.1


@needs("ros2launch", "ros2bag")
def test_a_solver_finds_the_place_of_a_night_that_ros2_bag_plays(recorded, graph, run, tmp_path):
    fixes = graph.hear(NavSatFix, "played/fix")
    moved = ("--ros-args", "-r", "__ns:=/played")
    run("starpos_solver", "solver", "use_sim_time:=true", *KNOWN, arguments=moved)
    renamed = [f"/{topic}:=/played/{topic}" for topic in ("stars", "tilt", "camera/camera_info")]
    play = ("ros2", "bag", "play", str(recorded), "--clock", "--delay", "5", "--remap", *renamed)
    with started(tmp_path / "log", *play):
        graph.wait(lambda: any(fix.status.status >= 0 for fix in fixes), "for a fix of the played night")
    assert abs([fix for fix in fixes if fix.status.status >= 0][-1].latitude - PLACE["latitude"]) < 0.1


@needs("ros2launch", "robot_localization", "tf2_ros")
@pytest.mark.usefixtures("demo")
def test_robot_localization_takes_the_recipe_and_gives_a_map(graph, tmp_path):
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.time import Time
    from tf2_ros import Buffer, StaticTransformBroadcaster, TransformListener

    recipe = Path(get_package_share_directory("starpos_bringup")) / "config" / "robot_localization.yaml"
    assert graph.set("solver", altitude=500.0, altitude_stddev=20.0)[0]
    tree, standing = Buffer(), graph.node.create_publisher(Odometry, "wheel/odometry", 10)
    TransformListener(tree, graph.node)
    still = StaticTransformBroadcaster(graph.node)
    links = [TransformStamped(child_frame_id=child) for child in ("base_link", LINK)]
    for link, parent in zip(links, ("odom", "base_link"), strict=True):
        link.header.frame_id, link.transform.rotation.w = parent, 1.0
    still.sendTransform(links)
    places = graph.hear(Odometry, "odometry/global")

    def stand():
        message = Odometry(child_frame_id="base_link")
        message.header.frame_id = "odom"
        message.header.stamp = graph.node.get_clock().now().to_msg()
        message.pose.pose.orientation.w = 1.0
        message.twist.covariance = [1e-4 if k % 7 == 0 else 0.0 for k in range(36)]
        standing.publish(message)
        return tree.can_transform("map", "odom", Time()) and places and places[-1].pose.covariance[0] < 1e6

    parameters = ("--params-file", str(recipe), "-r", "odometry/filtered:=odometry/global")
    ekf = ("ros2", "run", "robot_localization", "ekf_node", "--ros-args", "-r", "__node:=ekf_map")
    navsat = (
        "ros2",
        "run",
        "robot_localization",
        "navsat_transform_node",
        "--ros-args",
        "-r",
        "gps/fix:=fix",
    )
    with (
        started(tmp_path / "ekf", *ekf, *parameters) as filtered,
        started(tmp_path / "navsat", *navsat, *parameters) as placed,
    ):
        graph.wait(stand, "for a map that the fixes hold")
        assert "[ERROR]" not in filtered() + placed()
    # the first fix is the map's origin, and the robot stands
    assert abs(places[-1].pose.pose.position.x) < 5 * places[-1].pose.covariance[0] ** 0.5
