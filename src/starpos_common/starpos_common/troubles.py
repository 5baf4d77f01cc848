# SPDX-License-Identifier: Apache-2.0
"""What goes wrong again and again as one line in the log, and one when it is over."""

import re
import time
from dataclasses import dataclass, field

from rclpy.node import Node

QUIET_S = 10.0  # that long nothing went wrong: it is over with the next that is right
MOST_KINDS = 8  # of sentences logged of one trouble; words of theirs may come from outside


@dataclass
class _Trouble:
    """Since when nothing went wrong (s, monotonic), what was wrong last, and the sentences that were logged."""

    since_s: float
    sentence: str
    kinds: set[str] = field(default_factory=set)


class Troubles:
    """Of a node, by the name of what they are of, such as a topic."""

    def __init__(self, node: Node):
        self._log = node.get_logger()
        self._troubles: dict[str, _Trouble] = {}

    def wrong(self, what: str, sentence: str) -> None:
        """Something went wrong, now; logged where it is of another kind than before. Numbers make no kind."""
        trouble = self._troubles.setdefault(what, _Trouble(0.0, ""))
        trouble.since_s, trouble.sentence = time.monotonic(), sentence
        kind = re.sub(r"[\d.e+-]+", "", sentence)
        if kind not in trouble.kinds and len(trouble.kinds) < MOST_KINDS:
            trouble.kinds.add(kind)
            self._log.warning(sentence)

    def right(self, what: str) -> None:
        """It went right, now."""
        trouble = self._troubles.get(what)
        if trouble and time.monotonic() - trouble.since_s > QUIET_S:
            del self._troubles[what]
            self._log.info(f"{what}: in order again")

    def lately(self, within_s: float) -> list[str]:
        """The last sentence of each that went wrong within that time."""
        now = time.monotonic()
        return [t.sentence for t in self._troubles.values() if now - t.since_s < within_s]
