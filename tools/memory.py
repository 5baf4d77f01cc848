# SPDX-License-Identifier: Apache-2.0
"""What a process takes of memory, for the soaks."""

import os
from pathlib import Path


def memory_mb(pid: int | str = "self") -> float:
    """Resident memory of a process, of this one if none is named; 10^6 bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
