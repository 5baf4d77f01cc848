# SPDX-License-Identifier: Apache-2.0
"""The faults that tools/soaks/soak.py faults injects: each a function that sends something bad into the graph.

The table prints its docstring.  A fault may only do what the data can show to be wrong. A single wrong stamp, tilt or
pointing that no earlier frame contradicts makes a wrong fix in any instrument; see UNTOLD.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from accelerated import World

from starpos.messages.stamp import stamp_to_unix
from starpos_common.messages import unix_to_stamp

NAN, INF = math.nan, math.inf
HOSTILE = (NAN, INF, -INF, 1e300, -1e300, 0.0, -1.0)
UNTOLD = """\
Not injected, since no number tells it, and a fix from it is wrong: a stamp that is off already in the first frame of a
pose (from then on the stars tell), or from the second on for ten frames; one that is off by less than 0.7 s (a mount
creeps by as much); an inclinometer that is off steadily, or in the only reading near a frame; tilts of a clock ahead by
less than a second, or by no more than /clock ticks, where none of their true time follow; the stars of another instrument
under one's own tilts; a `camera_info` of the right focal length and a wrong principal point; a valid parameter of a wrong
value."""


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
    """Register a function as a Kind."""

    def register(inject):
        KINDS.append(Kind(inject.__name__.replace("_", " "), weight, inject))
        return inject

    return register


def shift(messages, seconds: float):
    """Move the stamps of messages, not below 1 s."""
    for m in messages:
        m.header.stamp = unix_to_stamp(max(stamp_to_unix(m.header.stamp) + seconds, 1.0))


def some_time(w: World, least=2.0, most=1e6) -> float:
    """Draw seconds, evenly over the decades."""
    return float(np.exp(w.rng.uniform(math.log(least), math.log(most))))
