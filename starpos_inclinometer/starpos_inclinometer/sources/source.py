# SPDX-License-Identifier: Apache-2.0
"""Interface between the node and a sensor. A new sensor is a TiltSource in a module here, and a line in `registry`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.node import Node

from starpos_common.parameters import Parameter
from starpos_common.topics import Take
from starpos_inclinometer.host_clock import HostClock
from starpos_inclinometer.sources.reading import Health, Reading, TimedPulse


@dataclass(frozen=True)
class Surroundings:
    """What a node gives its source: itself, for topics; the host's clock; `wake`, which any thread may call.

    in_turn: makes a topic's callback, from its relative name and the function that takes its messages: in a replay each
    has its turn.
    replays: whether the node's time is simulated.
    """

    node: Node
    clock: HostClock
    wake: Callable[[], object]
    in_turn: Callable[[str, Take], Take] = lambda name, take: take
    replays: bool = False


class TiltSource(Protocol):
    """A source of tilts, made as SourceClass(host, values) from the node's parameters.

    Only the node's thread calls it.
    """

    parameters: Sequence[Parameter]
    # The port or topic of the device, for diagnostics.
    name: str

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None: ...

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        """Say in a sentence why a source cannot be made of these parameters; None if it can."""

    @property
    def takes(self) -> Mapping[str, Take]:
        """Functions that take the messages of topics, by relative name."""
        return {}

    def start(self) -> None:
        """Begin to listen."""

    def stop(self) -> None:
        """End everything that `start` began; takes at most a second."""

    def restart(self) -> None:
        """Forget what came of topics: a replay begins."""
        return None

    def configure(self, values: Mapping[str, Any]) -> None:
        """Apply the parameters that may change at run time."""

    def take(self) -> list[Reading]:
        """Return the readings since the last call, in order."""

    def take_pulses(self) -> list[TimedPulse]:
        """Return the edges that the device has timed since the last call, in order; most devices time none."""
        return []

    def health(self) -> Health:
        """State of the source, for a person to read."""
