# SPDX-License-Identifier: Apache-2.0
"""CPU time of the node `navigator` by the rate of the IMU, in real time, with a frame and ten velocities a second.

The second half alone counts.  The voyage is a rover's of starpos_testing.voyages, that began before now.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import yaml
from geometry_msgs.msg import TwistWithCovarianceStamped, Vector3
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu
from std_msgs.msg import Header
from table import Cost, Row

from starpos.earth.orientation import earth_state
from starpos.fix.attitude import CameraAttitude
from starpos.navigation.sightings import PlacelessFrame
from starpos_common.messages import attitude_to_message, unix_to_stamp
from starpos_interfaces.msg import Attitude
from starpos_testing.graph.graph import Graph
from starpos_testing.nodes import take_domain
from starpos_testing.processes import cpu_s
from starpos_testing.voyages import INDUSTRIAL, MadeVoyage, made

Event = tuple[float, str, object]


def rows(options) -> Iterator[Row]:
    """The rows of bench.py; with --quick none."""
    if not options.quick:
        share, refused = measured(400.0, 30.0, 10.0)
        here = Cost(1000 * share, f"{refused} messages refused")
        yield Row("navigator, a second at 400 Hz", here, "real time", Cost(1000.0))


def measured(rate_hz: float, seconds: float, outputs_hz: float) -> tuple[float, str]:
    """Start the node and play a rover's voyage of a length in s; the share of a core and what it refused."""
    events = messages(made("rover", seconds, 1, rate_hz=rate_hz))
    take_domain()
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "imu.yaml"
        model.write_text(yaml.safe_dump({k: float(v) for k, v in asdict(INDUSTRIAL).items()}))
        graph = Graph()
        try:
            return played(graph, Path(folder), seconds, outputs_hz, events, model)
        finally:
            graph.close()


def played(
    graph: Graph, folder: Path, seconds: float, outputs_hz: float, events: list[Event], model: Path
) -> tuple[float, str]:
    """Play the messages in real time."""
    node = graph.start(
        folder / "log",
        "starpos_solver",
        "navigator",
        f"imu_model:={model}",
        f"rate:={outputs_hz}",
        "vehicle:=rover",
        "refraction.pressure:=0.0",
    )
    qos = QoSProfile(depth=1000)
    publishers = {
        topic: graph.node.create_publisher(kind, topic, qos)
        for topic, kind in (("imu/data", Imu), ("attitude", Attitude), ("twist", TwistWithCovarianceStamped))
    }
    graph.wait(lambda: all(p.get_subscription_count() for p in publishers.values()))
    begin, first = time.monotonic(), events[0][0]
    half_s, halfway = seconds / 2, 0.0
    for at, topic, message in events:
        while (rest := at - first - (time.monotonic() - begin)) > 0:
            graph.comes(lambda: False, min(rest, 0.05))
        if not halfway and at - first > half_s:
            halfway = cpu_s(node.process.pid)
        publishers[topic].publish(message)
    share = (cpu_s(node.process.pid) - halfway) / (time.monotonic() - begin - half_s)
    inputs = {v.key: v.value for v in graph.state("navigator: Inputs", "").values}
    return share, inputs["refused"]


def messages(record: MadeVoyage) -> list[Event]:
    """What a rover's IMU, solver and wheels publish, by the time they come."""
    imu, log = record.imu, record.velocity
    events: list[Event] = [
        (t, "imu/data", reading(t, gyro, force))
        for t, gyro, force in zip(imu.utc_unix_s, imu.gyro.tolist(), imu.force.tolist(), strict=True)
    ]
    events += [(f.utc_unix_s + 0.5, "attitude", attitude(f)) for f in record.frames]
    for t, v, sigma in zip(log.utc_unix_s, log.velocity.tolist(), log.sigma, strict=True):
        twist = TwistWithCovarianceStamped(header=Header(stamp=unix_to_stamp(t)))
        twist.twist.twist.linear = Vector3(x=v[0], y=v[1], z=v[2])
        twist.twist.covariance = (np.eye(6) * sigma**2).ravel()
        events.append((t, "twist", twist))
    return sorted(events, key=lambda e: e[0])


def reading(unix_s: float, gyro: list[float], force: list[float]) -> Imu:
    """Make the message of a reading."""
    message = Imu(header=Header(stamp=unix_to_stamp(unix_s)))
    message.angular_velocity = Vector3(x=gyro[0], y=gyro[1], z=gyro[2])
    message.linear_acceleration = Vector3(x=force[0], y=force[1], z=force[2])
    return message


def attitude(frame: PlacelessFrame) -> Attitude:
    """Make the message of a frame, as the solver publishes it."""
    seen = frame.camera
    found = CameraAttitude(
        utc_unix_s=frame.utc_unix_s,
        stamp_stddev_s=0.0,
        clock_stddev_s=1e-3,
        frame_id="camera",
        camera_to_gcrs=earth_state(frame.utc_unix_s).gcrs_to_itrs.T @ seen.rotation,
        covariance=seen.covariance_about_own,
        stars=30,
        log_odds=50.0,
    )
    return attitude_to_message(found)
