# SPDX-License-Identifier: Apache-2.0
"""Logging of a trouble that repeats: one line when it begins, and one when it is over."""

import re
import time
from dataclasses import dataclass, field

from rclpy.node import Node

# A trouble is over when something goes right after so long without a failure.
QUIET_S = 10.0
# Most sentences logged for one trouble: their words may come from outside, in any number.
MAX_KINDS = 8


@dataclass
class _Trouble:
    """The time of the last failure (s, monotonic), its sentence, and the kinds of sentences that were logged."""

    since_s: float
    sentence: str
    kinds: set[str] = field(default_factory=set)


class Troubles:
    """Keeps the troubles of a node, each by the name of what fails, such as a topic."""

    def __init__(self, node: Node) -> None:
        self._log = node.get_logger()
        self._troubles: dict[str, _Trouble] = {}

    def wrong(self, what: str, sentence: str) -> None:
        """Note a failure; log it if it is of a new kind. Sentences that differ only in numbers are of one kind."""
        trouble = self._troubles.setdefault(what, _Trouble(0.0, ""))
        trouble.since_s, trouble.sentence = time.monotonic(), sentence
        kind = re.sub(r"[\d.e+-]+", "", sentence)
        if kind not in trouble.kinds and len(trouble.kinds) < MAX_KINDS:
            trouble.kinds.add(kind)
            self._log.warning(sentence)

    def right(self, what: str) -> None:
        """Note a success; log it if it ends a trouble."""
        trouble = self._troubles.get(what)
        if trouble and time.monotonic() - trouble.since_s > QUIET_S:
            del self._troubles[what]
            self._log.info(f"{what}: in order again")

    def lately(self, within_s: float) -> list[str]:
        """The last sentences of the troubles within that time."""
        now = time.monotonic()
        return [t.sentence for t in self._troubles.values() if now - t.since_s < within_s]
