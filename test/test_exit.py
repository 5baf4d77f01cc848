# SPDX-License-Identifier: Apache-2.0
"""Every executable ends cleanly on SIGTERM and on the two SIGINTs that launch sends, in the middle of its work."""

import signal
from itertools import cycle

WAYS = ((signal.SIGINT, signal.SIGINT), (signal.SIGTERM,))
CAMERA = (
    "source:=simulated",
    "focal_mm:=14.8",
    "simulated.width:=640",
    "simulated.height:=427",
    "cadence:=0.5",
)


def test_all_at_work_end_with_status_0(graph, run, tmp_path):
    """All have one main function, whose every signal test_node_main.py sends: each gets one kind of them here."""
    port = tmp_path / "port"
    emulator = run("starpos_testing", "emulator", arguments=("--link", str(port), "--tilt-x", "3"))
    graph.wait(port.exists, "for the emulated port")
    processes = [
        run("starpos_camera", "camera", *CAMERA),
        run("starpos_camera", "detector"),
        run("starpos_inclinometer", "inclinometer", f"port:={port}"),
        run("starpos_solver", "solver", "tilt_timeout:=0.1"),
    ]
    graph.solutions.clear()
    graph.wait(lambda: graph.solutions, "for the first solution, whatever it says")
    graph.diagnostics.clear()
    names = {"camera: Capture", "detector: Stars", "inclinometer: Link", "solver: Solution", "solver: Inputs"}
    graph.wait(lambda: names <= set(graph.diagnostics), "for everybody's diagnostics")
    for process, signals in zip((*processes, emulator), cycle(WAYS)):
        process.signal(*signals)
    for process in (*processes, emulator):
        assert process.wait() == 0, f"{process.name}: {process.output}"
        assert "Traceback" not in process.output, process.output


def test_a_bad_start_is_one_line_and_status_1(graph, run):
    started = [
        run("starpos_solver", "solver", "min_stars:=1"),
        run("starpos_camera", "camera", "source:=nothing"),
        run("starpos_camera", "detector", "threshold:=-1.0"),
        run("starpos_inclinometer", "inclinometer", "rate:=0"),
    ]
    for process in started:
        assert process.wait() == 1
        (line,) = process.output.splitlines()
        assert line.startswith(process.name) and "must be" in line, line
