# SPDX-License-Identifier: Apache-2.0
"""Run everything that can fail in this project: linters, each package's tests, the tests of the whole graph.

`test.py [PYTEST ARGUMENTS]`, `test.py --lint`, `test.py --quick` (fast linters, and unit tests of the core). The last
line counts what passed, failed and was skipped (a linter counts as one test); the exit status is 0 only where nothing
failed. `test.py --ubuntu` runs packages' tests with the versions that Ubuntu 24.04 has (tools/setup/ubuntu), in an
environment as bare as a newcomer's: without the
counterparts that tools/setup/counterparts brings. `test.py --both` runs all, and the core's tests with other interpreters
that are at hand (tools/setup/core); it builds the documents' site, looks through the licences and checks the package,
which `test.py --docs` does alone: a warning is a failure.
"""

import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
FAST_LINTERS = [
    *(f"ruff {check} --output-format concise" for check in ("check", "format --check")),
    "lint-imports --config tools/imports.ini --no-cache",
    f"{sys.executable} tools/walls.py",
]
LINTERS = [*FAST_LINTERS, "codespell", "mypy", f"{sys.executable} tools/words.py", "actionlint -no-color"]
# the site of the documents, whether each file has its licence, and the package's metadata, with what the first brings
DOCS = [
    "tools/setup/docs",
    ".underlay/docs/bin/python -m sphinx -W --keep-going -n -q -c docs . build/docs",
    ".underlay/docs/bin/python -m reuse lint --lines",
    # of what the source package and a wheel hold a test has the list (test_package.py)
    ".underlay/docs/bin/python -m build --sdist --no-isolation src/starpos --outdir build/dist",
    ".underlay/docs/bin/python -m twine check --strict build/dist/*",
]
# pytest's exit status where a -k left none.
NO_TESTS = 5
# How many of the slowest tests are printed.
SHOWN = 20
# At once: on two cores, because tests of nodes mostly wait.
LANES = 6
# a folder's files in several parts, which run as lanes are free
PARTS = {"graph": 6, "starpos": 6, "starpos_camera": 2, "starpos_inclinometer": 2}
# with Ubuntu's versions less is run
UBUNTU_PARTS = {"starpos": 2}
# for several at once: a thread without a processor of its own makes the others wait for it; OpenBLAS's compute meanwhile
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
# what is no test of pytest's
CHECKS = ("linters", "documents", "versions")
# parts that mostly wait run next to parts that mostly compute
FIRST = ("graph", "starpos", "starpos_camera", "starpos_inclinometer")
UBUNTU = "Ubuntu's "
# the folders of starpos whose answers depend on the table of the Earth's rotation, which is older there
ROTATING = [f"src/starpos/test/{folder}" for folder in ("earth", "fix", "session", "sky")]
UNDERLAY = ROOT / ".underlay"
# interpreters with which the core's tests run too, where they are at hand; Ubuntu's versions run with Python 3.12
OTHERS = ("python3.10", "python3.13")
# what enters and leaves compiled modules in most ways, in few seconds
CORE = [
    f"src/starpos/test/{name}.py"
    for name in (
        "detection/test_detection_clipped",
        "detection/test_detection_window",
        "detection/test_fit",
        "detection/test_mesh",
        "detection/test_pairs",
        "detection/test_vetting",
        "earth/test_refraction",
        "fix/test_derivatives",
        "fix/test_solver",
        "identification/test_identification",
        "instrument/test_camera",
    )
]
# How long each file of tests takes, s; `test.py --record` writes it after a whole run. A file that is not in it is new.
SECONDS = ROOT / "tools" / "test_seconds.txt"
# `make quick` runs files up to the first of these, Ubuntu's versions those up to the second: what takes longer computes,
# or waits for nodes, and what it asks of libraries is in other tests too.
QUICK_S, UBUNTU_S = 0.5, 1.5
QUICK_PARTS = 2
# with the newest versions only, however quick
NEWEST_ONLY = {"starpos_inclinometer/test/test_node.py", "src/starpos_dashboard/test/test_dashboard_node.py"}
# programs that a bare machine has not: those that tools/setup/missing looks for
COUNTERPARTS = {"avr-gcc", "indiserver", "indi_simulator_ccd", "ip", "xmllint", "chromium", "chromedriver"}
PRINTING, MAKING = threading.Lock(), threading.Lock()


@dataclass
class Outcome:
    """What came of tests: how many passed, failed, were skipped; what each took; why which were skipped; which failed."""

    counts: Counter = field(default_factory=Counter)
    seconds: list[tuple[float, str]] = field(default_factory=list)
    skipped: Counter = field(default_factory=Counter)
    failed: list[str] = field(default_factory=list)

    def __add__(self, other: "Outcome") -> "Outcome":
        return Outcome(
            self.counts + other.counts,
            self.seconds + other.seconds,
            self.skipped + other.skipped,
            self.failed + other.failed,
        )


