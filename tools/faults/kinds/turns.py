# SPDX-License-Identifier: Apache-2.0
"""Tilts that are lost, late or unread when the instrument has been turned, and tilts of another inclinometer."""

import math
import signal
import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
from accelerated import CADENCE_S, World
from rclpy.qos import QoSProfile

from kinds.registry import kind
from starpos_interfaces.msg import Solution, Tilt
from starpos_testing.graph.shots import EXPOSURE_S, SAMPLES, tilts_at

PERIOD_S = EXPOSURE_S / SAMPLES
OFF_RAD = math.radians(0.1)
STRANGER = Path(__file__).resolve().parent.parent / "stranger.py"


def publish(w: World, times_s, scene=None):
    """Publish what the inclinometer of a scene (by default of the present one) reads at these times."""
    for tilt in tilts_at(scene or w.scene, times_s, w.rng):
        w.graph.tilt.publish(tilt)


def until(end_s: float, seconds: float) -> np.ndarray:
    """Times of readings over some seconds until shortly before `end_s`."""
    return np.arange(end_s - seconds, end_s - 1e-3, PERIOD_S)


def turned(w: World):
    """Turn the instrument before the next exposure; return its pointing before, and the next shot."""
    before = w.scene
    w.turn()
    shot = w.shot()
    w.tick()
    w.graph.info.publish(shot.info)
    return before, shot


@kind(2)
def tilts_lost_after_a_turn(w: World):
    """The instrument is turned; the old lean's readings end up to 1 s before the exposure, the new one's never come."""
    before, shot = turned(w)
    publish(w, until(w.now_s - w.rng.uniform(0.0, 0.95), 1.0), before)
    w.stars(shot)


@kind(1)
def tilts_of_before_a_turn_in_the_exposure(w: World):
    """The instrument is turned; one reading of the old lean bears a time at the edge of the exposure."""
    before, shot = turned(w)
    publish(w, [w.now_s + w.rng.uniform(-0.05, 0.01)], before)
    if w.rng.random() < 0.5:
        publish(w, [w.now_s + EXPOSURE_S + w.rng.uniform(-0.01, 0.05)])
    w.stars(shot)


@kind(1)
def tilts_late_after_a_turn(w: World):
    """The instrument is turned; the readings of the exposure come about when its frame's patience ends."""
    before, shot = turned(w)
    publish(w, until(w.now_s - 0.1, 1.0), before)
    w.stars(shot)
    w.spin(w.rng.uniform(0.1, 0.4))
    w.tilts(shot)


@kind(1)
def tilts_unread_by_a_solver_that_stands(w: World):
    """The solver stands still (SIGSTOP) while the instrument is turned and tilts and stars arrive, in any order."""
    solver = next(p for p in w.graph.processes if p.name == "solver")
    solver.signal(signal.SIGSTOP)
    try:
        before, shot = turned(w)
        publish(w, until(w.now_s - 0.05, 1.5), before)
        first, then = w.stars, w.tilts
        if w.rng.random() < 0.5:
            first, then = then, first
        first(shot)
        w.spin(w.rng.uniform(0.05, 0.5))
        then(shot)
    finally:
        solver.signal(signal.SIGCONT)


@kind(1)
def inclinometer_stood_still(w: World):
    """The instrument is turned; what its inclinometer had read comes at once and late: dated, or of no known time."""
    before, shot = turned(w)
    lost = w.rng.uniform(0.5, 10.0)
    backlog = tilts_at(before, until(w.now_s - 0.1, lost), w.rng)
    if w.rng.random() < 0.5:
        for k, tilt in enumerate(backlog):
            tilt.header.stamp = shot.tilts[k % len(shot.tilts)].header.stamp
            tilt.flags = Tilt.TIME_UNKNOWN
    w.stars(shot)
    w.spin(w.rng.uniform(0.0, 0.3))
    for tilt in backlog:
        w.graph.tilt.publish(tilt)
    if w.rng.random() < 0.5:
        w.tilts(shot)


@kind(2)
def readings_while_it_slews(w: World):
    """Readings go on while the instrument slews between frames, until the exposure begins or a little before."""
    for _ in range(int(w.rng.integers(1, 4))):
        before, shot = turned(w)
        (x0, y0), (x1, y1) = before.tilt, w.scene.tilt
        times = until(w.now_s, CADENCE_S - EXPOSURE_S)
        for tilt, share in zip(
            tilts_at(w.scene, times, w.rng), np.linspace(0, w.rng.uniform(0.5, 1.0), len(times)), strict=True
        ):
            tilt.x += (1 - share) * (x0 - x1)
            tilt.y += (1 - share) * (y0 - y1)
            w.graph.tilt.publish(tilt)
        w.tilts(shot)
        w.stars(shot)
        w.spin(0.03)


@kind(0.5)
def second_inclinometer(w: World):
    """Another inclinometer, 0.1 deg off, of its own frame or the same, at the same times or ten times as often."""
    other = w.graph.node.create_publisher(Tilt, "tilt", QoSProfile(depth=1000))
    w.graph.comes(lambda: other.get_subscription_count() > 0, 1.0)
    frame, fast = w.rng.choice(["", "another_inclinometer"]), w.rng.random() < 0.5
    for _ in range(int(w.rng.integers(1, 4))):
        shot = w.shot()
        foreign = deepcopy(shot.tilts)
        if fast:
            foreign = tilts_at(w.scene, w.now_s + np.arange(0, EXPOSURE_S, PERIOD_S / 10), w.rng)
        for tilt in foreign:
            tilt.header.frame_id = frame or tilt.header.frame_id
            tilt.x += OFF_RAD
        w.tick()
        w.graph.info.publish(shot.info)
        own = [(w.graph.tilt, t) for t in shot.tilts]
        alien = [(other, t) for t in foreign]
        both = own + alien if w.rng.random() < 0.5 else alien + own
        for publisher, tilt in both:
            publisher.publish(tilt)
        # what two publishers send arrives in no order
        w.spin(0.05)
        w.stars(shot)
        w.spin(0.03)
    w.graph.node.destroy_publisher(other)


@kind(0.1)
def second_inclinometer_killed(w: World):
    """A second inclinometer, a process of its own, is killed: DDS does not hear of its end for a while."""
    command = [sys.executable, str(STRANGER), *map(str, np.add(w.scene.tilt, OFF_RAD))]
    with subprocess.Popen(command) as stranger:
        # until the solver has heard it
        for _ in range(50):
            shot = w.shot()
            w.tick()
            w.tilts(shot)
            w.spin(0.1)
            w.stars(shot)
            if any(s.status == Solution.NO_TILT for kept in w.graph.solutions.values() for s in kept):
                break
        stranger.kill()
