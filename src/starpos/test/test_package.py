# SPDX-License-Identifier: Apache-2.0
"""What the package says of itself, and the licences that go with it."""

import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1]
REPOSITORY = PACKAGE.parents[1]


def test_the_licences_of_what_is_shipped_go_with_it():
    kept = {f.name: f.read_bytes() for f in (PACKAGE / "LICENSES").iterdir()}
    assert set(kept) == {"Apache-2.0.txt", "BSD-2-Clause.txt", "ISC.txt", "LicenseRef-Natural-Earth.txt"}
    assert kept == {name: (REPOSITORY / "LICENSES" / name).read_bytes() for name in kept}
    assert (REPOSITORY / "LICENSE").read_bytes() == kept["Apache-2.0.txt"]
    assert b"Redistributions in binary form" in kept["BSD-2-Clause.txt"]
    assert b"Hog E., Fabricius C." in kept["BSD-2-Clause.txt"]


def test_the_metadata_is_whole():
    """What `twine check` does not ask for."""
    text = (PACKAGE / "pyproject.toml").read_text()
    for key in ("description", "readme", "authors", "maintainers", "keywords", "classifiers"):
        assert re.search(rf"^{key} = .", text, re.MULTILINE), key
    assert re.search(r'^\[project\.urls\]\n".*" = "https://', text, re.MULTILINE)
    assert 'license_files=["LICENSES/*"]' in (PACKAGE / "setup.py").read_text()


def test_a_wheel_is_tested_by_what_is_there():
    text = (PACKAGE / "pyproject.toml").read_text()
    places = {"project": REPOSITORY, "package": PACKAGE}
    named = [places[place] / path for place, path in re.findall(r"\{(project|package)\}/([\w/.]+)", text)]
    assert len(named) > 1 and [path for path in named if not path.exists()] == []


def shipped() -> set[str]:
    """What the package consists of, tables and sources of compiled modules too: `starpos/...`."""
    made = {".c", ".pyc", ".so"}
    files = {path.relative_to(PACKAGE).as_posix() for path in PACKAGE.glob("starpos/**/*") if path.is_file()}
    return {path for path in files if Path(path).suffix not in made or path == "starpos/_numeric/_views.c"}


@pytest.mark.parametrize("command", ["sdist", "build_py"])
def test_a_package_holds_all_that_ships(command, tmp_path):
    """The source package all, a wheel all but what its compiled modules are made of."""
    pytest.importorskip("Cython", reason="setup.py asks Cython for its version")
    options = {"sdist": ("--formats", "tar", "--dist-dir"), "build_py": ("--build-lib",)}[command]
    # in a copy: it writes next to setup.py, where others may be at work
    source, unused = tmp_path / "source", ("test", "build", "*.so", "*.egg-info", "__pycache__")
    shutil.copytree(PACKAGE, source, ignore=shutil.ignore_patterns(*unused))
    setup = [sys.executable, "-W", "ignore", "setup.py", "-q", command, *options, str(tmp_path)]
    subprocess.run(setup, cwd=source, check=True, capture_output=True)
    if command == "sdist":
        with tarfile.open(*tmp_path.glob("*.tar")) as packed:
            held, wanted = {name.partition("/")[2] for name in packed.getnames()}, shipped()
    else:
        held = {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("starpos/**/*")}
        wanted = {path for path in shipped() if Path(path).suffix not in {".c", ".h", ".pxd", ".pyx"}}
    assert len(wanted) > 200 and wanted - held == set()


def test_who_made_the_data_is_said():
    said = (REPOSITORY / "REUSE.toml").read_text()
    # rows of commands, keywords, parameters and data sheets are this project's own, and each file says so
    rooms = "cli", "frames", "instrument", "navigation", "parameters", "satellites"
    own = {PACKAGE / "starpos" / room / "data" for room in rooms}
    for data in {*PACKAGE.glob("starpos/*/data")} - own:
        assert f'"{data.relative_to(REPOSITORY).as_posix()}/**"' in said


def test_every_extra_is_told_where_people_install():
    text = (PACKAGE / "setup.py").read_text()
    [table] = re.findall(r"extras_require=\{\n(.*?)\n    \}", text, re.DOTALL)
    extras = set(re.findall(r'^ +"(\w+)":', table, re.MULTILINE)) - {"test"}
    page = (REPOSITORY / "docs" / "how-to" / "install.md").read_text()
    assert extras and {name for name in extras if f"| `{name}` |" not in page} == set()


def test_colcon_finds_the_command_in_setup_py():
    """It builds links from setup.py alone: an entry point in pyproject.toml would be no command on a robot."""
    assert (
        'entry_points={"console_scripts": ["starpos = starpos.cli:main"]}'
        in (PACKAGE / "setup.py").read_text()
    )
    assert "[project.scripts]" not in (PACKAGE / "pyproject.toml").read_text()
