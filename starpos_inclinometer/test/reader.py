# SPDX-License-Identifier: Apache-2.0
"""Someone who reads a link; waits for events instead of sleeping."""

import threading
import time

from starpos_inclinometer.clock import HostClock
from starpos_inclinometer.sources.mcu import McuDecoder, McuSource
from starpos_inclinometer.sources.mcu_protocol import BAUD
from starpos_inclinometer.sources.serial_link import SerialLink
from starpos_inclinometer.sources.source import Health, Surroundings
from starpos_testing.patience import WAIT_S


def mcu_source(values) -> McuSource:
    """A source that converts what a test gives it, and reads no port."""
    return McuSource(Surroundings(None, HostClock(), lambda: None), values)


class Reader:
    """A link to the microcontroller, and what came out of it."""

    def __init__(self, path, rate_hz=50, now_ns=time.time_ns):
        self.samples = []
        self.decoder = McuDecoder(rate_hz)
        host = Surroundings(None, HostClock(now_ns), self._wake)
        self.link = SerialLink(host, {"port": path, "baud": BAUD}, self.decoder)
        self._event = threading.Condition()
        self.link.start()

    @property
    def identity(self):
        return self.decoder.identity

    def _wake(self):
        with self._event:
            self.samples += self.link.arrivals()
            self._event.notify_all()

    def wait(self, condition) -> Health:
        """The state, once condition(state, samples) is true."""
        with self._event:
            met = self._event.wait_for(lambda: condition(self.link.health(), self.samples), WAIT_S)
        state = self.link.health()
        assert met, state
        return state

    def close(self):
        self.link.stop()
        assert not any(t is self.link._thread for t in threading.enumerate())
