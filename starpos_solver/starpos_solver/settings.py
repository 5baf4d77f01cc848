# SPDX-License-Identifier: Apache-2.0
"""The session's parameters as a node's."""

from collections.abc import Callable, Mapping

from rclpy.node import Node

from starpos.instrument.camera import Camera
from starpos.session.parameters import PARAMETERS
from starpos.session.settings import Settings
from starpos_common.parameters import declare


class SolverSettings(Settings):
    """Settings that are declared by a node and may be set while it runs.

    camera: returns the camera in use, None before there is one.
    apply: called with the names that were set.
    """

    def __init__(
        self, node: Node, camera: Callable[[], Camera | None], apply: Callable[[frozenset[str]], None]
    ) -> None:
        super().__init__({})
        self._camera, self._apply = camera, apply
        self.values = declare(node, PARAMETERS, apply=self._adopted, check=self._check)
        self.adopt()

    def _check(self, values: Mapping, names: frozenset[str]) -> str | None:
        return self.check(values, names, self._camera())

    def _adopted(self, names: frozenset[str]) -> None:
        self.adopt()
        self._apply(names)
