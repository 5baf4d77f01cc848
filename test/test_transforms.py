# SPDX-License-Identifier: Apache-2.0
"""The transforms of the instrument on /tf_static, as who listens later hears them."""

from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.instrument import instrument_file
from starpos.instrument.instrument import Calibration, Instrument
from starpos_testing.graph.shots import FULL_FOCAL_PX, SOLVER, shoot

TF = "/tf_static"
# x of the link is the camera's z, y its x: a camera that looks ahead
AHEAD = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
MISALIGNMENT_DEG = (0.4, -0.3, 35.0)


def latest(heard) -> dict[tuple[str, str], np.ndarray]:
    """The newest quaternions that were heard, by parent and child."""
    return {tuple(names): np.array(pose[3:]) for _, names, pose in heard()}


def turned(quaternion: np.ndarray, vector) -> np.ndarray:
    return Rotation.from_quat(quaternion).apply(vector)


def test_who_listens_later_hears_how_camera_and_inclinometer_are_turned(graph, run, listen, tmp_path):
    calibration = Calibration.of(MISALIGNMENT_DEG, (5.0,) * 3)
    instrument = Instrument(FULL_FOCAL_PX, calibration=calibration, link_to_camera=AHEAD)
    instrument_file.write(tmp_path / "i.yaml", instrument)
    run(
        "starpos_solver",
        "solver",
        *SOLVER,
        f"calibration_url:={tmp_path / 'i.yaml'}",
        "frame_id:=rover/mount",
    )
    graph.wait_for_solver()
    shot = shoot()
    graph.answer(shot)
    camera, inclinometer = shot.info.header.frame_id, shot.tilts[0].header.frame_id
    heard = listen(TF, "latched")
    graph.wait(lambda: len(heard()) >= 2)
    transforms = latest(heard)
    assert set(transforms) == {("rover/mount", camera), (camera, inclinometer)}
    # The optical axis, as the link sees it.
    axis = turned(transforms["rover/mount", camera], (0, 0, 1))
    np.testing.assert_allclose(axis, (1, 0, 0), atol=1e-12)
    # A3 takes the camera into the inclinometer, tf the child into the parent
    back = turned(transforms[camera, inclinometer], calibration.a3 @ (0.1, 0.2, 0.9))
    np.testing.assert_allclose(back, (0.1, 0.2, 0.9), atol=1e-12)

    assert graph.set("solver", misalignment_stddev=5.0, calibration_url="", frame_id="starpos_link")[0]
    graph.wait(lambda: ("starpos_link", camera) in latest(heard))
    assert graph.set("solver", publish_tf=False) == (True, "")
    graph.wait(lambda: graph.node.count_publishers(TF) == 0)


def test_an_inclinometer_that_nobody_has_measured_is_in_no_tree(graph, run, listen):
    run("starpos_solver", "solver")
    graph.wait_for_solver()
    graph.answer(shoot())
    heard = listen(TF, "latched")
    graph.wait(heard)
    assert [child for _, child in latest(heard)] == ["starpos_camera_optical_frame"]


@pytest.mark.skipif(find_spec("tf2_msgs") is not None, reason="tf2_msgs is installed here")
def test_without_tf2_msgs_a_sentence_says_so_once(graph, run):
    solver = run("starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    for _ in range(2):
        graph.answer(shoot())
    assert solver.output.count("tf2_msgs is not installed, so there is no /tf_static") == 1
    assert graph.node.count_publishers(TF) == 0
