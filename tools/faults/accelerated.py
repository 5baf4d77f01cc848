# SPDX-License-Identifier: Apache-2.0
"""Instrument in accelerated time for `fault_soak.py`: its messages, its place, and a judge of its fixes."""

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import NavSatFix

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.instrument import instrument_file
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.sky.site import Site
from starpos_common.messages import unix_to_stamp
from starpos_interfaces.msg import Solution
from starpos_testing.graph.graph import Graph, stamp_of
from starpos_testing.graph.shots import (
    EXPOSURE_S,
    HUMIDITY,
    PRESSURE_PA,
    SMALL,
    START_S,
    TEMPERATURE_C,
    SimulatedShot,
    focal_of,
    photograph_of,
    scene_at,
    shot_of,
)

CADENCE_S, LATENCY_S = 0.8, 0.5
# Shorter than the solver's default, so that a missing tilt costs less time.
TILT_TIMEOUT_S = 0.2
WRONG_SIGMA = 5.0
# So long the answers to good frames that are still under way are waited for.
LEFT_S = 5.0
# So long a busy machine may take to bring tilts to the solver, and to read them.
ARRIVED_S = 15.0
# A frame without tilts is exposed so much later than the last one; longer than the solver's patience.
LACKING_S = 0.25
# If a good frame has no answer by then, a fault still has an effect.
ANSWER_S = 1.0
# An instrument far better than usual, so that small errors count: 15 m, where the paper's claims 190.
KNOWN = Instrument(
    focal_of(SMALL),
    calibration=Calibration.of((0.0, 0.0, 0.0), (0.5, 0.5, 0.5)),
    inclinometer=InclinometerErrors(scale=0.0, drift_rad_per_sqrt_hour=0.0, temperature_rad_per_c=0.0),
    clock_stddev_s=0.01,
)
STATUS = {getattr(Solution, name): name for name in dir(Solution) if name.isupper() and name != "SLOT_TYPES"}


def parameters_of(folder: Path) -> dict:
    """Make the solver's parameters, which also undo what a fault has set; write the instrument file."""
    file = folder / "instrument.yaml"
    instrument_file.write(file, KNOWN)
    nan = math.nan
    return {
        "use_sim_time": True,
        "calibration_url": str(file),
        "tilt_timeout": TILT_TIMEOUT_S,
        "refraction.pressure": PRESSURE_PA,
        "refraction.temperature": TEMPERATURE_C,
        "refraction.humidity": HUMIDITY,
        "deflection.stddev": 0.0,
        "min_stars": 5,
        "tilt_window": 0.5,
        "altitude": nan,
        "clock_stddev": nan,
        "tilt_stddev": nan,
        "calibration_frames": 30,
        "self_calibration": False,
        "frame_id": "starpos_link",
        "misalignment_stddev": 5.0,
        "inclinometer.model": "sca100t_calibrated",
    }


@dataclass(frozen=True)
class Truth:
    """The place where it was, deg."""

    latitude: float
    longitude: float
    heading: float

    def sigmas_off(self, latitude: float, longitude: float, covariance_m2) -> tuple[float, str]:
        """Distance of a place from here in its own sigmas, and in words."""
        prime, meridian = curvature_radii_m(math.radians(self.latitude))
        east = math.radians((longitude - self.longitude + 180) % 360 - 180)
        north = math.radians(latitude - self.latitude)
        apart = np.array([east * prime * math.cos(math.radians(self.latitude)), north * meridian])
        # NaN if the covariance is invalid, which counts as wrong.
        sigmas = float(np.sqrt(apart @ np.linalg.solve(covariance_m2, apart)))
        return sigmas, f"{np.hypot(*apart):.0f} m, {math.sqrt(np.trace(covariance_m2) / 2):.0f} claimed"


