# SPDX-License-Identifier: Apache-2.0
"""What comes from outside stays data and of bounded size, in all of the product, so that new code is looked at too."""

import ast
from functools import cache
from pathlib import Path

import pytest

from starpos.earth import geoid
from starpos.errors import StarposError
from starpos.frames.reading import read_frame
from starpos.instrument import instrument_file
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.messages.stars import MAX_STARS, message_to_stars
from starpos.navigation.records import read_imu
from starpos_interfaces.msg import Star, StarArray

ROOT = Path(__file__).parents[1]
PRODUCT = [
    ROOT / "src" / package / package
    for package in ("starpos", "starpos_bringup", "starpos_common", "starpos_dashboard")
]
PRODUCT += [
    ROOT / package / package for package in ("starpos_camera", "starpos_inclinometer", "starpos_solver")
]
# bytes that become code or objects, or call a shell
FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "subprocess", "xml"}
FORBIDDEN_NAMES = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_ATTRIBUTES = {
    ("os", name) for name in ("system", "popen", "execv", "execvp", "spawnv", "startfile")
}
YAML = {"safe_load", "safe_dump", "YAMLError", "YAMLObject", "SafeDumper"}
ALLOWED = {
    # between the processes of one command
    "starpos/parallel/processes.py": {"pickle"},
    # as dataclasses does: of the names of this program's own fields
    "starpos/frozen.py": {"exec"},
    # a SafeLoader that refuses aliases too; a scan makes pieces of text, no objects
    "starpos/instrument/yaml_file.py": {
        "yaml.load",
        "yaml.SafeLoader",
        "yaml.AliasEvent",
        "yaml.scan",
        "yaml.ScalarToken",
    },
    # of the package's own files
    "starpos/files.py": {"yaml.load", "yaml.SafeLoader"},
    # of MOST_BYTES, without declarations
    "starpos/satellites/elements.py": {"xml"},
    # elements of ELEMENT_MAX, within a root of ours, where XML has no declarations
    "starpos_camera/sources/indi.py": {"xml"},
}
# Who reads a file whole, or a table, and what bounds it: a limit, or that it came with the package.
READS_WHOLE = {
    "starpos/earth/orientation.py": "the table of the Earth's rotation that astropy brings",
    "starpos/sky/catalogue.py": "of the package, and the checksum of its table of parallaxes",
    "starpos/report/coast.py": "of the package",
    "starpos/night/field.py": "MAX_BYTES",
    "starpos/recording/bag.py": "installed messages; MAX_METADATA",
    "starpos/cli/__init__.py": "of the package: the list of commands",
    "starpos/tables.py": "most_bytes of each form",
    "starpos/frames/tables.py": "MAX_CSV_BYTES",
    "starpos/files.py": "of the package",
    "starpos/cli/demo.py": "what it has written",
    "starpos/instrument/phone_log.py": "texts that are unpacked within a limit",
    "starpos_bringup/bag.py": "installed messages",
    "starpos_dashboard/server.py": "of the package",
    "starpos_inclinometer/sources/iio_device.py": "an attribute of the kernel is a page at most",
}
WHOLE = {"read_text", "read_bytes", "loadtxt", "genfromtxt", "fromfile", "readlines"}


@cache
def sources() -> dict[str, ast.Module]:
    """The product's modules by package/path."""
    found = {}
    for package in PRODUCT:
        for path in sorted(package.rglob("*.py")):
            found[str(path.relative_to(package.parent))] = ast.parse(path.read_text())
    return found


def calls_and_names():
    """(file, node) of everything in the product."""
    for name, tree in sources().items():
        for node in ast.walk(tree):
            yield name, node


def imported(node) -> list[str]:
    """Top-level names of the modules that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name.split(".")[0] for alias in node.names]
    return [(node.module or "").split(".")[0]] if isinstance(node, ast.ImportFrom) else []


def dotted(node) -> tuple[str, str]:
    """("yaml", "load") of yaml.load; empty words otherwise."""
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return node.value.id, node.attr
    return "", ""


def test_nothing_that_is_read_becomes_code():
    found = []
    for name, node in calls_and_names():
        used = set(imported(node)) & FORBIDDEN_MODULES
        if isinstance(node, ast.Name) and node.id in FORBIDDEN_NAMES:
            used.add(node.id)
        if dotted(node) in FORBIDDEN_ATTRIBUTES or (
            dotted(node)[0] == "yaml" and dotted(node)[1] not in YAML
        ):
            used.add(".".join(dotted(node)))
        if isinstance(node, ast.ImportFrom) and node.module == "yaml":
            used.add("from yaml import")
        if isinstance(node, ast.keyword) and node.arg == "shell":
            used.add("shell=")
        found += [(name, what) for what in used - ALLOWED.get(name, set())]
    assert not found


def test_numpy_files_hold_arrays_only():
    loads = [n for _, n in calls_and_names() if isinstance(n, ast.Call) and dotted(n.func) == ("np", "load")]
    assert loads
    for call in loads:
        said = {k.arg: getattr(k.value, "value", None) for k in call.keywords}
        assert said.get("allow_pickle") is False, ast.unparse(call)


def test_who_reads_whole_files_is_known():
    found = {
        name
        for name, node in calls_and_names()
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WHOLE
    }
    assert found == set(READS_WHOLE), "bound what it reads, and enter it here"


def test_the_search_covers_the_product_and_would_find(monkeypatch):
    assert len(sources()) > 100
    for package in PRODUCT:
        assert any(name.startswith(f"{package.name}/") for name in sources())
    bad = "import pickle, yaml\nx = eval('1')\nyaml.load(f)\nos.system('ls')\np.read_text()\nnp.load(f)\n"
    monkeypatch.setattr(f"{__name__}.sources", lambda: {"starpos/bad.py": ast.parse(bad)})
    for test in (
        test_nothing_that_is_read_becomes_code,
        test_numpy_files_hold_arrays_only,
        test_who_reads_whole_files_is_known,
    ):
        with pytest.raises(AssertionError):
            test()


@pytest.mark.parametrize(
    ("name", "head", "size", "read"),
    [
        ("stars.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y,flux\n', 1 << 40, read_frame),
        ("frame.png", b"\x89PNG\r\n\x1a\n", 1 << 40, read_frame),
        ("frame.cr2", b"II*\0", 1 << 40, read_frame),
        ("tilt.csv", b"utc_unix_s,theta_x_deg,theta_y_deg\n", 1 << 40, read_tilt_csv),
        ("imu.csv", b"utc_unix_s,gx,gy,gz,ax,ay,az\n", 1 << 40, read_imu),
        ("instrument.yaml", b"starpos_instrument: 1\n", 1 << 40, instrument_file.read),
        ("camera.yaml", b"image_width: 1\n", 1 << 40, instrument_file.read_camera),
        ("geoid.tif", b"II*\0", 1 << 40, geoid.read),
        ("geoid.gtx", b"\x40" * 40, 1 << 40, geoid.read),
    ],
)
def test_a_file_of_a_terabyte_is_refused_unread(tmp_path, name, head, size, read):
    path = tmp_path / name
    with path.open("wb") as file:
        file.write(head)
        # No disk holds that: a hole.
        file.truncate(size)
    with pytest.raises(StarposError, match=name):
        read(path)


def test_more_stars_than_a_detector_sends_are_refused():
    message = StarArray(width=100, height=100, stars=[Star()] * (MAX_STARS + 1))
    with pytest.raises(StarposError, match="100001 stars"):
        message_to_stars(message)
