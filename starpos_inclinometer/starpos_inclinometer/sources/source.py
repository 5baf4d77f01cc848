# SPDX-License-Identifier: Apache-2.0
"""What a sensor is to the node. Each is a TiltSource; a new one is a module here and a line in `registry`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.node import Node

from starpos_common.parameters import Parameter
from starpos_inclinometer.host_clock import HostClock
from starpos_inclinometer.sources.reading import Health, Reading


@dataclass(frozen=True)
class Surroundings:
    """What a source has of its node: the node itself, for its topics; the host's clock; `wake`, called by any thread."""

    node: Node
    clock: HostClock
    wake: Callable[[], object]


class TiltSource(Protocol):
    """Where tilts come from. Made as SourceClass(host, values), of the node's parameters.

    One thread, the node's, calls it.
    """

    parameters: Sequence[Parameter]
    name: str  # of the device, for diagnostics: its port or topic

    def __init__(self, host: Surroundings, values: Mapping[str, Any]): ...

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        """A sentence where a source with these parameters cannot be made."""

    def start(self):
        """Begin to listen."""

    def stop(self):
        """End all that `start` began; takes at most a second."""

    def configure(self, values: Mapping[str, Any]):
        """Take over the parameters that may change at run time."""

    def take(self) -> list[Reading]:
        """The readings since the last call, in order."""

    def health(self) -> Health:
        """How it stands, as a person wants to know it."""
