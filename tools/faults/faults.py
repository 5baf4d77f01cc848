# SPDX-License-Identifier: Apache-2.0
"""Inject every fault that a test injects, and print what happened: one row a fault, as a table in Markdown.

A test that injects one records it: record_property("fault", what) and record_property("result", what happened).
`faults.py [PYTEST ARGUMENTS]`, in the workspace; the exit status is 0 only if every one of these tests passed; a
skipped one has not passed.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[2]
RECORDED = 'record_property("fault"'


def tests_by_folder() -> dict[Path, list[Path]]:
    """Find the test files that record faults, by their folder: each folder has fixtures of its own."""
    found: dict[Path, list[Path]] = {}
    for pattern in ("test/test_*.py", "*/test/test_*.py", "src/*/test/**/test_*.py"):
        for path in sorted(ROOT.glob(pattern)):
            if RECORDED in path.read_text():
                found.setdefault(path.parent, []).append(path)
    return found


def rows_of(report: Path) -> tuple[list[tuple[str, str, str]], int]:
    """Read (fault, result, test) from a JUnit file, and how many of these tests did not pass."""
    rows, bad = [], 0
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        told = {p.get("name"): p.get("value") for p in case.iter("property")}
        trouble = next((child.tag for child in case if child.tag in ("failure", "error", "skipped")), None)
        bad += trouble is not None
        if "fault" in told:
            result = told.get("result", "") if trouble is None else f"{trouble}: see the test"
            rows.append(
                (told["fault"], result, f"{case.get('classname').split('.')[-1]}::{case.get('name')}")
            )
    return rows, bad


def main(arguments: list[str]) -> int:
    rows, bad = [], 0
    with tempfile.TemporaryDirectory() as scratch:
        for k, (folder, files) in enumerate(tests_by_folder().items()):
            print(f"{folder.relative_to(ROOT)}: {', '.join(f.name for f in files)}", file=sys.stderr)
            report = Path(scratch) / f"{k}.xml"
            command = [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                f"--junit-xml={report}",
                *map(str, files),
                *arguments,
            ]
            subprocess.run(command, cwd=ROOT, check=False, stdout=sys.stderr)
            more, failed = rows_of(report) if report.is_file() else ([], 1)
            rows, bad = rows + more, bad + failed
    print("| fault | what happened | test |\n| --- | --- | --- |")
    for row in sorted(set(rows)):
        print("| " + " | ".join(cell.replace("|", "/") for cell in row) + " |")
    return int(bad > 0 or not rows)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
