# SPDX-License-Identifier: Apache-2.0
"""Solver, detector and player in one process: `replay_in_one.py ARGUMENTS OF REPLAY --ros-args ...` (bag.py)."""

import os
import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor

from starpos_bringup import replay
from starpos_camera.detector import DetectorNode
from starpos_solver.node import SolverNode


def main() -> int:
    k = sys.argv.index("--ros-args")
    arguments, ros = sys.argv[1:k], sys.argv[k:]
    rclpy.init(args=ros)
    detector = DetectorNode()
    detector.listen()
    executor = SingleThreadedExecutor()
    executor.add_node(SolverNode())
    executor.add_node(detector)
    statuses = []

    def play():
        statuses.append(replay.main(arguments, []))

    player = threading.Thread(target=play)
    player.start()
    while player.is_alive():
        executor.spin_once(timeout_sec=0.1)
    return statuses[0] if statuses else 1


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    # threads of the nodes still wait
    os._exit(status)
