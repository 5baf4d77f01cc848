# SPDX-License-Identifier: Apache-2.0
"""Run everything that can fail in this project: linters, each package's tests, the tests of the whole graph.

`test.py [PYTEST ARGUMENTS]`, `test.py --lint`. The last line counts what passed, failed and was skipped (a
linter counts as one test); the exit status is 0 only where nothing failed. `test.py --ubuntu` runs packages' tests with
the versions that Ubuntu 24.04 has (tools/setup/ubuntu-24.04.txt) in an environment of its own; `test.py --both` runs all.
"""

import os
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
LINTERS = [f"ruff {check} --output-format concise" for check in ("check", "format --check")]
NO_TESTS = 5  # pytest's exit status where a -k left none
COLCON = "--event-handlers console_direct+ console_stderr- status- summary- --packages-select"
LANES = 3  # at once: some compute, others wait for nodes
LONGEST_FIRST = (
    "starpos", "graph", "starpos_camera", "starpos, Ubuntu's", "starpos_inclinometer", "starpos_camera, Ubuntu's",
)  # fmt: skip
VERSIONS = "tools/setup/ubuntu-24.04.txt"
UBUNTU = ("src/starpos", "starpos_camera", "starpos_common", "starpos_inclinometer", "starpos_solver")
# with the newest only, since they wait for nodes and for programs of others: CI is to end soon
NEWEST_ONLY = [
    f"starpos_camera/test/test_{name}.py"
    for name in ("alpaca", "annotator", "camera", "clock", "detector", "gphoto2", "indi", "together", "v4l2")
]
PRINTING, MAKING = threading.Lock(), threading.Lock()

Tests = dict[str, Callable]  # of a name: what runs them, given a file for their output, and counts


def run(command: list[str], out=None, environment: dict[str, str] | None = None) -> int:
    """Run a command in the project's root, its output to a file or shown; its exit status."""
    result = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=out, stderr=out and subprocess.STDOUT, check=False
    )
    return result.returncode


def lint() -> Counter:
    """Run the linters."""
    return Counter("failed" if run(shlex.split(linter)) else "passed" for linter in LINTERS)


def junit_counts(path: Path, since: float, status: int, out) -> Counter:
    """Counts of a JUnit file written after `since` (Unix s); a missing, stale or broken one is a failure.

    So is an exit status that no failed test explains.
    """
    if not path.is_file() or path.stat().st_mtime < since:
        print(f"{path}: the tests ended without a result", file=out)
        return Counter(failed=1)
    try:
        suites = list(ElementTree.parse(path).getroot().iter("testsuite"))
    except ElementTree.ParseError as error:
        print(f"{path}: the tests ended with half a result ({error})", file=out)
        return Counter(failed=1)
    total = Counter()
    for suite in suites:
        failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
        skipped = int(suite.get("skipped", 0))
        total += Counter(passed=int(suite.get("tests", 0)) - failed - skipped, failed=failed, skipped=skipped)
    return total + Counter(failed=int(status not in (0, NO_TESTS) and total["failed"] == 0))


def has_tests(folder: Path) -> bool:
    return any(folder.glob("**/test_*.py"))


def colcon(package: str, pytest_args: list[str], out) -> Counter:
    """`colcon test`: the tests a package of ROS carries, in the environment it was built for."""
    since = time.time()
    command = [sys.executable, "-c", "import sys; from colcon_core.command import main; sys.exit(main())"]
    command += ["--log-level", "error", "--log-base", f"log/{package}", "test", *shlex.split(COLCON), package]
    status = run(command + (["--pytest-args", *pytest_args] if pytest_args else []), out)
    return junit_counts(ROOT / "build" / package / "pytest.xml", since, status, out)


def pytest(
    folder: str, report: str, pytest_args: list[str], out, python=sys.executable, **options
) -> Counter:
    """A folder's tests; options: those of `run`."""
    since, path = time.time(), ROOT / "log" / f"{report}.xml"
    status = run([python, "-m", "pytest", folder, f"--junit-xml={path}", *pytest_args], out, **options)
    return junit_counts(path, since, status, out)


def newest(pytest_args: list[str]) -> Tests:
    """Those of all packages and of the graph, in the workspace."""
    packages = [p.parent.name for p in ROOT.glob("*/package.xml") if has_tests(p.parent / "test")]
    tests = {name: partial(colcon, name, pytest_args) for name in packages}
    tests["starpos"] = partial(pytest, "src/starpos/test", "starpos", pytest_args)
    if has_tests(ROOT / "test"):
        tests["graph"] = partial(pytest, "test", "graph", pytest_args)
    return tests


def made(folder: Path, out) -> bool:
    """Whether there is an environment with the versions that Ubuntu 24.04 has; made once.

    ROS, and what the list leaves out, are the workspace's.
    """
    wanted, stamp = (ROOT / VERSIONS).read_text(), folder / "stamp"
    with MAKING:
        if stamp.is_file() and stamp.read_text() == wanted:
            return True
        base = (ROOT / ".underlay" / "python").read_text().strip()
        pip = [str(folder / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "install", "-q"]
        alone = os.environ | {"PYTHONPATH": ""}
        for command in ([base, "-m", "venv", "--clear", str(folder)], [*pip, "--no-input", "-r", VERSIONS]):
            if run(command, out, alone):
                return False
        [packages] = folder.glob("lib/python*/site-packages")
        behind = ROOT / ".underlay" / "venv" / packages.relative_to(folder)
        (packages / "workspace.pth").write_text(f"{behind}\n")
        stamp.write_text(wanted)
        return True


def older(package: str, pytest_args: list[str], out) -> Counter:
    """A package's tests with the versions that Ubuntu 24.04 has."""
    folder = ROOT / ".underlay" / "ubuntu"
    if not made(folder, out):
        print("Ubuntu 24.04's versions could not be installed", file=out)
        return Counter(failed=1)
    environment = os.environ | {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    python, name = str(folder / "bin" / "python"), Path(package).name
    chosen = [*(f"--ignore={path}" for path in NEWEST_ONLY), *pytest_args]
    return pytest(f"{package}/test", f"{name}-ubuntu", chosen, out, python=python, environment=environment)


def shown(name: str, tests: Callable) -> Counter:
    """Run tests and show their output when it is whole."""
    begin = time.monotonic()
    with tempfile.TemporaryFile("w+") as out:
        counts = tests(out)
        out.seek(0)
        with PRINTING:
            print(f"== {name}, {time.monotonic() - begin:.0f} s\n{out.read()}", flush=True)
    return counts


def all_of(tests: Tests) -> Counter:
    """The counts of all, some at once."""
    names = sorted(
        tests, key=lambda n: (LONGEST_FIRST.index(n) if n in LONGEST_FIRST else len(LONGEST_FIRST), n)
    )
    with ThreadPoolExecutor(LANES) as lanes:
        return sum(lanes.map(lambda name: shown(name, tests[name]), names), Counter())


def main(args: list[str]) -> int:
    which = {"--lint", "--ubuntu", "--both"} & set(args)
    pytest_args = [a for a in args if a not in which]
    total = Counter() if which == {"--ubuntu"} else lint()
    tests = {} if which & {"--lint", "--ubuntu"} else newest(pytest_args)
    if which & {"--ubuntu", "--both"}:
        tests |= {f"{Path(p).name}, Ubuntu's": partial(older, p, pytest_args) for p in UBUNTU}
    total += all_of(tests)
    print(f"{total['passed']} passed, {total['failed']} failed, {total['skipped']} skipped")
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
