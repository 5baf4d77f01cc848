# SPDX-License-Identifier: Apache-2.0
"""Run everything that can fail in this project: linters, each package's tests, the tests of the whole graph.

`test.py [PYTEST ARGUMENTS]`, `test.py --lint`. The last line counts what passed, failed and was skipped (a
linter counts as one test); the exit status is 0 only where nothing failed. `test.py --ubuntu` tests starpos with the
versions that Ubuntu 24.04 has (tools/ubuntu-24.04.txt) in an environment of its own.
"""

import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
LINTERS = [f"ruff {check} --output-format concise" for check in ("check", "format --check")]
NO_TESTS = 5  # pytest's exit status where a -k left none
COLCON = (
    "--log-level error test --executor sequential "
    "--event-handlers console_direct+ console_stderr- status- summary- --packages-select"
)


def run(command: list[str], out=None, environment: dict[str, str] | None = None) -> int:
    """Run a command in the project's root, its output to a file or shown; its exit status."""
    result = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=out, stderr=out and subprocess.STDOUT, check=False
    )
    return result.returncode


def lint() -> Counter:
    """Run the linters."""
    return Counter("failed" if run(shlex.split(linter)) else "passed" for linter in LINTERS)


def junit_counts(path: Path, since: float) -> Counter:
    """Counts of a JUnit file written after `since` (Unix s); a missing, stale or broken one is a failure."""
    if not path.is_file() or path.stat().st_mtime < since:
        print(f"{path}: the tests ended without a result")
        return Counter(failed=1)
    try:
        suites = list(ElementTree.parse(path).getroot().iter("testsuite"))
    except ElementTree.ParseError as error:
        print(f"{path}: the tests ended with half a result ({error})")
        return Counter(failed=1)
    total = Counter()
    for suite in suites:
        failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
        skipped = int(suite.get("skipped", 0))
        total += Counter(passed=int(suite.get("tests", 0)) - failed - skipped, failed=failed, skipped=skipped)
    return total


def has_tests(folder: Path) -> bool:
    return any(folder.glob("**/test_*.py"))


def package_tests(pytest_args: list[str]) -> Counter:
    """`colcon test`: the tests each package of ROS carries, in the environment it was built for."""
    folders = [p.parent for p in ROOT.glob("*/package.xml")]
    packages = sorted(f.name for f in folders if has_tests(f / "test"))
    if not packages:
        return Counter()
    since = time.time()
    colcon = [sys.executable, "-c", "import sys; from colcon_core.command import main; sys.exit(main())"]
    command = [*colcon, *shlex.split(COLCON), *packages]
    broken = run(command + (["--pytest-args", *pytest_args] if pytest_args else []))
    total = sum((junit_counts(ROOT / "build" / p / "pytest.xml", since) for p in packages), Counter())
    return total + Counter(failed=int(broken != 0 and total["failed"] == 0))


def pytest(python: str, folder: str, name: str, pytest_args: list[str], **options) -> Counter:
    """A folder's tests; options: those of `run`."""
    since, report = time.time(), ROOT / "log" / f"{name}.xml"
    status = run([python, "-m", "pytest", folder, f"--junit-xml={report}", *pytest_args], **options)
    total = junit_counts(report, since)
    return total + Counter(failed=int(status not in (0, NO_TESTS) and total["failed"] == 0))


def older_tests(pytest_args: list[str]) -> Counter:
    """The mathematics with the versions that Ubuntu 24.04 has."""
    folder = ROOT / ".underlay" / "ubuntu"
    python = str(folder / "bin" / "python")
    base = Path(ROOT / ".underlay" / "python").read_text().strip()
    pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "-q", "--no-input"]
    needs = ["-c", "tools/ubuntu-24.04.txt", "-e", "src/starpos[report,test]"]
    if run([base, "-m", "venv", str(folder)]) or run([*pip, *needs]):
        print("Ubuntu 24.04's versions could not be installed")
        return Counter(failed=1)
    environment = {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": ""}
    environment["STARPOS_COMPLETE"] = ""  # what is optional was there with the newest versions
    return pytest(python, "src/starpos/test", "ubuntu", pytest_args, environment=os.environ | environment)


def all_tests(pytest_args: list[str]) -> Counter:
    """Those that compute beside those that wait for nodes; the former's output comes when it is whole."""
    with tempfile.TemporaryFile("w+") as out, ThreadPoolExecutor(1) as beside:
        computing = beside.submit(pytest, sys.executable, "src/starpos/test", "starpos", pytest_args, out=out)
        total = package_tests(pytest_args)
        if has_tests(ROOT / "test"):
            total += pytest(sys.executable, "test", "graph", pytest_args)
        total += computing.result()
        out.seek(0)
        print(f"starpos\n{out.read()}")
    return total


def main(args: list[str]) -> int:
    if "--ubuntu" in args:
        total = older_tests([a for a in args if a != "--ubuntu"])
    else:
        total = lint()
        if "--lint" not in args:
            total += all_tests(args)
    print(f"{total['passed']} passed, {total['failed']} failed, {total['skipped']} skipped")
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
