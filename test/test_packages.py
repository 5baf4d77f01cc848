# SPDX-License-Identifier: Apache-2.0
"""What every package says of itself: read by the tool that colcon and rosdep read it with, the same in all its places."""

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package
from catkin_pkg.package_version import get_forthcoming_label, rename_section

ROOT = Path(__file__).parents[1]
FOLDERS = sorted(p.parent for folder in (ROOT, ROOT / "src") for p in folder.glob("*/package.xml"))
PYTHON = [f for f in FOLDERS if (f / "setup.py").is_file()]
# Keys of modules that are no ROS package, each in rosdep's list (rosdep/python.yaml of ros/rosdistro).
KEYS = {
    "astropy": "python3-astropy",
    "astropy_iers_data": "python3-astropy",
    "cv2": "python3-opencv",
    "erfa": "python3-astropy",
    "matplotlib": "python3-matplotlib",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "scipy": "python3-scipy",
    "serial": "python3-serial",
    "tornado": "python3-tornado",
    "yaml": "python3-yaml",
}
# Only PyPI has them, or brings them with these, or apt for one Python (gi), and the code says so where one is absent; a
# module of ours that cannot do without is one of them
OPTIONAL = {
    "PIL", "alpaca", "alpaca_simulators", "argcomplete", "exifread", "fastjsonschema",
    "gi", "gphoto2", "jplephem", "lz4", "pillow_heif", "rawpy", "rosbags", "selenium", "sgp4",
    "starpos_testing.skies.bags", "starpos_testing.skies.robots",
}  # fmt: skip
# Modules next to the tests.
HELPERS = {path.stem for folder in PYTHON for path in folder.glob("test/**/*.py")}
# A test writes it.
HELPERS |= {"late_starpos"}
# starpos_testing stands on these, so they cannot name it: colcon would find a circle
BELOW_TESTING = {"starpos", "starpos_common"}
# Programs, which nothing imports.
RUN_BY_COMMAND = {"libxml2-utils", "ros2launch", "xacro"}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_manifest_is_sound(folder):
    warnings = []
    package = parse_package(folder, warnings=warnings)
    package.validate(warnings)
    assert not warnings
    assert package.name == folder.name
    assert package.licenses[0] == "Apache-2.0"
    kept = {file.stem.removeprefix("LicenseRef-") for file in (ROOT / "LICENSES").iterdir()}
    assert {name.removeprefix("LicenseRef-") for name in package.licenses} <= kept


def test_all_have_one_version():
    [version] = {parse_package(folder).version for folder in FOLDERS}
    assert f"All are at version {version} (" in (ROOT / "CHANGELOG.rst").read_text()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.filterwarnings("ignore:nodes.Node.traverse:DeprecationWarning")
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_changelog_can_be_released_by_catkin_prepare_release(folder):
    """`catkin_prepare_release` renames `Forthcoming`; bloom reads the changes of each version; a change is one line."""
    package = parse_package(folder)
    log = get_changelog_from_path(str(folder), package.name)
    released = list(log.foreach_version(reverse=True))
    assert released[0][0] == package.version and all(changes for *_, changes in released)
    title, label = f"Changelog for package {package.name}", get_forthcoming_label(log.rst)
    next_release = rename_section(log.rst, label, "9.9.9 (2100-01-01)") if label else log.rst
    bar, name, again, *lines = next_release.splitlines()
    assert name == title and bar == again == "^" * len(title)
    assert all(re.match(r"\* |\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\)$|-+$|$", line) for line in lines)


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_setup_py_says_what_the_manifest_says(folder):
    package, setup = parse_package(folder), (folder / "setup.py").read_text()
    assert re.findall(r'\bversion="(.*?)"', setup) == [package.version]
    [licences] = re.findall(r'\blicense="(.*?)"', setup)
    assert set(package.licenses) <= set(licences.split(" AND "))
    more = folder / "pyproject.toml"
    assert package.maintainers[0].name in setup + (more.read_text() if more.is_file() else "")


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_address_of_a_manifest_receives_no_mail(folder):
    """ROS wants one; the issue tracker is where people write, and a made-up address would lose what they send."""
    assert {m.email.partition("@")[2] for m in parse_package(folder).maintainers} == {
        "users.noreply.github.com"
    }


def imports(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """The modules that a file names, dotted, and whether at its top; what `from` takes out of one may be one too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.col_offset == 0) for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            yield from ((f"{node.module}.{alias.name}", node.col_offset == 0) for alias in node.names)


def is_any(module: str, names: set[str]) -> bool:
    """Whether it is one of them or in one."""
    return any(f"{module}.".startswith(f"{name}.") for name in names)


@cache
class Code:
    """A package's Python files and what they import; {dotted name: {imported: at the top}}."""

    def __init__(self, folder: Path):
        self.run, self.test = {}, {}
        for path in (f for part in (folder.name, "launch", "test") for f in folder.glob(f"{part}/**/*.py")):
            name = ".".join(path.relative_to(folder).with_suffix("").parts)
            kind = self.test if name.startswith("test.") else self.run
            kind[name] = dict(sorted(imports(ast.parse(path.read_text()))))


def keys_of(files: dict[str, dict[str, bool]], own: str) -> set[str]:
    """What package.xml must name for files, wherever in them they import it."""
    modules = {module for modules in files.values() for module in modules if not is_any(module, OPTIONAL)}
    names = {module.partition(".")[0] for module in modules} - {own} - HELPERS - sys.stdlib_module_names
    return {KEYS.get(name, name) for name in names}


def names(dependencies) -> set[str]:
    return {dependency.name for dependency in dependencies}


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_the_manifest_names_what_the_code_imports_and_no_more(folder):
    texts = [f.read_text() for part in ("launch", folder.name) for f in folder.glob(f"{part}/*launch*.py")]
    launched = {f.name for f in FOLDERS if any(f'"{f.name}"' in text for text in texts)}
    wanted = (keys_of(Code(folder).run, folder.name) | launched) - {folder.name}
    assert wanted == names(parse_package(folder).exec_depends) - RUN_BY_COMMAND


def test_who_installs_a_package_with_launch_files_or_xacros_can_run_them():
    for files, program in (("launch/*.launch.py", "ros2launch"), ("urdf/*.xacro", "xacro")):
        folders = [folder for folder in FOLDERS if any(folder.glob(files))]
        assert folders and all(program in names(parse_package(f).exec_depends) for f in folders)


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_the_manifest_names_what_the_tests_import(folder):
    package, wanted = parse_package(folder), keys_of(Code(folder).test, folder.name)
    if package.name in BELOW_TESTING:
        wanted -= {"starpos_testing"}
    assert wanted <= names(package.exec_depends + package.test_depends)


@pytest.mark.parametrize("folder", PYTHON, ids=lambda folder: folder.name)
def test_what_only_pypi_has_is_imported_where_it_is_needed_only(folder):
    """A module's first lines are run also where it is absent."""
    for name, modules in Code(folder).run.items():
        at_top = {module for module, top in modules.items() if top and is_any(module, OPTIONAL)}
        assert not at_top or name in OPTIONAL, f"{name} imports {at_top} at its top"
