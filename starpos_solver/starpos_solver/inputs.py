# SPDX-License-Identifier: Apache-2.0
"""Inputs of a node: when messages came, and which were refused."""

import time
from collections.abc import Mapping, Sequence

from rclpy.node import Node

from starpos_common.diagnostics import Diagnosis, Level
from starpos_common.troubles import Troubles

STALE_S = 5.0
# seconds of an IMU at 400 Hz that may wait while a node does something else
IMU_QUEUE = 4000


class Inputs:
    """Keeps account of the messages, by the relative name of their topic.

    needed: names without which there is no output.
    """

    def __init__(self, node: Node, needed: Sequence[str]) -> None:
        self.refused = 0
        self._needed = needed
        self._came_s: dict[str, float] = {}
        self._troubles = Troubles(node)

    def came(self, name: str) -> None:
        """Note a message that is sound as far as is known."""
        self._came_s[name] = time.monotonic()
        self._troubles.right(name)

    def refuse(self, name: str, sentence: str) -> None:
        """Note a message that is refused, with the reason."""
        self._came_s[name] = time.monotonic()
        self.refused += 1
        self._troubles.wrong(name, sentence)

    def report(self, kept: Mapping[str, int], dropped: Mapping[str, int]) -> Diagnosis:
        """Make the diagnostic `Inputs`; kept: what the node has of them; dropped: what was lost on the way, by topic."""
        now = time.monotonic()
        ages_s = {name: now - came for name, came in self._came_s.items()}
        missing = [name for name in self._needed if ages_s.get(name, STALE_S) >= STALE_S]
        values: dict[str, object] = {f"{name} age (s)": age for name, age in ages_s.items()}
        values |= {**kept, "refused": self.refused}
        values |= {f"{name} dropped": count for name, count in dropped.items()}
        refusals = self._troubles.lately(STALE_S)
        said = [f"nothing on {', '.join(missing)} for {STALE_S:g} s"] if missing else []
        said += [f"refused: {'; '.join(refusals)}"] if refusals else []
        if said:
            return Diagnosis(Level.WARN, "; ".join(said), values)
        return Diagnosis(Level.OK, "all inputs arrive", values)
