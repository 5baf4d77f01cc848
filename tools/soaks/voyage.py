# SPDX-License-Identifier: Apache-2.0
"""A recorded voyage in real time through the running nodes: is the navigator's place the command line's?

FOLDER holds what `starpos navigate` takes: stars_*.csv, imu.csv, imu.yaml and, where there is one, velocity.csv.  They
become a bag, `replay` plays it, `solver` makes attitudes of its stars and `navigator` its place.  Prints the place at the
last frame by both ways, how far they are apart in their claim, what share of a core the nodes took and what they refused.
Exit status 0 only if the two are within one sigma, the claims within a tenth, and nothing was refused.
"""

import argparse
import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from geometry_msgs.msg import TwistWithCovarianceStamped, Vector3
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from starpos.frames.reading import read_frame
from starpos.instrument.instrument import Instrument, focal_px_of
from starpos.navigation.records import read_imu, read_velocity
from starpos_bringup.bag import BagWriter
from starpos_common.messages import camera_to_message, stars_to_message, unix_to_stamp
from starpos_testing.graph.graph import Graph
from starpos_testing.nodes import take_domain
from starpos_testing.processes import cpu_s

CAMERA_FRAME, BODY_FRAME = "camera", "starpos_link"
CLOCK_S = 1e-3
# From the middle of an exposure to its stars.
DETECTION_S = 0.5
EARTH_M = 6.37e6
# So long after the last message the nodes may still work on it.
DONE_S = 5.0


@dataclass(frozen=True)
class Place:
    """A place in deg, and its covariance (2, 2) in m2 east and north."""

    latitude: float
    longitude: float
    covariance: np.ndarray

    def off_m(self, other: "Place") -> np.ndarray:
        """How far (2,) in m east and north this place is from another."""
        east = np.radians(self.longitude - other.longitude) * np.cos(np.radians(other.latitude))
        return EARTH_M * np.array([east, np.radians(self.latitude - other.latitude)])


def options(parser) -> None:
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--vehicle", default="rover")
    parser.add_argument("--focal-mm", type=float, default=25.0)
    parser.add_argument("--pixel-um", type=float, default=5.86)
    parser.add_argument("--pressure-hpa", type=float, default=1010.0)


def run(args) -> int:
    recorded = by_command(args)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        write_bag(args, bag)
        told, share, refused = by_nodes(args, bag, Path(folder))
    off, sigma_m = told.off_m(recorded), np.sqrt(np.trace(told.covariance) / 2)
    ratio = sigma_m / np.sqrt(np.trace(recorded.covariance) / 2)
    print(
        f"nodes {told.latitude:.6f} {told.longitude:.6f}, command {recorded.latitude:.6f} {recorded.longitude:.6f}: "
        f"{np.linalg.norm(off):.1f} m apart, {sigma_m:.1f} m claimed an axis, {ratio:.3f} of the command's; "
        f"{100 * share:.0f} % of a core; {refused} refused"
    )
    return int(not (np.linalg.norm(off) < sigma_m and abs(ratio - 1) < 0.1 and refused == 0))


def by_command(args: argparse.Namespace) -> Place:
    """The place at the last frame by `starpos navigate`."""
    frames = sorted(args.folder.glob("stars_*.csv"))
    words = f"--vehicle {args.vehicle} --focal-mm {args.focal_mm} --pixel-um {args.pixel_um} --json"
    words += f" --clock-stddev {CLOCK_S} --pressure-hpa {args.pressure_hpa} --temperature-c 12 --deflection-stddev 0"
    command = ["starpos", "navigate", *map(str, frames), "--imu", str(args.folder / "imu.csv")]
    command += ["--imu-model", str(args.folder / "imu.yaml"), *shlex.split(words)]
    if (args.folder / "velocity.csv").exists():
        command += ["--velocity", str(args.folder / "velocity.csv")]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    last = json.loads(said.splitlines()[-1])
    covariance = np.reshape(last["covariance"], (3, 3))[:2, :2]
    return Place(last["latitude"], last["longitude"], covariance)


