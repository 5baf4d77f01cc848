# SPDX-License-Identifier: Apache-2.0
"""The diagnostic `Clock` of a node that stamps with this machine's clock."""

import time
from collections.abc import Callable

from rclpy.clock import ROSClock
from rclpy.node import Node

from starpos.session import system_clock
from starpos_common.diagnostics import Diagnosis, Level

# How long a step stays in the report.
TOLD_S = 30.0
# How far longitude turns.
ARCSEC_PER_S = 15.041


def time_is_simulated(node: Node) -> bool:
    """Whether the node takes its time from /clock (use_sim_time)."""
    clock = node.get_clock()
    return isinstance(clock, ROSClock) and clock.ros_time_is_active


class ClockReport:
    """Reports whether stamps can be trusted, once a second, and logs each step of the clock once.

    matters: returns False while no stamp comes from this clock.
    watch: finds the steps of the system's clock.
    """

    def __init__(self, node: Node, matters: Callable[[], bool] = lambda: True) -> None:
        self._node = node
        self._matters = matters
        self.watch = system_clock.StepWatch()
        self._set_s = self._step_s = 0.0
        # In seconds of monotonic time.
        self._stepped_at = -TOLD_S

    def __call__(self) -> Diagnosis:
        if time_is_simulated(self._node):
            return Diagnosis(Level.OK, "time is simulated (use_sim_time).")
        now = time.monotonic()
        set_s = self.watch.set_s()
        step, self._set_s = set_s - self._set_s, set_s
        # A clock that was set and set back between two reports made no step.
        if abs(step) > system_clock.STEP_S:
            self._step_s, self._stepped_at = step, now
            self._node.get_logger().warning(f"{self._said(step)}.")
        state = system_clock.read()
        values: dict[str, object] = {"last step (s)": self._step_s}
        if state is not None:
            values |= {
                "synchronised": state.synchronised,
                "maximum error (s)": state.max_error_s,
                "estimated error (s)": state.est_error_s,
            }
        if not self._matters():
            return Diagnosis(Level.OK, "the frames carry times of their own.", values)
        if now - self._stepped_at < TOLD_S:
            return Diagnosis(Level.WARN, f"{self._said(self._step_s)}.", values)
        if state is None:
            cure = "the solver assumes the error in clock_stddev"
            return Diagnosis(
                Level.WARN, f"the system does not report the error of its clock; {cure}.", values
            )
        return Diagnosis(Level.OK if state.synchronised else Level.WARN, state.sentence, values)

    def _said(self, step_s: float) -> str:
        way = "ahead" if step_s > 0 else "back"
        return (
            f"the system's clock was set {way} by {abs(step_s):.3g} s: longitudes before and after differ by "
            f"{abs(step_s) * ARCSEC_PER_S:.3g} arcsec"
        )
