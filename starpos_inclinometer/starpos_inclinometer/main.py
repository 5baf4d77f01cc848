# SPDX-License-Identifier: Apache-2.0
"""The executable."""

from starpos_common.node_main import run_executable


def inclinometer() -> int:
    """Run the node."""
    about = "The readings of an inclinometer, or of an IMU, on `tilt`, until Ctrl-C."
    return run_executable("starpos_inclinometer", "inclinometer", about, "node:InclinometerNode")
