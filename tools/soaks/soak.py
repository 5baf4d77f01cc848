# SPDX-License-Identifier: Apache-2.0
"""Long runs of one part: does its memory grow, are its answers the same, is any of them wrong?

`. tools/env.sh && python tools/soaks/soak.py KIND [OPTIONS]`.  Exit status 0 only if all is well.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import runner

SOAKS = Path(__file__).resolve().parent
FAULTS = SOAKS.parent / "faults"

NAMES = "day", "no_sun", "camera", "inclinometer", "two_skies", "voyage", "ends"
KINDS = {name: SOAKS / f"{name}.py" for name in NAMES}
KINDS |= {"faults": FAULTS / "fault_soak.py", "stalls": FAULTS / "stall_soak.py"}

if __name__ == "__main__":
    sys.exit(runner.main(__doc__, KINDS, sys.argv[1:]))
