# SPDX-License-Identifier: Apache-2.0
"""Prints the messages of the named topics, a JSON line each, until its standard input ends; hosts.Ear starts it there."""

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


rclpy.init()
node = rclpy.create_node("ear")
for name in sys.argv[1:]:
    node.create_subscription(KINDS[name], name, tell(name), 100, raw=True)
threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
with contextlib.suppress(ExternalShutdownException):
    rclpy.spin(node)
