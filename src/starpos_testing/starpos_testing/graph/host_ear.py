# SPDX-License-Identifier: Apache-2.0
"""Prints each message of the named topics as a line of JSON until standard input ends; hosts.Ear starts it on a host."""

import base64
import contextlib
import json
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException

from starpos_testing.graph.hosts import KINDS


def tell(topic: str):
    def heard(data: bytes):
        line = {"topic": topic, "at_s": time.monotonic(), "data": base64.b64encode(data).decode()}
        print(json.dumps(line), flush=True)

    return heard


def end_with_input():
    sys.stdin.read()
    rclpy.try_shutdown()


def main():
    rclpy.init()
    node = rclpy.create_node("ear")
    for name in sys.argv[1:]:
        node.create_subscription(KINDS[name], name, tell(name), 100, raw=True)
    threading.Thread(target=end_with_input, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