def write_bag(args: argparse.Namespace, bag: Path) -> None:
    """Write the voyage's messages, each at the time at which it would come."""
    writer = BagWriter(bag)
    for log_s, topic, message in sorted(messages(args), key=lambda m: m[0]):
        kind = "/".join((type(message).__module__.split(".")[0], "msg", type(message).__name__))
        writer.add_topic(topic, kind)
        writer.write(topic, round(log_s * 1e9), serialize_message(message))
    writer.close()


def messages(args: argparse.Namespace) -> Iterator[tuple[float, str, object]]:
    """Each message with its time and topic."""
    instrument = Instrument(focal_px_of(args.focal_mm, args.pixel_um))
    for path in sorted(args.folder.glob("stars_*.csv")):
        stars = read_frame(path)
        camera = instrument.camera_for(stars.width, stars.height)
        at = stars.mid_unix_s + DETECTION_S
        yield at - 0.1, "/camera/camera_info", camera_to_message(camera, CAMERA_FRAME, stars.mid_unix_s)
        yield at, "/stars", stars_to_message(stars, CAMERA_FRAME)
    imu = read_imu(args.folder / "imu.csv")
    for t, gyro, force in zip(imu.utc_unix_s.tolist(), imu.gyro.tolist(), imu.force.tolist(), strict=True):
        reading = Imu(header=Header(stamp=unix_to_stamp(t), frame_id=BODY_FRAME))
        reading.angular_velocity, reading.linear_acceleration = vector(gyro), vector(force)
        yield t, "/imu/data", reading
    if (args.folder / "velocity.csv").exists():
        log = read_velocity(args.folder / "velocity.csv")
        for t, v, sigma in zip(log.utc_unix_s.tolist(), log.velocity.tolist(), log.sigma, strict=True):
            twist = TwistWithCovarianceStamped(header=Header(stamp=unix_to_stamp(t), frame_id=BODY_FRAME))
            twist.twist.twist.linear = vector(v)
            twist.twist.covariance = (np.eye(6) * sigma**2).ravel()
            yield t, "/twist", twist


def vector(values: list[float]) -> Vector3:
    return Vector3(**dict(zip("xyz", values, strict=True)))


def by_nodes(args: argparse.Namespace, bag: Path, folder: Path) -> tuple[Place, float, int]:
    """The navigator's last place, the share of a core that the two nodes took, and how many messages it refused."""
    take_domain()
    graph = Graph()
    air = [f"refraction.pressure:={100 * args.pressure_hpa}", "refraction.temperature:=12.0"]
    common = ["use_sim_time:=true", f"clock_stddev:={CLOCK_S}", "deflection.stddev:=0.0", *air]
    model = f"imu_model:={args.folder / 'imu.yaml'}"
    try:
        nodes = [
            graph.start(folder / "solver", "starpos_solver", "solver", *common),
            graph.start(
                folder / "navigator",
                "starpos_solver",
                "navigator",
                *common,
                model,
                f"vehicle:={args.vehicle}",
            ),
        ]
        fixes = graph.hear(NavSatFix, "navigator/fix")
        graph.wait(lambda: graph.node.count_publishers("navigator/fix"))
        begin = time.monotonic()
        replay = graph.start(
            folder / "replay", "starpos_bringup", "replay", arguments=(str(bag), "--rate", str(args.rate))
        )
        while replay.process.poll() is None:
            graph.comes(lambda: False, 1.0)
        share = sum(cpu_s(n.process.pid) for n in nodes) / (time.monotonic() - begin)
        graph.comes(lambda: False, DONE_S)
        print(replay.output.strip(), file=sys.stderr)
        inputs = {v.key: v.value for v in graph.state("navigator: Inputs", "").values}
        print(graph.state("navigator: Navigation", "").message, file=sys.stderr)
        last = fixes[-1]
        covariance = np.reshape(last.position_covariance, (3, 3))[:2, :2]
        return Place(last.latitude, last.longitude, covariance), share, int(inputs["refused"])
    finally:
        graph.close()
