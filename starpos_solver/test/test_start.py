# SPDX-License-Identifier: Apache-2.0
"""The solver starts without what takes long to import."""

import subprocess
import sys

HEAVY = ("scipy", "astropy", "cv2", "matplotlib")


def test_the_node_imports_nothing_heavy():
    program = f"import sys, starpos_solver.node; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
