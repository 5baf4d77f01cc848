# SPDX-License-Identifier: Apache-2.0
"""One command for works of several kinds: each is a module with `options(parser)` and `run(options)`, its exit status."""

import argparse
import ast
import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from starpos_testing.processes import memory_mb


def main(about: str, kinds: dict[str, Path], words: Sequence[str], command: str = "") -> int:
    """Run the kind that the first word names; the others are its own. Only its module is imported."""

    def parser_of(name: str, description: str | None, epilog: str = "") -> argparse.ArgumentParser:
        shape = argparse.RawDescriptionHelpFormatter
        return argparse.ArgumentParser(name, description=description, epilog=epilog, formatter_class=shape)

    program = f"{Path(sys.argv[0]).name} {command}".strip()
    titles = {name: ast.get_docstring(ast.parse(path.read_text())) or "" for name, path in kinds.items()}
    listed = "\n".join(f"  {name:15} {text.splitlines()[0]}" for name, text in titles.items())
    parser = parser_of(program, about, f"kinds:\n{listed}\n\n{program} KIND --help: its options")
    parser.add_argument("kind", choices=tuple(kinds), metavar="KIND")
    kind = parser.parse_args(words[:1]).kind
    sys.path.insert(0, str(kinds[kind].parent))
    module = importlib.import_module(kinds[kind].stem)
    own = parser_of(f"{program} {kind}", module.__doc__)
    module.options(own)
    return int(module.run(own.parse_args(words[1:])) or 0)


def seed_of_the_day() -> int:
    return int(time.time() // 86400)


class Progress:
    """Prints how far a work is, at each tenth of it."""

    def __init__(self, total: int, unit: str):
        self._total, self._unit, self._begin, self._tenth = total, unit, time.monotonic(), 0

    def at(self, done: int, *said: object) -> None:
        """`done` of the work is done, with what came of it so far."""
        if 10 * done // self._total > self._tenth:
            self._tenth = 10 * done // self._total
            passed = time.monotonic() - self._begin
            print(f"{done:7d} {self._unit} {passed:7.0f} s ", *said, file=sys.stderr, flush=True)


class Memory:
    """The resident memory of a process (MB), from when everything that is made once has been made."""

    def __init__(self, pid: int | str = "self"):
        self._pid, self._sizes = pid, [memory_mb(pid)]

    def look(self) -> None:
        self._sizes.append(memory_mb(self._pid))

    def __str__(self) -> str:
        return f"{self._sizes[-1]:.1f} MB"

    @property
    def halves(self) -> tuple[float, float]:
        """Most memory in the first and in the last half."""
        half = max(len(self._sizes) // 2, 1)
        return max(self._sizes[:half]), max(self._sizes[-half:])

    @property
    def grown(self) -> float:
        first, last = self.halves
        return last - first
