# SPDX-License-Identifier: Apache-2.0
"""The rows that benchmarks make: what a work takes of CPU time here and in a peer, measured by turns in one run."""

import math
import platform
import resource
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from statistics import median

HEAD = "| what | here | peer | peer's | ratio |\n| --- | ---: | --- | ---: | ---: |"
# In a document, a printed table stands between these.
BEGIN, END = "<!-- table -->\n", "<!-- end of table -->"
# A work is repeated until it has taken so long, so that the clock's step does not matter, and at most so often.
MIN_S, MAX_TIMES = 0.02, 1000


@dataclass(frozen=True)
class Cost:
    """What a work took of CPU time (ms), and a word on what came of it."""

    ms: float
    note: str = ""

    def __str__(self) -> str:
        return time_text(self.ms) + (f"; {self.note}" if self.note else "")


@dataclass(frozen=True)
class Row:
    """A figure of the table; `theirs` is what the peer took for the same work, None where there is no peer."""

    what: str
    here: Cost
    peer: str = ""
    theirs: Cost | None = None

    @property
    def ratio(self) -> float | None:
        """Ours over theirs."""
        return self.here.ms / self.theirs.ms if self.theirs and self.theirs.ms > 0 else None

    def __str__(self) -> str:
        ratio = "" if self.ratio is None else digits(self.ratio, 2)
        return f"| {self.what} | {self.here} | {self.peer} | {self.theirs or ''} | {ratio} |"


def digits(value: float, number: int) -> str:
    """The value to a number of digits, never as a power of ten."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(0, number - 1 - math.floor(math.log10(abs(value))))}f}"


def time_text(ms: float) -> str:
    """A time in us, ms or s."""
    if ms < 0.1:
        return f"{digits(1000 * ms, 2)} us"
    return f"{digits(ms, 2)} ms" if ms < 1000 else f"{digits(ms / 1000, 2)} s"


def cpu_s() -> float:
    """CPU time (s) of this process and of those it has started and waited for."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def spent_ms(work: Callable[[], object]) -> float:
    """CPU time (ms) of a work, the mean of as many times as it takes to measure it well."""
    begin, times = cpu_s(), 0
    while times == 0 or (cpu_s() - begin < MIN_S and times < MAX_TIMES):
        work()
        times += 1
    return 1000 * (cpu_s() - begin) / times


def by_turns(works: Mapping[str, Callable[[], object]], rounds: int = 5) -> dict[str, float]:
    """The median CPU time (ms) of each work, after a first time that does not count.

    They are done by turns, so that what else the machine does falls on all of them.
    """
    for work in works.values():
        work()
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            taken[name].append(spent_ms(work))
    return {name: median(times) for name, times in taken.items()}


def show(lines: Iterable[str], into: Path | None) -> None:
    """Print lines as they come; then put them in place of a document's table, if one is named."""
    said = []
    for line in lines:
        print(line, flush=True)
        said.append(line)
    if into is not None:
        into.write_text(replaced(into.read_text(), "\n".join(said)))


def replaced(document: str, table: str) -> str:
    """The document with another table."""
    before, begin, rest = document.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"the document has no place for a table: {BEGIN.strip()}, then {END}")
    return f"{before}{begin}{table}\n{end}{after}"


def circumstances() -> str:
    """One line: the machine, the interpreter, the day and the commit."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or "processor unknown"
    asked = ("git", "describe", "--always", "--dirty")
    commit = subprocess.run(
        asked, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    ).stdout.strip()
    return (
        f"{platform.machine()}, {model}; Python {platform.python_version()}; {date.today()}; "
        f"commit {commit or 'unknown'}"
    )