# By name: what runs them, given a file for their output; an Outcome.
Tests = dict[str, Callable]


def run(command: list[str], out=None, environment: dict[str, str] | None = None) -> int:
    """Run a command in the project's root, its output to a file or shown; its exit status."""
    result = subprocess.run(
        command, cwd=ROOT, env=environment, stdout=out, stderr=out and subprocess.STDOUT, check=False
    )
    return result.returncode


def lint(linters: list[str], out) -> Outcome:
    """Run linters; of those that pass only the names are shown."""
    # import-linter looks for the packages, which need not be built
    sources = [str(path.parent) for pattern in ("*", "src/*") for path in ROOT.glob(f"{pattern}/package.xml")]
    path = os.pathsep.join([*sources, os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    total = Outcome()
    for linter in linters:
        with tempfile.TemporaryFile("w+") as said:
            failed = run(shlex.split(linter), said, environment) != 0
            said.seek(0)
            print(
                f"{linter}: {'failed' if failed else 'passed'}\n{said.read() if failed else ''}",
                end="",
                file=out,
            )
        total += broken(linter) if failed else Outcome(Counter(passed=1))
    return total


def broken(what: str) -> Outcome:
    """The outcome of one thing that failed."""
    return Outcome(Counter(failed=1), failed=[what])


def outcome_of(path: Path, since: float, status: int, out) -> Outcome:
    """The outcome in a JUnit file written after `since` (Unix s); a missing, stale or broken one is a failure.

    So is an exit status that no failed test explains.
    """
    if not path.is_file() or path.stat().st_mtime < since:
        print(f"{path}: the tests ended without a result", file=out)
        return broken(f"{path.stem}: no result")
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        print(f"{path}: the tests ended with half a result ({error})", file=out)
        return broken(f"{path.stem}: half a result")
    counts = Counter()
    for suite in root.iter("testsuite"):
        failed = int(suite.get("failures", 0)) + int(suite.get("errors", 0))
        skipped = int(suite.get("skipped", 0))
        counts += Counter(
            passed=int(suite.get("tests", 0)) - failed - skipped, failed=failed, skipped=skipped
        )
    cases = [
        (case, f"{path.stem}: {case.get('classname')}::{case.get('name')}") for case in root.iter("testcase")
    ]
    seconds = [(float(case.get("time", 0)), name) for case, name in cases]
    failed = [name for case, name in cases if {"failure", "error"} & {child.tag for child in case}]
    if status not in (0, NO_TESTS) and not counts["failed"]:
        counts["failed"], failed = 1, [f"{path.stem}: exit status {status}"]
    return Outcome(counts, seconds, Counter(skip.get("message") for skip in root.iter("skipped")), failed)


def pytest(
    files: list[str],
    report: str,
    pytest_args: list[str],
    out,
    python=sys.executable,
    environment: dict[str, str] | None = None,
) -> Outcome:
    """The tests of some files."""
    since, path = time.time(), ROOT / "log" / f"{report}.xml"
    command = [python, "-m", "pytest", *files, f"--junit-xml={path}", *pytest_args]
    status = run(command, out, (environment or dict(os.environ)) | ONE_THREAD | one_cache())
    return outcome_of(path, since, status, out)


def one_cache() -> dict[str, str]:
    """Where all parts keep tables of stars: in the user's cache where there is one, else next to the build."""
    if (Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "starpos").is_dir():
        return {}
    (ROOT / "build" / "cache" / "starpos").mkdir(parents=True, exist_ok=True)
    return {"XDG_CACHE_HOME": str(ROOT / "build" / "cache")}


def folders() -> dict[str, str]:
    """The folders of packages' tests, by package."""
    packages = [path.parent for pattern in ("*", "src/*") for path in ROOT.glob(f"{pattern}/package.xml")]
    tests = [p / "test" for p in packages if any(p.glob("test/**/test_*.py"))]
    return {folder.parent.name: str(folder.relative_to(ROOT)) for folder in tests}


@cache
def seconds_of_files() -> dict[str, float]:
    """How long each file of tests takes, s, as it was recorded last."""
    rows = (line.rsplit(" ", 1) for line in SECONDS.read_text().splitlines() if not line.startswith("#"))
    return {path: float(seconds) for path, seconds in rows}


def files_in(folder: str, max_s: float = math.inf) -> list[str]:
    """Files of tests in a folder that take no longer than max_s; with a limit, which several packages share, no linters.

    Their file has one name in all packages, and a process imports one file of a name.
    """
    every = sorted((ROOT / folder).glob("**/test_*.py"))
    paths = [
        str(path.relative_to(ROOT)) for path in every if max_s == math.inf or path.name != "test_linters.py"
    ]
    return [path for path in paths if seconds_of_files().get(path, 0.0) <= max_s]


def parts(
    folders: dict[str, str], shares: dict[str, int], without: Collection[str] = (), max_s: float = math.inf
) -> dict[str, list[str]]:
    """Files of tests, by the name of their part; shares: in how many parts a folder's files run, 1 by default."""
    made = {}
    for name, folder in folders.items():
        files = [path for path in files_in(folder, max_s) if path not in without]
        count = min(shares.get(name, 1), len(files))
        lanes: list[list[str]] = [[] for _ in range(count)]
        # the longest first, each to the part that has least to do
        for path in sorted(files, key=lambda f: -seconds_of_files().get(f, 0.0)):
            min(lanes, key=lambda lane: sum(seconds_of_files().get(f, 0.1) for f in lane)).append(path)
        made |= {f"{name} {k + 1}" if count > 1 else name: sorted(lane) for k, lane in enumerate(lanes)}
    return made


def record() -> None:
    """Write how long each file of tests took, by the JUnit files of the last run with the newest versions."""
    seconds: Counter = Counter()
    for report in (ROOT / "log").glob("*.xml"):
        if not re.search("ubuntu|core", report.stem):
            for case in ElementTree.parse(report).getroot().iter("testcase"):
                seconds[f"{case.get('classname', '').replace('.', '/')}.py"] += float(case.get("time", 0))
    rows = [f"{path} {s:.1f}\n" for path, s in sorted(seconds.items()) if (ROOT / path).is_file()]
    head = "# seconds that a file of tests takes; `python tools/test.py --record` writes it after make test\n"
    SECONDS.write_text(head + "".join(rows))


def newest(pytest_args: list[str]) -> Tests:
    """Tests of all packages and of the graph, in the workspace."""
    return {
        name: partial(pytest, files, name.replace(" ", "-"), pytest_args)
        for name, files in parts(folders() | {"graph": "test"}, PARTS).items()
    }


@cache
def set_up(*command: str) -> tuple[bool, str]:
    """Run a command of set-up, once: whether it went well, and what it said."""
    done = subprocess.run(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.returncode == 0, done.stdout


def versions(out) -> Outcome:
    """Set up what Ubuntu's versions run with, and say what it is, before its tests' turn: PyPI makes it wait."""
    with MAKING:
        made, said = set_up("tools/setup/ubuntu")
    print(said, end="", file=out)
    return Outcome() if made else broken("Ubuntu's versions: no environment")


def bare_environment(python: Path, programs: Path) -> dict[str, str]:
    """Variables of a machine without counterparts: `programs` gets links to all others that are on the PATH."""
    for folder in map(Path, os.environ["PATH"].split(os.pathsep)):
        for program in folder.iterdir() if folder.is_dir() else ():
            if program.name not in COUNTERPARTS and not (programs / program.name).is_symlink():
                (programs / program.name).symlink_to(program)
    rest = {name: value for name, value in os.environ.items() if name != "STARPOS_COMPLETE"}
    return rest | {"PATH": f"{python.parent}{os.pathsep}{programs}"}


def older(
    files: list[str], report: str, pytest_args: list[str], out, before: Collection[str] = ()
) -> Outcome:
    """The tests of some files with the versions that Ubuntu 24.04 has, and nothing that a bare machine has not.

    before: folders of its environment whose packages come before all others.
    """
    ubuntu = UNDERLAY / "ubuntu"
    with MAKING:
        made, _ = set_up("tools/setup/ubuntu")
    if not made:
        return broken(f"{report}: no environment")
    python = ubuntu / "bin" / "python"
    with tempfile.TemporaryDirectory() as programs:
        # Some tests become another user.
        os.chmod(programs, 0o755)
        environment = of_its_own_ros(bare_environment(python, Path(programs)), ubuntu)
        first = [str(ubuntu / folder) for folder in (*before, "messages")]
        environment["PYTHONPATH"] = os.pathsep.join([*first, environment.get("PYTHONPATH", "")])
        chosen = ["-m", "not montecarlo", *pytest_args]
        return pytest(files, report, chosen, out, python=str(python), environment=environment)


def of_its_own_ros(variables: dict[str, str], environment: Path) -> dict[str, str]:
    """Variables of the workspace, with the ROS of an environment that has its own, as another interpreter's does."""
    if not (environment / "messages").is_dir():
        return variables
    # the wheels of ROS set the search path of libraries where this is not set
    rest = {name: value for name, value in variables.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
    return {name: value.replace(f"{UNDERLAY / 'venv'}", f"{environment}") for name, value in rest.items()}


def core(name: str, pytest_args: list[str], out) -> Outcome:
    """The tests of starpos's core with another interpreter, by its name; one skipped where this machine has none."""
    if not set_up("tools/setup/interpreter", name)[0]:
        return Outcome(Counter(skipped=1), skipped=Counter({f"{name} is not on this machine": 1}))
    made, said = set_up("tools/setup/core", name)
    print(said, end="", file=out, flush=True)
    if not made:
        return broken(f"core with {name}: no environment")
    python = UNDERLAY / f"core-{name.removeprefix('python')}" / "bin" / "python"
    chosen = ["-m", "not montecarlo", *pytest_args]
    return pytest(CORE, f"core-{name}", chosen, out, python=str(python))


def others(pytest_args: list[str]) -> Tests:
    """Tests of the core with the interpreters that neither the workspace nor Ubuntu's versions run with."""
    own = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    return {f"core with {name}": partial(core, name, pytest_args) for name in OTHERS if name != own}


def ubuntus(pytest_args: list[str]) -> Tests:
    """Tests of all packages with Ubuntu's versions, and of what the Earth's rotation enters with Ubuntu's table of it."""
    rotating = [path for folder in ROTATING for path in files_in(folder, UBUNTU_S)]
    of_packages = parts(folders(), UBUNTU_PARTS, {*NEWEST_ONLY, *rotating}, UBUNTU_S)
    made = {name: files for name, files in of_packages.items() if name.startswith("starpos ")}
    # the others have few files each, and importing takes longer than their tests: all in one process
    made["nodes"] = [path for name, files in of_packages.items() if name not in made for path in files]
    tests = {
        f"{UBUNTU}{name}": partial(older, files, f"{name.replace(' ', '-')}-ubuntu", pytest_args)
        for name, files in made.items()
    }
    table = partial(older, rotating, "table-ubuntu", pytest_args, before=["old_table"])
    return tests | {f"{UBUNTU}table": table, "versions": versions}


def shown(name: str, tests: Callable) -> Outcome:
    """Run tests and show their output when it is whole."""
    begin = time.monotonic()
    with tempfile.TemporaryFile("w+") as out:
        outcome = tests(out)
        out.seek(0)
        with PRINTING:
            print(f"== {name}, {time.monotonic() - begin:.0f} s\n{out.read()}", flush=True)
    return outcome


def turn(name: str) -> tuple[bool, int, int]:
    """When a part runs: linters, the first of each package, then the second of each; Ubuntu's short ones fill the end."""
    package, *number = name.removeprefix(UBUNTU).split()
    if package in CHECKS:
        return False, 0, 0
    if package == "core":
        # they begin by compiling
        return False, 2, 0
    first = FIRST.index(package) if package in FIRST else len(FIRST)
    return name.startswith(UBUNTU), int(*number) if number else max(PARTS.values()) // 2, first


def all_of(tests: Tests) -> Outcome:
    """The outcome of all, some at once."""
    with ThreadPoolExecutor(LANES) as lanes:
        return sum(lanes.map(lambda name: shown(name, tests[name]), sorted(tests, key=turn)), Outcome())


def main(args: list[str]) -> int:
    if args == ["--record"]:
        record()
        return 0
    # hundreds of processes start here, each of which would compile all modules anew
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    which = {"--docs", "--lint", "--quick", "--ubuntu", "--both"} & set(args)
    pytest_args = [a for a in args if a not in which]
    tests = {} if which & {"--docs", "--lint", "--quick", "--ubuntu"} else newest(pytest_args)
    if "--quick" in which:
        tests["linters"] = partial(lint, FAST_LINTERS)
        quick = [path for folder in folders().values() for path in files_in(folder, QUICK_S)]
        for k in range(QUICK_PARTS):
            tests[f"quick {k + 1}"] = partial(pytest, quick[k::QUICK_PARTS], f"quick-{k + 1}", pytest_args)
    if not which & {"--docs", "--quick", "--ubuntu"}:
        tests["linters"] = partial(lint, LINTERS)
    if which & {"--docs", "--both"}:
        tests["documents"] = partial(lint, DOCS)
    if which & {"--ubuntu", "--both"}:
        tests |= ubuntus(pytest_args)
    if "--both" in which:
        tests |= others(pytest_args)
    total = all_of(tests)
    for reason, count in sorted(total.skipped.items()):
        print(f"{count:4d} skipped: {reason}")
    for seconds, name in sorted(total.seconds, reverse=True)[:SHOWN]:
        print(f"{seconds:6.1f} s  {name}")
    for name in total.failed:
        print(f"failed: {name}")
    print(
        f"{total.counts['passed']} passed, {total.counts['failed']} failed, {total.counts['skipped']} skipped"
    )
    return int(total.counts["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
