# SPDX-License-Identifier: Apache-2.0
"""The instrument as it is built, devices emulated: tools/demo/emulated_instrument.py, shortened."""

import json
import math
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from starpos_testing.lacking import lacks
from starpos_testing.patience import WAIT_S

TOOL = Path(__file__).parent.parent / "tools" / "demo" / "emulated_instrument.py"
FRAMES = 8


@pytest.mark.timeout(5 * WAIT_S)
def test_a_camera_with_a_lag_nobody_told_finds_the_place_that_known_times_give(tmp_path):
    command = [sys.executable, str(TOOL), "--seed", "11", "--frames", str(FRAMES), "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as tool:
        try:
            out, error = tool.communicate(timeout=4 * WAIT_S)
        except subprocess.TimeoutExpired:
            # It ends what it has started.
            tool.send_signal(signal.SIGINT)
            out, error = tool.communicate()
    if tool.returncode == 2 and (lack := re.search("(sudo apt-get install|pip install) (.+)", error)):
        lacks(lack[2], lack[1])
    assert tool.returncode == 0, out + error
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["solved"] >= FRAMES and summary["frames"] >= 1
    assert summary["sigmas_off"] < 4
    # The sky and the shutter of a busy machine may come late together, and the lag with them.
    assert math.hypot(summary["east_of_known_times_m"], summary["north_of_known_times_m"]) < 10
    # It claims something.
    assert max(summary["sigma_east_m"], summary["sigma_north_m"]) < 300
