# SPDX-License-Identifier: Apache-2.0
"""Hundreds of random faults from all inputs and no wrong fix, no crash: tools/soaks/soak.py faults, shortened."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from starpos_testing.patience import WAIT_S

TOOL = Path(__file__).parent.parent / "tools" / "soaks" / "soak.py"
FAULTS, SEED = 25, 20778


@pytest.mark.timeout(5 * WAIT_S)
def test_random_faults_make_no_wrong_fix_and_no_crash():
    command = [
        sys.executable,
        str(TOOL),
        "faults",
        "--faults",
        str(FAULTS),
        "--lanes",
        "1",
        "--seed",
        str(SEED),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as tool:
        try:
            out, _ = tool.communicate(timeout=4 * WAIT_S)
        except subprocess.TimeoutExpired:
            # It ends what it has started.
            tool.send_signal(signal.SIGINT)
            out, _ = tool.communicate()
    assert tool.returncode == 0, out
    assert f"{FAULTS} faults" in out and "wrong: 0; crashes and defects: 0; without recovery: 0" in out