class World:
    """The instrument, its graph, and a judge of all answers of the solver."""

    def __init__(self, graph: Graph, seed: int, parameters: dict):
        self.graph, self.rng = graph, np.random.default_rng(seed)
        self._parameters = {name.replace(".", "__"): value for name, value in parameters.items()}
        self.now_s = START_S
        # How far /clock is off.
        self.clock_off_s = 0.0
        self._clock = graph.node.create_publisher(Clock, "/clock", QoSProfile(depth=10))
        self._averaged: list[NavSatFix] = []
        graph.node.create_subscription(
            NavSatFix, "fix_averaged", self._averaged.append, QoSProfile(depth=100)
        )
        self._truths: dict[tuple[int, int], Truth] = {}
        # Counts by topic.
        self.right = Counter()
        # By topic: the error of every fix, in its own sigmas.
        self.sigmas: dict[str, list[float]] = {}
        self.wrong: list[str] = []
        self.scene = scene_at(40.0, SMALL)
        self.drive()

    # place -----------------------------------------------------------------------------------------------------------

    def turn(self):
        """Turn the instrument, which is legitimate, as `drive` is: no fault."""
        self.scene = replace(
            self.scene, azimuth_deg=self.rng.uniform(0, 360), altitude_deg=self.rng.uniform(76, 84)
        )

    def drive(self):
        """Move to a random place, at least some kilometres away."""
        latitude = math.degrees(math.asin(self.rng.uniform(-0.9, 0.9)))
        site = Site(latitude, self.rng.uniform(-180, 180), self.scene.site.atmosphere)
        self.scene = replace(self.scene, site=site)
        self.turn()

    @property
    def truth(self) -> Truth:
        site, heading = self.scene.site, math.degrees(self.scene.heading)
        return Truth(site.latitude_deg, site.longitude_deg, heading)

    # messages --------------------------------------------------------------------------------------------------------

    def shot(self) -> SimulatedShot:
        """Make the next exposure."""
        self.now_s += CADENCE_S
        return shot_of(self.scene, self.now_s, self.rng)

    def photograph(self):
        """Make the next exposure as an image instead of stars: Shot, Image, Capture."""
        self.now_s += CADENCE_S
        return photograph_of(self.scene, self.now_s, self.rng)

    def tick(self, moment_s: float | None = None):
        """Publish /clock: a little after the end of the newest exposure."""
        now = self.now_s + EXPOSURE_S + LATENCY_S if moment_s is None else moment_s
        self._clock.publish(Clock(clock=unix_to_stamp(now + self.clock_off_s)))

    def remember(self, message):
        """Note that answers under the stamp of this message belong to the present place."""
        self._truths[stamp_of(message)] = self.truth

    def tilts(self, shot: SimulatedShot):
        for tilt in shot.tilts:
            self.graph.tilt.publish(tilt)

    def stars(self, shot: SimulatedShot):
        self.remember(shot.stars)
        self.graph.stars.publish(shot.stars)

    def send(self, shot: SimulatedShot):
        """Send a frame and its tilts in good order."""
        self.tick()
        self.graph.info.publish(shot.info)
        self.tilts(shot)
        self.stars(shot)

    def send_image(self, shot: SimulatedShot, image, capture):
        self.tick()
        self.remember(image)
        self.graph.send(shot, image, capture)

    def restore_parameters(self):
        """Set the solver's parameters back."""
        successful, reason = self.graph.set("solver", **self._parameters)
        assert successful, reason

    def until_read(self):
        """Wait until the solver has read the tilts that were sent: a frame that lacks its own is answered after that.

        /clock goes on by less than to the next exposure.
        """
        self.graph.tilt.wait_for_all_acked(Duration(seconds=ARRIVED_S))
        shot = shot_of(self.scene, self.now_s + LACKING_S, self.rng)
        self.stars(shot)
        self.until_answered(shot)

    def until_answered(self, lacking: SimulatedShot):
        """Wait for the answer to a frame that lacks its tilts, which comes once those that were sent are read.

        /clock goes on by more than the solver's patience, and by less than to the next exposure.
        """
        for waited in range(1, 4):
            self.tick(self.now_s + EXPOSURE_S + LATENCY_S + waited * LACKING_S)
            if self.graph.comes(lambda: lacking.stamp in self.graph.solutions, ARRIVED_S / 3):
                break

    def spin(self, seconds: float):
        """Spin for a while, for things without an event to wait for."""
        self.graph.comes(lambda: False, seconds)

    def good(self, sent: list | None = None) -> bool:
        """Send a good frame; return whether it is answered by a fix, or one of those already sent (their stamps)."""
        shot = self.shot()
        self.send(shot)
        return self._is_fix(shot.stamp, sent)

    def good_image(self, sent: list | None = None) -> bool:
        """Send a good frame through the detector; see `good`."""
        shot, image, capture = self.photograph()
        self.send_image(shot, image, capture)
        return self._is_fix(shot.stamp, sent)

    def _is_fix(self, stamp, sent: list | None) -> bool:
        # on a busy machine the answer to an image may come after the next image was sent, each time
        sent = [] if sent is None else sent
        sent.append(stamp)
        solutions, fixes = self.graph.solutions, self.graph.fixes

        def fixed():
            return any(s.status == Solution.OK for t in sent for s in solutions.get(t, ()))

        self.graph.comes(lambda: fixed() or (stamp in fixes and stamp in solutions), ANSWER_S)
        if not fixed():
            return False
        # what is still under way would come after the next fault, as if of the pose before it
        self.graph.comes(lambda: all(t in solutions for t in sent), LEFT_S)
        return True

    # answers ---------------------------------------------------------------------------------------------------------

    def judge(self) -> Counter:
        """Count the answers since the last call by status; `right` and `wrong` hold their fixes."""
        graph, statuses = self.graph, Counter()
        for solution in _all(graph.solutions):
            statuses[STATUS[solution.status]] += 1
            if solution.status == Solution.OK:
                place = np.reshape(solution.covariance, (3, 3))[:2, :2]
                self._judge_place("solution", solution, place)
                off = solution.heading - self._truth_of(solution).heading
                self._judge("heading", solution, abs((off + 180) % 360 - 180) / solution.heading_stddev)
        for topic, fixes in (("fix", _all(graph.fixes)), ("fix_averaged", self._averaged)):
            for fix in fixes:
                if fix.status.status >= 0:
                    self._judge_place(topic, fix, np.reshape(fix.position_covariance, (3, 3))[:2, :2])
        for imu in _all(graph.imus):
            q = imu.orientation
            x = np.array(
                [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)]
            )
            off = math.degrees(math.atan2(x[0], x[1])) - self._truth_of(imu).heading
            # The turn of a leaning x axis's azimuth for a small turn about east, north or up.
            slope = np.cross(x, [-x[1], x[0], 0.0]) / (x[0] ** 2 + x[1] ** 2)
            covariance = np.reshape(imu.orientation_covariance, (3, 3))
            sigma = math.degrees(math.sqrt(slope @ covariance @ slope))
            self._judge("heading/imu", imu, abs((off + 180) % 360 - 180) / sigma)
        for kept in (graph.solutions, graph.fixes, graph.imus, graph.diagnostics, self._averaged):
            kept.clear()
        while len(self._truths) > 5000:
            del self._truths[next(iter(self._truths))]
        return statuses

    def _truth_of(self, message) -> Truth:
        return self._truths.get(stamp_of(message), self.truth)

    def _judge_place(self, topic: str, message, covariance_m2):
        truth = self._truth_of(message)
        self._judge(topic, message, *truth.sigmas_off(message.latitude, message.longitude, covariance_m2))

    def _judge(self, topic: str, message, sigmas: float, in_words: str = ""):
        self.sigmas.setdefault(topic, []).append(sigmas)
        if sigmas <= WRONG_SIGMA:
            self.right[topic] += 1
        else:
            self.wrong.append(f"{topic} of {stamp_of(message)}: {sigmas:.1f} sigma from the truth {in_words}")


def _all(kept: dict) -> list:
    return [message for messages in kept.values() for message in messages]
