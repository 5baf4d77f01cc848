# SPDX-License-Identifier: Apache-2.0
"""kill -9 in the middle of saving: the file is whole, the old one or the new one; what is left over does no harm."""

import random
import signal
import subprocess
import sys

from sensor_msgs.srv import SetCameraInfo

from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos_common.messages import camera_to_message
from starpos_interfaces.srv import SaveCalibration
from starpos_testing.graph.shots import FULL_FOCAL_PX, SMALL, SOLVER, focal_of, shoot
from starpos_testing.patience import WAIT_S

KILLS = 40
# that a service keeps, and after how many the node is killed
CALLS, ANSWERED = 8, 2
# Forks a child that saves two contents in turn, kills it at a random moment after some, looks at the file; returns the
# counts of each.
KILLER = """
import os, random, signal, sys, time
from pathlib import Path
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument

folder, kills = Path(sys.argv[1]), int(sys.argv[2])
random.seed(int(sys.argv[3]))
cameras = [Camera.from_focal(100, 80, focal) for focal in (1000.0, 2000.0)]
files = {
    "instrument.yaml": (lambda p, c: instrument_file.write(p, Instrument(c.fx, camera=c)),
                        lambda p: instrument_file.read(p).focal_px),
    "camera.yaml": (lambda p, c: instrument_file.write_camera(p, c, "camera"),
                    lambda p: instrument_file.read_camera(p).fx),
}
for name, (write, read) in files.items():
    path, found = folder / name, []
    write(path, cameras[0])
    begin = time.perf_counter()
    write(path, cameras[0])
    once_s = time.perf_counter() - begin
    for _ in range(kills):
        saved, tell = os.pipe()
        child = os.fork()
        if child == 0:
            while True:
                for camera in cameras:
                    write(path, camera)
                    os.write(tell, b".")
        os.close(tell)
        for _ in range(random.randrange(6)):
            os.read(saved, 1)
        time.sleep(random.uniform(0, 2 * once_s))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(saved)
        found.append(read(path))
    print(name, found.count(1000.0), found.count(2000.0))
"""


def test_a_file_is_the_old_or_the_new_one_whenever_its_writer_is_killed(tmp_path, record_property):
    seed = random.randrange(2**32)
    made = subprocess.run([sys.executable, "-c", KILLER, str(tmp_path), str(KILLS), str(seed)],
                          check=False, capture_output=True, text=True, timeout=WAIT_S)  # fmt: skip
    assert made.returncode == 0, f"seed {seed}: {made.stderr}"
    for line in made.stdout.splitlines():
        _, old, new = line.split()
        assert int(old) + int(new) == KILLS and int(old) and int(new), f"seed {seed}: {line}"
    record_property("fault", f"kill -9 at any moment of saving, {KILLS} times for each kind of file")
    record_property("result", f"always a whole file: {'; '.join(made.stdout.splitlines())}")


def test_a_solver_killed_while_it_saves_starts_again_with_a_whole_file(graph, run, tmp_path):
    path = tmp_path / "instrument.yaml"
    instrument_file.write(path, Instrument(FULL_FOCAL_PX))
    (tmp_path / ".instrument.yaml.left").write_text("starpos_instrument: 1\nmisalignment_deg: [0")
    process = run("starpos_solver", "solver", *SOLVER, f"calibration_url:={path}")
    graph.wait(lambda: _is_solved(graph), "for a fix")
    client = graph.node.create_client(SaveCalibration, "solver/save_calibration")
    graph.wait(client.service_is_ready)
    graph.wait(lambda: graph.comes(client.call_async(SaveCalibration.Request()).done, 1.0))
    asked = [client.call_async(SaveCalibration.Request()) for _ in range(CALLS)]
    graph.wait(asked[ANSWERED].done)
    process.signal(signal.SIGKILL)
    process.wait()
    graph.node.destroy_client(client)
    assert instrument_file.read(path).focal_px == FULL_FOCAL_PX
    again = run("starpos_solver", "solver", *SOLVER, f"calibration_url:={path}")
    graph.solutions.clear()
    graph.wait(lambda: _is_solved(graph), "for a fix with the calibration that was kept")
    assert again.process.poll() is None


def _is_solved(graph) -> bool:
    shot = shoot()
    graph.send(shot)
    graph.comes(lambda: shot.stamp in graph.solutions, 1.0)
    return any(s.status == s.OK for s in graph.solutions.get(shot.stamp, ()))


def test_a_camera_killed_while_it_saves_starts_again_with_a_whole_file(graph, run, tmp_path):
    path = tmp_path / "camera.yaml"
    cameras = [Camera.from_focal(*SMALL, focal_of(SMALL) * k) for k in (1.0, 1.01)]
    instrument_file.write_camera(path, cameras[0], "camera")
    size = (f"simulated.width:={SMALL[0]}", f"simulated.height:={SMALL[1]}")
    parameters = ("source:=simulated", *size, "cadence:=100.0", f"calibration_url:={path}")
    process = run("starpos_camera", "camera", *parameters)
    client = graph.node.create_client(SetCameraInfo, "camera/set_camera_info")
    graph.wait(client.service_is_ready)
    requests = [SetCameraInfo.Request(camera_info=camera_to_message(c, "camera")) for c in cameras] * (
        CALLS // 2
    )
    graph.wait(lambda: graph.comes(client.call_async(requests[0]).done, 1.0))
    asked = [client.call_async(request) for request in requests]
    graph.wait(asked[ANSWERED].done)
    process.signal(signal.SIGKILL)
    process.wait()
    graph.node.destroy_client(client)
    assert instrument_file.read_camera(path) in cameras
    again = run("starpos_camera", "camera", *parameters)
    graph.wait(lambda: graph.state("camera: Capture", "").level is not None)
    values = {v.key: v.value for v in graph.state("camera: Capture", "").values}
    assert values["calibrated"] == "True" and again.process.poll() is None
