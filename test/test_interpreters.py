# SPDX-License-Identifier: Apache-2.0
"""Which interpreter a name means, and the messages on the versions of a test run and on an absent one."""

import importlib.util
import subprocess
import sys
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import pytest

TOOLS = Path(__file__).parent.parent / "tools"


@pytest.fixture(scope="module")
def tests():
    """The module tools/test.py."""
    spec = importlib.util.spec_from_file_location("tools_test", TOOLS / "test.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def program(path: Path, *lines: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(["#!/bin/sh", *lines, ""]))
    path.chmod(0o755)
    return path


def meant(name: str, monkeypatch, folder: Path) -> tuple[int, str]:
    """Exit status and answer for a name, with a folder's `bin` on the path and the folder as pyenv's."""
    monkeypatch.setenv("PATH", f"{folder / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("PYENV_ROOT", str(folder))
    done = subprocess.run(
        [TOOLS / "setup" / "interpreter", name], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout


def test_where_the_path_has_only_pyenvs_stand_in_the_newest_of_pyenv_is_meant(monkeypatch, tmp_path):
    program(tmp_path / "bin" / "python9.8", "exit 127")
    found = [
        program(tmp_path / "versions" / f"9.8.{n}" / "bin" / "python9.8", 'echo "$0"') for n in (2, 10, 9)
    ]
    assert meant("python9.8", monkeypatch, tmp_path) == (0, f"{found[1]}\n")
    first = program(tmp_path / "bin" / "python9.8", 'echo "$0"')
    assert meant("python9.8", monkeypatch, tmp_path) == (0, f"{first}\n")


def test_one_that_is_not_on_this_machine_is_skipped_and_said(monkeypatch, tmp_path, tests):
    assert meant("python9.8", monkeypatch, tmp_path) == (1, "")
    outcome = tests.core("python9.8", [], None)
    assert outcome == tests.Outcome(
        Counter(skipped=1), skipped=Counter({"python9.8 is not on this machine": 1})
    )


def test_versions_that_are_not_ubuntus_are_named(tmp_path):
    listed = tmp_path / "list.txt"
    here = version("pytest")
    listed.write_text(f'pytest==0.1 ; python_version < "3"\npytest=={here}\npluggy=={version("pluggy")}\n')
    command = [sys.executable, str(TOOLS / "setup" / "said.py"), str(listed)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    python = ".".join(map(str, sys.version_info[:3]))
    assert said == f"Ubuntu 24.04's versions with Python {python}, pytest {here} for 0.1\n"


def test_variables_name_the_ros_of_the_interpreter_that_has_its_own(tmp_path, tests):
    theirs = {
        "AMENT_PREFIX_PATH": f"/ws/install:{tests.UNDERLAY / 'venv'}",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
    }
    assert tests.of_its_own_ros(theirs, tmp_path) == theirs
    (tmp_path / "messages").mkdir()
    assert tests.of_its_own_ros(theirs, tmp_path) == {"AMENT_PREFIX_PATH": f"/ws/install:{tmp_path}"}


def test_the_core_is_tested_by_files_that_are_there(tests):
    assert all((tests.ROOT / path).is_file() for path in tests.CORE)
