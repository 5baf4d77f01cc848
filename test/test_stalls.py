# SPDX-License-Identifier: Apache-2.0
"""The inclinometer's process stands still while the instrument turns: tools/soaks/soak.py stalls, shortened."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from starpos_testing.patience import WAIT_S

TOOL = Path(__file__).parent.parent / "tools" / "soaks" / "soak.py"


@pytest.mark.timeout(4 * WAIT_S)
def test_a_stalled_inclinometer_makes_no_wrong_tilt_and_no_wrong_fix():
    command = [sys.executable, str(TOOL), "stalls", "--stalls", "2", "--instruments", "2", "--seed", "3"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as tool:
        try:
            out, _ = tool.communicate(timeout=3 * WAIT_S)
        except subprocess.TimeoutExpired:
            # It ends what it has started.
            tool.send_signal(signal.SIGINT)
            out, _ = tool.communicate()
    assert tool.returncode == 0, out
    assert "2 stalls" in out and " 0 wrong fixes" in out and " 0 wrong tilts" in out
