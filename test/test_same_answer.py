# SPDX-License-Identifier: Apache-2.0
"""The running graph and the command line on the same simulated night: topics on the one side, files on the other."""

import csv
import io
import json
import math
from contextlib import redirect_stdout

import pytest

from starpos.cli import main
from starpos.instrument.inclinometer import Tilt
from starpos_common.messages import tilt_to_message
from starpos_interfaces import msg
from starpos_testing.command_line import SENSOR
from starpos_testing.graph.shots import focal_of

SIZE = (1000, 700)
FOCAL_MM, PIXEL_UM = focal_of(SIZE) * 6.4e-3, 6.4
AIR = ("--pressure-hpa", "880", "--temperature-c", "12", "--humidity", "0.3")
MISALIGNMENT = ("0.4", "-0.3", "0.7")
FRAMES = 3
CLOCK_S = 0.01


def starpos(*words) -> str:
    with redirect_stdout(io.StringIO()) as out:
        assert main([*map(str, words)]) == 0
    return out.getvalue()


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A folder of frames, tilt.csv and truth.json."""
    folder = tmp_path_factory.mktemp("night")
    starpos("simulate", folder, "-n", FRAMES, "--size", *SIZE, "--focal-mm", FOCAL_MM, "--pixel-um", PIXEL_UM, *AIR,
            "--misalignment", *MISALIGNMENT, "--latitude", -33.9, "--longitude", 18.4, "--turn", 100)  # fmt: skip
    return folder


def read_tilts(path) -> list[msg.Tilt]:
    """The rows of a tilt.csv; their covariance is left unknown."""
    with path.open() as f:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(f)]
    tilts = []
    for n, row in enumerate(rows):
        angles = (math.radians(row[name]) for name in ("theta_x_deg", "theta_y_deg"))
        tilt = tilt_to_message(Tilt(*angles, [[1, 0], [0, 1]], utc_unix_s=row["utc_unix_s"]), "tilt", n)
        tilt.covariance = [0.0] * 4
        tilts.append(tilt)
    return tilts


def test_the_graph_and_the_command_line_agree(graph, run, night):
    frames = sorted(night.glob("*.fits"))
    lines = starpos("solve", *frames, "--tilt", night / "tilt.csv", "--focal-mm", FOCAL_MM, "--pixel-um", PIXEL_UM,
                    "--misalignment", *MISALIGNMENT, "--misalignment-stddev", 5,
                    *SENSOR, "--clock-stddev", CLOCK_S, *AIR,
                    "--json").splitlines()  # fmt: skip
    expected = [json.loads(line) for line in lines][:FRAMES]

    misalignment = ",".join(MISALIGNMENT)
    air = ("refraction.pressure:=88000.0", "refraction.temperature:=12.0", "refraction.humidity:=0.3")
    run("starpos_solver", "solver", f"misalignment:=[{misalignment}]", "misalignment_stddev:=5.0",
        "inclinometer.model:=sca100t_calibrated",
        f"clock_stddev:={CLOCK_S}", "tilt_timeout:=20.0", *air)  # fmt: skip
    run("starpos_camera", "detector")
    graph.wait(lambda: graph.tilt.get_subscription_count() and graph.node.count_publishers("stars") == 2)
    for tilt in read_tilts(night / "tilt.csv"):
        graph.tilt.publish(tilt)
    run("starpos_camera", "camera", f"files.path:={night}", f"focal_mm:={FOCAL_MM}", f"pixel_um:={PIXEL_UM}",
        "cadence:=1.0", "files.loop:=true")  # fmt: skip  # again until solver and detector have met
    # the first ones may come before detector and camera have found each other's `capture`, which knows the shutter
    stars = graph.hear(msg.StarArray, "stars")
    graph.wait(lambda: any(s.shutter_known for s in stars), "for a frame with its Capture")
    graph.solutions.clear()
    # the answer to a frame before it may still come: each frame's last one counts
    graph.wait(
        lambda: len(graph.solutions) == FRAMES and sum(map(len, graph.solutions.values())) > FRAMES + 1,
        "for all frames",
    )

    truth = json.loads((night / "truth.json").read_text())
    got = [graph.solutions[stamp][-1] for stamp in sorted(graph.solutions)]
    for want, solution, frame in zip(expected, got, truth["frames"], strict=True):
        assert (solution.status, want["status"]) == (msg.Solution.OK, "ok"), solution.status_text
        for name in ("latitude", "longitude", "heading"):
            # A millimetre: the solver starts from its last fix.
            assert getattr(solution, name) == pytest.approx(want[name], abs=1e-8), name
        assert list(solution.covariance) == pytest.approx(
            [v for row in want["covariance"] for v in row], rel=1e-6
        )
        assert (solution.stars_detected, solution.stars_matched) == (
            want["stars_detected"],
            want["stars_matched"],
        )
        off_m = (solution.latitude - truth["latitude_deg"]) * 111_000
        assert abs(off_m) < 4 * solution.covariance[4] ** 0.5
        turned = (solution.heading - frame["heading_deg"] + 180) % 360 - 180
        assert abs(turned) < 4 * solution.heading_stddev
