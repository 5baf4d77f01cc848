# SPDX-License-Identifier: Apache-2.0
"""Each node ended or killed at work and started again: the others go on, and the fix is back, and right. Then all end."""

import math
import signal
import time
from itertools import cycle

import pytest

from starpos_interfaces.msg import Solution
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import SMALL, focal_of

# The simulated sky's.
LATITUDE_DEG, LONGITUDE_DEG = 35.7046, 51.4106
AIR = ("101325.0", "15.0", "0.5")
CADENCE_S, FOCAL_MM = 0.5, focal_of(SMALL) * 6.4e-3
NODES = {
    "camera": ("starpos_camera", (
        "source:=simulated", f"focal_mm:={FOCAL_MM}", "simulated.width:=1000", "simulated.height:=700",
        f"cadence:={CADENCE_S}", "exposure:=0.3",
    )),
    "detector": ("starpos_camera", ()),
    "inclinometer": ("starpos_inclinometer", ("port:={port}",)),
    "solver": ("starpos_solver", tuple(
        f"refraction.{name}:={value}"
        for name, value in zip(("pressure", "temperature", "humidity"), AIR, strict=True)
    )),
}  # fmt: skip


@pytest.fixture(scope="module")
def instrument(graph, tmp_path_factory):
    """All four nodes and an emulated inclinometer; a function that starts one of them."""
    from starpos.earth.refraction import Atmosphere
    from starpos.simulation.scene import scene_of

    folder, count = tmp_path_factory.mktemp("instrument"), iter(range(1000))
    port = folder / "port"
    air = Atmosphere(**dict(zip(("pressure_pa", "temperature_c", "humidity"), map(float, AIR), strict=True)))
    tilt = scene_of(SMALL, focal_of(SMALL), LATITUDE_DEG, LONGITUDE_DEG, air).tilt
    texts = [f"{math.degrees(t):.9f}" for t in tilt]
    emulated = ("--link", str(port), "--tilt-x", texts[0], "--tilt-y", texts[1])
    graph.start(folder / "emulator.log", "starpos_testing", "emulator", arguments=emulated)
    graph.wait(port.exists, "for the emulated port")

    def start(name):
        package, parameters = NODES[name]
        parameters = [p.format(port=port) for p in parameters]
        return graph.start(folder / f"{next(count)}-{name}.log", package, name, *parameters)

    running = {name: start(name) for name in NODES}
    wait_for_fix(graph, 0.0)
    return running, start


def wait_for_fix(graph, after_s: float) -> Solution:
    """The first fix of a frame exposed after that time (Unix s)."""
    found = []

    def fixed():
        found[:] = [s[-1] for stamp, s in graph.solutions.items() if stamp[0] + stamp[1] * 1e-9 > after_s]
        found[:] = [s for s in found if s.status == Solution.OK]
        return found

    graph.wait(fixed, "for a fix")
    return min(found, key=stamp_of)


# one that is ended says so, one that is killed leaves the others to find out
@pytest.mark.parametrize(
    ("name", "number"), [("solver", signal.SIGTERM), *((name, signal.SIGKILL) for name in NODES)]
)
def test_a_node_that_goes_and_comes_back(graph, instrument, record_property, name, number):
    running, start = instrument
    wait_for_fix(graph, time.time())
    begin = time.time()
    running[name].signal(number)
    assert running[name].wait() == (0 if number == signal.SIGTERM else -signal.SIGKILL)
    graph.processes.remove(running[name])
    running[name] = start(name)
    solution = wait_for_fix(graph, begin)
    seconds = time.time() - begin
    assert all(p.process.poll() is None for p in running.values()), "another node has gone with it"
    north = math.radians(solution.latitude - LATITUDE_DEG) * 6.371e6
    east = math.radians(solution.longitude - LONGITUDE_DEG) * 6.371e6 * math.cos(math.radians(LATITUDE_DEG))
    assert abs(east) < 5 * solution.covariance[0] ** 0.5 and abs(north) < 5 * solution.covariance[4] ** 0.5
    record_property("fault", f"{name}: {'SIGTERM' if number == signal.SIGTERM else 'kill -9'}, started again")
    record_property("result", f"the others go on; a right fix {seconds:.1f} s later")
    print(f"{name} {number.name}: a fix again after {seconds:.2f} s")


def test_all_at_work_end_with_status_0(graph, instrument):
    """End each by the two SIGINTs that launch sends, or by SIGTERM: the last of this file."""
    running, _ = instrument
    wait_for_fix(graph, time.time())
    emulator = next(p for p in graph.processes if p.name == "emulator")
    ending = (*running.values(), emulator)
    for process, signals in zip(ending, cycle(((signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)))):
        process.signal(*signals)
    for process in ending:
        assert process.wait() == 0, f"{process.name}: {process.output}"
        assert "Traceback" not in process.output, process.output
