# SPDX-License-Identifier: Apache-2.0
"""Satellites through the running solver: a place without the inclinometer, which then teaches A3; and the recording."""

import math
import signal
from dataclasses import replace

import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix

from starpos.earth.gravity import itrs_place
from starpos.earth.orientation import earth_state
from starpos.frames.frame import FrameTrail
from starpos.rotation import normalised
from starpos.satellites.elements import read_orbits
from starpos.satellites.orbits import Moments, observed, states
from starpos.session.replay import replay
from starpos_common.messages import trails_to_message
from starpos_interfaces.msg import Solution, TrailArray
from starpos_testing.graph import shots
from starpos_testing.skies import orbits

STEP_S = 20.0
LATITUDE, LONGITUDE = np.radians([shots.LATITUDE_DEG, shots.LONGITUDE_DEG])
SOLVER = (
    *(p for p in shots.SOLVER if not p.startswith("misalignment")),
    "gnss.use:=true",
    "clock_stddev:=0.001",
    "altitude:=0.0",
    "altitude_stddev:=20.0",
)
FRAMES, SIGMA_PX = 14, 0.3


class Dusk:
    """Frames that each look at a satellite somewhere overhead, with its trail."""

    def __init__(self, path):
        path.write_text(orbits.drawn(2500, 5, shots.START_S - 86400)[1])
        self.orbits, _ = read_orbits(path)
        self.rng, self.at_s = np.random.default_rng(3), shots.START_S
        self.site = itrs_place(LATITUDE, LONGITUDE, 0.0)

    def directions(self, which, utc_unix_s):
        """Directions (n, 3) among the catalogue places of the stars at a time."""
        moments = Moments.at(np.full(len(which), utc_unix_s))
        r, v = states(which, moments, np.zeros(len(which)))
        return observed(r, v, moments.site(self.site, 0.0)[0], moments.velocity)[0]

    def shot(self):
        """A shot that looks at the highest satellite of the next moment, and its trails."""
        self.at_s += STEP_S
        scene = shots.scene_at()
        ends = self.at_s, self.at_s + shots.EXPOSURE_S
        enu = [scene.site.refracted(self.directions(self.orbits, t), earth_state(t)) for t in ends]
        east, north, up = normalised(enu[0] + enu[1])[int(enu[0][:, 2].argmax())]
        scene = replace(
            scene,
            azimuth_deg=math.degrees(math.atan2(east, north)),
            altitude_deg=math.degrees(math.asin(up)),
            roll_deg=self.rng.uniform(0, 360),
        )
        shot = shots.shot_of(scene, self.at_s, self.rng)
        pixels = np.stack([scene.camera.project(v @ scene.attitude) for v in enu], 1)
        size = np.array([scene.camera.width, scene.camera.height])
        ahead = (enu[0] @ scene.attitude)[:, 2] > 0.9
        on = np.flatnonzero(ahead & ((pixels > 20) & (pixels < size - 20)).all((1, 2)))
        trails = [
            FrameTrail(
                # which end is first is unknown
                ends=(pixels[k] + self.rng.normal(0, SIGMA_PX, (2, 2)))[:: self.rng.choice([-1, 1])],
                covariance=SIGMA_PX**2 * np.eye(4),
                snr=50.0,
                cut=np.zeros(2, bool),
                steady=True,
            )
            for k in on
        ]
        return shot, trails_to_message(trails, shot.stars.header)


@pytest.fixture(scope="module")
def dusk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dusk")
    made = Dusk(folder / "active.tle")
    made.folder = folder
    return made


def off_m(place):
    """East, north from the true place."""
    east = math.radians(place.longitude - shots.LONGITUDE_DEG) * math.cos(LATITUDE)
    return np.array([east, math.radians(place.latitude - shots.LATITUDE_DEG)]) * 6.378e6


def is_right(off, covariance):
    return off @ np.linalg.solve(np.reshape(covariance, (3, 3))[:2, :2], off) < 4**2


def test_dusk_gives_a_place_without_a_level_and_then_calibrates_it(dusk, graph):
    trails = graph.node.create_publisher(TrailArray, "trails", 10)
    by_satellites = {}
    graph._keep(NavSatFix, "satellites/fix", by_satellites)
    elements = f"satellites.elements:={dusk.folder / 'active.tle'}"
    solver = graph.start(dusk.folder / "log", "starpos_solver", "solver", *SOLVER, elements)
    graph.wait_for_solver()
    recorder = graph.start(
        dusk.folder / "record", "starpos_bringup", "record", arguments=(str(dusk.folder / "bag"),)
    )
    ears = (trails, graph.stars, graph.tilt, graph.info)
    graph.wait(lambda: all(p.get_subscription_count() >= 2 for p in ears), "for solver and recorder")
    solutions, shown = [], 0
    for _ in range(FRAMES):
        shot, message = dusk.shot()
        shown += len(message.trails)
        solution, _, _ = graph.answer(shot)
        solutions.append((shot, solution))
        trails.publish(message)
        graph.wait(lambda stamp=shot.stamp: stamp in by_satellites, "for a place by satellites")
    first = by_satellites[solutions[0][0].stamp][-1]
    assert math.isnan(first.latitude) and first.status.status == -1
    last = by_satellites[solutions[-1][0].stamp][-1]
    assert shown >= FRAMES and last.status.status == 0
    sigma = np.sqrt(last.position_covariance[::4])
    assert is_right(off_m(last), last.position_covariance) and 10 < sigma[0] < 300
    assert abs(last.altitude) < 4 * sigma[2] < 100
    assert "satellites, chi-square" in graph.state("solver: Satellites", "place").message
    # the uncalibrated level has learned from the place
    assert solutions[0][1].status != Solution.OK
    shot, solution = solutions[-1]
    assert solution.status == Solution.OK and "learned" in [term.name for term in solution.budget]
    assert is_right(shot.error_m(solution), solution.covariance)
    assert math.sqrt(solution.covariance_geodetic[0]) < 5000
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0, recorder.output
    solver.end()
    for process in (recorder, solver):
        graph.processes.remove(process)
    dusk.last = last


def test_the_recorded_dusk_gives_the_same_place(dusk):
    elements = f"satellites.elements:={dusk.folder / 'active.tle'}"
    played = replay(dusk.folder / "bag", (*SOLVER, elements))
    assert not played.trouble and played.by_satellites is not None
    got = np.degrees([played.by_satellites.latitude, played.by_satellites.longitude])
    # the recorder may have missed the first message
    assert got == pytest.approx([dusk.last.latitude, dusk.last.longitude], abs=1e-3)
