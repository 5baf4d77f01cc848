# SPDX-License-Identifier: Apache-2.0
"""The faults that tools/faults/fault_soak.py injects: each a function that sends something bad into the graph.

Its docstring is what the table says.  A fault may only do what the numbers can tell to be wrong: a stamp, a tilt or a
pointing that is off by itself, with no earlier frame to contradict it, makes a wrong fix anywhere; see UNTOLD.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from accelerated import World

from starpos.recording.messages import stamp_to_unix
from starpos_common.messages import unix_to_stamp

NAN, INF = math.nan, math.inf
HOSTILE = (NAN, INF, -INF, 1e300, -1e300, 0.0, -1.0)
UNTOLD = """\
Not injected, since no number tells it, and a fix from it is wrong: a stamp that is off already in the first frame of a
pose (from then on the stars tell), or from the second on for ten frames; one that is off by less than 0.7 s (a mount
creeps by as much); an inclinometer that is off steadily, or in the only reading near a frame; tilts of less than a second
ahead; the stars of another instrument under one's own tilts; a `camera_info` of the right focal length and a wrong
principal point; a valid parameter of a wrong value."""


@dataclass(frozen=True)
class Kind:
    """A fault: its name, how often it is drawn against the others, what it does."""

    name: str
    weight: float
    inject: Callable[[World], None]

    @property
    def about(self) -> str:
        return " ".join(self.inject.__doc__.split()).rstrip(".")


KINDS: list[Kind] = []


def kind(weight: float):
    """Registers a function as a Kind."""

    def register(inject):
        KINDS.append(Kind(inject.__name__.replace("_", " "), weight, inject))
        return inject

    return register


def shift(messages, seconds: float):
    """Move their stamps, not below 1 s."""
    for m in messages:
        m.header.stamp = unix_to_stamp(max(stamp_to_unix(m.header.stamp) + seconds, 1.0))


def some_time(w: World, least=2.0, most=1e6) -> float:
    """Seconds, evenly over the decades."""
    return float(np.exp(w.rng.uniform(math.log(least), math.log(most))))
