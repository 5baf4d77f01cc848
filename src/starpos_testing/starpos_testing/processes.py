# SPDX-License-Identifier: Apache-2.0
"""Memory and CPU time of a process, for soaks and benchmarks."""

import os
from pathlib import Path


def memory_mb(pid: int | str = "self") -> float:
    """Resident memory of a process (by default this one) in 10^6 bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s(pid: int) -> float:
    """CPU time in s of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
