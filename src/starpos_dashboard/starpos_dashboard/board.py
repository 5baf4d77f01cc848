# SPDX-License-Identifier: Apache-2.0
"""The newest message of each kind and when it came: the state that a page shows."""

import json
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Imu, NavSatFix

from starpos_dashboard import readings
from starpos_interfaces.msg import GnssCheck, Solution, Tilt

# Age at which messages of 1 Hz or faster are old.
FAST_S = 5.0
# Diagnostics kept.
LIGHTS = 64
# Looked at in one message.
STATUSES = 256


class Board:
    """Takes messages and gives one JSON text, of bounded size. `changed`: a message came since the last `told`.

    nodes: the nodes whose diagnostics are shown as lights, by their names in `namespace`, or whole ones; empty: all.
    """

    def __init__(
        self,
        track: int,
        nodes: frozenset[str],
        clock: Callable[[], float] = time.monotonic,
        namespace: str = "/",
    ) -> None:
        self.changed = False
        self._namespace = namespace
        self._nodes = self._seen(nodes)
        self._clock, self._since = clock, clock()
        # By topic: when it was heard, and what it said.
        self._heard: dict[str, tuple[float, dict[str, Any]]] = {}
        self._lights: dict[str, tuple[float, dict[str, Any]]] = {}
        self._track: deque[tuple[int, float, float]] = deque(maxlen=track)
        self._count = 0

    def keep_track_of(self, fixes: int) -> None:
        """Keep this number of fixes from now on."""
        self._track = deque(self._track, maxlen=fixes)

    @property
    def track(self) -> tuple[tuple[int, float, float], ...]:
        """(number, latitude, longitude) [deg] of the newest fixes, counted from 1."""
        return tuple(self._track)

    def hear_fix(self, message: NavSatFix) -> None:
        told = readings.position(message)
        self._keep("fix", told)
        if told["good"]:
            self._keep("last_fix", told)
            self._count += 1
            self._track.append((self._count, told["latitude"], told["longitude"]))

    def hear_average(self, message: NavSatFix) -> None:
        self._keep("averaged", readings.position(message))

    def hear_heading(self, message: Imu) -> None:
        self._keep("heading", readings.heading(message))

    def hear_tilt(self, message: Tilt) -> None:
        self._keep("tilt", readings.tilt(message))

    def hear_solution(self, message: Solution) -> None:
        self._keep("solution", readings.solution(message))

    def hear_gnss(self, message: GnssCheck) -> None:
        self._keep("gnss", readings.gnss(message))

    def hear_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep the diagnostics of the nodes that have lights."""
        for status in message.status[:STATUSES]:
            name = readings.seen_from(self._namespace, status.name)
            if self._nodes and _node_of(name) not in self._nodes:
                continue
            told = readings.light(status, name)
            # The newest has to be the last.
            self._lights.pop(told["name"], None)
            self._lights[told["name"]] = self._clock(), told
            if len(self._lights) > LIGHTS:
                del self._lights[next(iter(self._lights))]
            self.changed = True

    def show_frame(self, number: int, stamp_s: float | None, trouble: str = "") -> None:
        """Note the number of a picture, or why it is missing."""
        self._keep("frame", {"number": number, "stamp": stamp_s, "trouble": readings.text(trouble)})

    def hide_frame(self) -> None:
        """Forget the frame, because no page shows it and it would get old."""
        self._heard.pop("frame", None)

    def only_lights_of(self, nodes: frozenset[str]) -> None:
        """Show the lights of these nodes from now on; empty: of all."""
        self._nodes, self._since = self._seen(nodes), self._clock()
        if nodes:
            self._lights = {n: light for n, light in self._lights.items() if _node_of(n) in self._nodes}

    def _seen(self, nodes: frozenset[str]) -> frozenset[str]:
        return frozenset(readings.seen_from(self._namespace, n) if n[0] == "/" else n for n in nodes)

    def _keep(self, name: str, told: dict[str, Any] | None) -> None:
        self.changed = True
        if told is None:
            self._heard.pop(name, None)
        else:
            self._heard[name] = self._clock(), told

    def told(self, now_s: float, slow_s: float) -> str:
        """Write everything as one line of JSON; each `age` [s] counts since it came, on the monotonic clock.

        now_s: the node's time (Unix).  slow_s: age at which the values that come with each frame are old.
        """
        self.changed = False
        now = self._clock()
        told: dict[str, Any] = {
            name: {**what, "age": now - since} for name, (since, what) in self._heard.items()
        }
        lights = [{**light, "age": now - since} for since, light in self._lights.values()]
        silent = self._nodes - {_node_of(name) for name in self._lights}
        lights += [{**readings.silence(node), "age": now - self._since} for node in silent]
        told["lights"] = sorted(lights, key=lambda light: light["name"])
        told["now"] = now_s
        told["old_after"] = {"slow": slow_s, "fast": min(FAST_S, slow_s)}
        return json.dumps(told, allow_nan=False, separators=(",", ":"))


def _node_of(name: str) -> str:
    """Node of a diagnostic: `solver` for `solver: Solution`."""
    return name.split(":", 1)[0].strip()
