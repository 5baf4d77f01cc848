# SPDX-License-Identifier: Apache-2.0
"""Inputs of the solver: when messages came, and which were refused."""

import time
from collections.abc import Mapping

from rclpy.node import Node

from starpos_common.diagnostics import Diagnosis, Level
from starpos_common.troubles import Troubles

STALE_S = 5.0
NAMES = ("camera_info", "stars", "tilt")


class Inputs:
    """Keeps account of the messages, by the relative name of their topic."""

    def __init__(self, node: Node) -> None:
        self.refused = 0
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

    def report(self, tilts_kept: int, dropped: Mapping[str, int]) -> Diagnosis:
        """Make the diagnostic `Inputs`; dropped: messages that were lost on the way, by topic."""
        now = time.monotonic()
        ages_s = {name: now - came for name, came in self._came_s.items()}
        missing = [name for name in NAMES if ages_s.get(name, STALE_S) >= STALE_S]
        values: dict[str, object] = {f"{name} age (s)": age for name, age in ages_s.items()}
        values |= {"tilts kept": tilts_kept, "refused": self.refused}
        values |= {f"{name} dropped": count for name, count in dropped.items()}
        refusals = self._troubles.lately(STALE_S)
        if missing:
            return Diagnosis(Level.WARN, f"nothing on {', '.join(missing)} for {STALE_S:g} s", values)
        if refusals:
            return Diagnosis(Level.WARN, f"refused: {'; '.join(refusals)}", values)
        return Diagnosis(Level.OK, "all inputs arrive", values)
