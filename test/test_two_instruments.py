# SPDX-License-Identifier: Apache-2.0
"""Two instruments on one robot: namespaces of their own, one parameter file."""

import pytest
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import CameraInfo, NavSatFix

from starpos.session.settings import Settings
from starpos_interfaces.msg import StarArray, Tilt
from starpos_testing.graph.shots import PRESSURE_PA, TEMPERATURE_C, shoot

ROBOT = f"""
/**/solver:
  ros__parameters:
    refraction: {{pressure: {PRESSURE_PA}, temperature: {TEMPERATURE_C}}}
    misalignment_stddev: 5.0
/left/solver:
  ros__parameters: {{frame_id: left_starpos_link, min_stars: 6}}
/right/solver:
  ros__parameters: {{frame_id: right_starpos_link, misalignment_stddev: 0.5}}
"""
NAMES = ("frame_id", "min_stars", "misalignment_stddev", "refraction.pressure")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    return path


@pytest.fixture
def both(graph, run, file):
    for side in ("left", "right"):
        options = ("--ros-args", "-r", f"__ns:=/{side}", "--params-file", str(file))
        run("starpos_solver", "solver", arguments=options)


def parameters(graph, side: str) -> list:
    answer = graph.call(GetParameters, f"/{side}/solver/get_parameters", GetParameters.Request(names=NAMES))
    kinds = ("string_value", "integer_value", "double_value", "double_value")
    return [getattr(value, kind) for value, kind in zip(answer.values, kinds, strict=True)]


@pytest.mark.usefixtures("both")
def test_each_has_its_parameters_and_what_is_for_both_and_so_has_starpos_replay(graph, file):
    left, right = parameters(graph, "left"), parameters(graph, "right")
    assert left == ["left_starpos_link", 6, 5.0, PRESSURE_PA]
    assert right == ["right_starpos_link", 5, 0.5, PRESSURE_PA]
    for side, values in (("left", left), ("right", right)):
        alone = Settings.of(file, (), side).values
        assert [alone[name] for name in NAMES] == values


@pytest.mark.usefixtures("both")
def test_each_makes_the_fixes_of_its_own_camera(graph):
    heard = {side: graph.hear(NavSatFix, f"/{side}/fix") for side in ("left", "right")}
    kinds = ((CameraInfo, "camera/camera_info"), (Tilt, "tilt"), (StarArray, "stars"))
    ways = {side: [graph.node.create_publisher(k, f"/{side}/{t}", 100) for k, t in kinds] for side in heard}
    graph.wait(lambda: all(p.get_subscription_count() for ps in ways.values() for p in ps))
    graph.wait(lambda: all(graph.node.count_publishers(f"/{side}/fix") for side in heard))
    for side, (info, tilt, stars) in ways.items():
        shot = shoot()
        info.publish(shot.info)
        for message in shot.tilts:
            tilt.publish(message)
        stars.publish(shot.stars)
        graph.wait(lambda side=side: heard[side], f"for the fix of {side}")
        fix = heard[side][0]
        assert fix.status.status >= 0 and fix.header.frame_id == f"{side}_starpos_link"
        assert fix.header.stamp == shot.stars.header.stamp
    assert [len(fixes) for fixes in heard.values()] == [1, 1]
