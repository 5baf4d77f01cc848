# SPDX-License-Identifier: Apache-2.0
"""The executables. The imports inside are heavy; they come after the signal handlers (see starpos_common)."""

import signal
import sys


def inclinometer() -> int:
    """The node."""
    from starpos_common.node_main import run

    def make_nodes():
        from starpos_inclinometer.node import InclinometerNode

        yield InclinometerNode()

    return run(make_nodes)


def emulator() -> int:
    """The emulated microcontroller, until SIGINT or SIGTERM."""
    stopped = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda signum, frame: stopped.append(signum))
    from starpos_inclinometer.emulator import main

    status = main(sys.argv[1:], stopped)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return status
