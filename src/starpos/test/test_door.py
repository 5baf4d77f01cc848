# SPDX-License-Identifier: Apache-2.0
"""The package's one door: its public names, each imported when it is first asked for."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import starpos

SOURCE = Path(starpos.__file__)
README = SOURCE.resolve().parents[1] / "README.md"


def said(program: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("name", starpos.__all__)
def test_a_public_name_is_there_and_documented(name):
    assert getattr(starpos, name).__doc__
    assert name in dir(starpos)


def test_what_is_no_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = starpos.nothing


def test_type_checkers_are_told_the_same():
    told = [
        n for n in ast.parse(SOURCE.with_suffix(".pyi").read_text()).body if isinstance(n, ast.ImportFrom)
    ]
    assert {a.name: n.module.removeprefix("starpos.") for n in told for a in n.names} == starpos._HOMES


def test_the_door_itself_imports_nothing_heavy():
    heavy = "[m for m in ('numpy', 'scipy', 'astropy', 'erfa', 'cv2', 'yaml') if m in sys.modules]"
    assert said(f"import sys, starpos; print({heavy})") == "[]"
    assert said(f"import sys, starpos; starpos.StarposError; print({heavy})") == "[]"


def test_the_readmes_example_solves_a_night(tmp_path):
    [example] = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    wide = ["--focal-mm", "29.67", "--size", "1000", "700", "-n", "1"]
    from starpos.cli import main

    assert main(["simulate", str(tmp_path / "night"), "--pixel-um", "6.4", *wide]) == 0
    program = example.replace("600e3 / 6.4", "29.67e3 / 6.4").replace("night/", f"{tmp_path}/night/")
    assert said(program).startswith("Status.OK")
