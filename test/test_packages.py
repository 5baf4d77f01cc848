# SPDX-License-Identifier: Apache-2.0
"""What every package says of itself: read by the tool that colcon and rosdep read it with, the same in all its places."""

import re
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package

ROOT = Path(__file__).parents[1]
FOLDERS = sorted(p.parent for folder in (ROOT, ROOT / "src") for p in folder.glob("*/package.xml"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_manifest_is_sound(folder):
    warnings = []
    package = parse_package(folder, warnings=warnings)
    package.validate(warnings)
    assert not warnings
    assert package.name == folder.name
    assert package.licenses == ["Apache-2.0"]


def test_all_have_one_version():
    assert len({parse_package(folder).version for folder in FOLDERS}) == 1


@pytest.mark.parametrize(
    "folder", [f for f in FOLDERS if (f / "setup.py").is_file()], ids=lambda folder: folder.name
)
def test_setup_py_says_what_the_manifest_says(folder):
    package, setup = parse_package(folder), (folder / "setup.py").read_text()
    for key, value in (("version", package.version), ("license", package.licenses[0])):
        assert re.findall(rf'\b{key}="(.*?)"', setup) == [value]
    assert package.maintainers[0].email in setup
