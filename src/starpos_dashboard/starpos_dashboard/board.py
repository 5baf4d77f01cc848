# SPDX-License-Identifier: Apache-2.0
"""The newest of everything that was heard, and when: what a page that is opened now has to know."""

import json
import time
from collections import deque
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Imu, NavSatFix

from starpos_dashboard import readings
from starpos_interfaces.msg import Solution, Tilt

FAST_S = 5.0  # of what comes at 1 Hz and more: old after so long
LIGHTS = 64  # diagnostics kept
STATUSES = 256  # of one message that are looked at


class Board:
    """Messages in, one JSON text out; all of it bounded. `changed`: something came since the last `told`.

    nodes: whose diagnostics are lights, by their names in `namespace`, or whole ones; all where there are none.
    """

    def __init__(
        self,
        track: int,
        nodes: frozenset[str],
        clock: Callable[[], float] = time.monotonic,
        namespace: str = "/",
    ):
        self.changed = False
        self._namespace = namespace
        self._nodes = self._seen(nodes)
        self._clock, self._since = clock, clock()
        self._heard: dict[str, tuple[float, dict]] = {}  # (when, what)
        self._lights: dict[str, tuple[float, dict]] = {}
        self._track: deque[tuple[int, float, float]] = deque(maxlen=track)
        self._count = 0

    def keep_track_of(self, fixes: int) -> None:
        """So many fixes from now on."""
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

    def hear_diagnostics(self, message: DiagnosticArray) -> None:
        """Those of the nodes that are to have lights."""
        for status in message.status[:STATUSES]:
            name = readings.seen_from(self._namespace, status.name)
            if self._nodes and _node_of(name) not in self._nodes:
                continue
            told = readings.light(status, name)
            self._lights.pop(told["name"], None)  # the newest is the last
            self._lights[told["name"]] = self._clock(), told
            if len(self._lights) > LIGHTS:
                del self._lights[next(iter(self._lights))]
            self.changed = True

    def show_frame(self, number: int, stamp_s: float | None, trouble: str = "") -> None:
        """A picture is to be had under this number, or why there is none."""
        self._keep("frame", {"number": number, "stamp": stamp_s, "trouble": readings.text(trouble)})

    def hide_frame(self) -> None:
        """Nobody looks: what comes next is not a frame of now."""
        self._heard.pop("frame", None)

    def only_lights_of(self, nodes: frozenset[str]) -> None:
        """Of these nodes, from now on; of all where there are none."""
        self._nodes, self._since = self._seen(nodes), self._clock()
        if nodes:
            self._lights = {n: light for n, light in self._lights.items() if _node_of(n) in self._nodes}

    def _seen(self, nodes: frozenset[str]) -> frozenset[str]:
        return frozenset(readings.seen_from(self._namespace, n) if n[0] == "/" else n for n in nodes)

    def _keep(self, name: str, told: dict | None):
        self.changed = True
        if told is None:
            self._heard.pop(name, None)
        else:
            self._heard[name] = self._clock(), told

    def told(self, now_s: float, slow_s: float) -> str:
        """Everything as one line of JSON; `age` is since it came, on a clock that nobody sets [s].

        now_s: what the node's clock says, Unix; slow_s: age at which what comes with each frame is old.
        """
        self.changed = False
        now = self._clock()
        told = {name: {**what, "age": now - since} for name, (since, what) in self._heard.items()}
        lights = [{**light, "age": now - since} for since, light in self._lights.values()]
        silent = self._nodes - {_node_of(name) for name in self._lights}
        lights += [{**readings.silence(node), "age": now - self._since} for node in silent]
        told["lights"] = sorted(lights, key=lambda light: light["name"])
        told["now"] = now_s
        told["old_after"] = {"slow": slow_s, "fast": min(FAST_S, slow_s)}
        return json.dumps(told, allow_nan=False, separators=(",", ":"))


def _node_of(name: str) -> str:
    """`solver` of the diagnostic `solver: Solution`."""
    return name.split(":", 1)[0].strip()
