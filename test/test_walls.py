# SPDX-License-Identifier: Apache-2.0
"""Each kind of breach of the rules of imports and names is seen; whether there are any, `make lint` says."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


PLAN = ROOT / "docs" / "architecture.md"
# modules that the contracts forbid, each with what is said of it
FORBIDDEN = {
    "starpos.frames.new": ("from starpos.fix import fix", "starpos.frames.new -> starpos.fix"),
    "starpos.earth.new": ("import starpos.instrument", "starpos.earth.new -> starpos.instrument"),
    "starpos.units": ("def f():\n    from starpos import frames", "starpos.units -> starpos.frames"),
    "starpos.cellar": ("", "starpos.cellar"),
    "starpos.fix.new": ("from starpos_common import exits", "starpos.fix.new -> starpos_common"),
    "starpos_solver.new": ("import starpos_camera", "starpos_solver.new -> starpos_camera"),
    "starpos_common.new": ("import starpos_testing", "starpos_common.new -> starpos_testing"),
    "starpos_bringup.new": ("import starpos_testing", "starpos_bringup.new -> starpos_testing"),
    "starpos.sky.a": ("from starpos.sky import b", "starpos.sky"),
    "starpos.sky.b": ("def f():\n    from starpos.sky import a", "starpos.sky"),
}


@pytest.fixture(scope="module")
def walls():
    spec = importlib.util.spec_from_file_location("walls", ROOT / "tools" / "walls.py")
    sys.modules["walls"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["walls"]


FIELDS = "".join(f"    {name}: float\n" for name in "abcdef")
BREACHES = [
    ("outside", {"starpos.frames.new": "from starpos import Solver"}, "brings in every folder"),
    ("outside", {"starpos.frames.new": "import starpos"}, "brings in every folder"),
    ("outside", {"starpos.fix.new": "def f():\n    from rclpy.node import Node"}, "which is ROS"),
    ("outside", {"starpos.fix.new": "from sensor_msgs.msg import Image"}, "which is ROS"),
    ("outside", {"starpos.fix.new": "from starpos_interfaces.msg import Tilt"}, "which is ROS"),
    ("outside", {"starpos.fix.new": "import tf2_ros"}, "which is ROS"),
    ("outside", {"starpos.fix.new": "from rosbag2_py import SequentialReader"}, "which is ROS"),
    ("aliases", {"starpos.fix.new": "from starpos.fix.solver import Solution as Answer"}, "as Answer"),
    ("twins", {"starpos.fix.a": "class Two: ...", "starpos_solver.b": "class Two: ..."}, "2 things"),
    (
        "same_functions",
        {
            "starpos.fix._new": "def two(x):\n    return x",
            "starpos.earth.b": "def two(): ...",
            "starpos.fix.c": "from starpos.fix._new import two",
            "starpos.fix.d": "from starpos.earth.b import two",
        },
        "starpos.fix: two stands for 2 things, of starpos.earth.b and starpos.fix._new",
    ),
    ("keywords", {"starpos.fix.new": f"@dataclass(frozen=True)\nclass Six:\n{FIELDS}"}, "6 fields"),
    ("words", {"starpos.fix.new": '"""Of nothing."""'}, "a verb or a noun"),
    ("words", {"starpos.fix.new": "x = 1\n" * 950}, "950 lines"),
    ("words", {"starpos.fix.new": 'def f():\n    """By how much."""'}, "a verb or a noun"),
    ("words", {"starpos.fix._new": 'cdef f():\n    """And more.\n    """'}, "new.py:2"),
    ("words", {"starpos.fix._new": "x = 1\n" * 950}, "950 lines"),
    ("comments", {"starpos.fix.new": "# Above.\nx = 1  # noqa: E741\ny = 2  # in m\n"}, "new.py:3"),
    ("comments", {"starpos.fix._new": "# Above.\nx = '#'\ny = 2  # in m\n"}, "new.py:3"),
    (
        "cimports",
        {"starpos.fix._new": '"""Text.\n"""\nimport numpy as np, rclpy'},
        "new.py:3: a compiled module imports rclpy",
    ),
    ("cimports", {"starpos.fix._new": "def f():\n    from starpos.fix import fix"}, "imports starpos.fix"),
    ("cimports", {"starpos.fix._new": "cimport starpos.earth.gravity"}, "imports starpos.earth.gravity"),
    ("cimports", {"starpos.fix._new": "from . cimport algebra"}, "imports ."),
    (
        "cimports",
        {"starpos.earth._new": "from starpos.instrument._lens cimport Lens"},
        "(floor 2) imports instrument",
    ),
    ("cimports", {"starpos._numeric.new": "cimport starpos.earth._air"}, "(floor 0) imports earth (floor 2)"),
    (
        "uncalled",
        {"starpos.fix._new": "", "starpos.cli.new": "from starpos.fix._new import f"},
        "nothing in fix calls it",
    ),
]


def modules_of(walls, sources):
    return [
        (walls.Compiled if "._" in name else walls.Module)(name, ROOT / "new.py", text)
        for name, text in sources.items()
    ]


def table(heading: str) -> list[list[str]]:
    """The cells of the table under a heading of docs/architecture.md."""
    section = PLAN.read_text().split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_plan_has_the_floors_that_the_contracts_have(walls):
    assert walls.floors() == {
        name: int(floor)
        for floor, cell, _ in table("Folders of starpos")
        for name in re.findall(r"`(\w+)`", cell)
    }


def test_the_plan_allows_what_the_contracts_allow():
    """A package may import those that stand below it in the contract of packages, and bringup no helpers of tests."""
    contract = (ROOT / "tools" / "imports.ini").read_text().split("contract:packages]")[1].split("[")[0]
    floors = [re.findall(r"starpos\w*", line) for line in contract.split("layers =")[1].splitlines()]
    may, below = {}, set()
    for floor in reversed(floors):
        may |= {name: set(below) for name in floor}
        below |= set(floor)
    may["starpos_bringup"] -= {"starpos_testing"}
    nodes = {"starpos_camera", "starpos_inclinometer", "starpos_solver", "starpos_dashboard"}
    said = {
        "starpos": {"starpos"},
        "common": {"starpos_common"},
        "all nodes": nodes | {"starpos", "starpos_common"},
    }
    rows = {re.findall(r"`(?:src/)?(\w+)`", where)[0]: cell for where, _, cell in table("Packages")}
    for package, allowed in may.items():
        words = [
            word
            for word in said
            if re.search(rf"\b{word}\b", rows[package]) and "no ROS" not in rows[package]
        ]
        assert set().union(*(said[word] for word in words)) == allowed, package


def test_import_linter_sees_what_the_contracts_forbid(walls, tmp_path):
    folders = [f"starpos.{folder}" for folder in walls.floors()]
    sources = dict.fromkeys([*walls.packages(), *folders], "") | {
        m: text for m, (text, _) in FORBIDDEN.items()
    }
    for name, text in sources.items():
        path = tmp_path.joinpath(*name.split("."))
        is_folder = name in walls.packages() or any(other.startswith(f"{name}.") for other in sources)
        file = path / "__init__.py" if is_folder else path.with_suffix(".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    done = subprocess.run(
        ["lint-imports", "--config", str(ROOT / "tools" / "imports.ini"), "--no-cache"],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ['PYTHONPATH']}", "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and "0 kept, 4 broken" in done.stdout, done.stdout
    assert [said for _, said in FORBIDDEN.values() if said not in done.stdout] == []


@pytest.mark.parametrize(("rule", "sources", "sentence"), BREACHES)
def test_a_breach_is_seen(walls, rule, sources, sentence):
    found = list(getattr(walls, rule)(modules_of(walls, sources)))
    assert len(found) == 1 and sentence in found[0]


def test_what_is_allowed_is_no_breach(walls):
    sources = {
        "starpos.fix.new": "import numpy as np\nfrom starpos.identification import Sky\nimport yaml\nimport json",
        "starpos_solver.new": "from starpos.fix.solver import Solver\nfrom starpos_interfaces.msg import Tilt",
        "starpos.rotation": "from starpos.units import ARCSEC",
        "starpos.cli.new": "from starpos import __version__, rotation",
        "starpos_bringup.new": "import starpos\nimport tf2_ros",
    }
    modules = modules_of(walls, sources)
    assert [*walls.outside(modules), *walls.aliases(modules)] == []


def test_what_a_compiled_module_may_is_no_breach(walls):
    text = (
        '# Above, "as it stands.\n"""Text: from rclpy import Node."""\n'
        "from libc.math cimport sqrt\nfrom starpos._numeric.algebra cimport Point\ncimport starpos._numeric.wide\n"
        "from starpos.earth._air cimport Refraction\n"
        'cdef extern from *:\n    """\n    By C.\n    """\n    void f()\n'
        'def f():\n    """As many as `many`."""\n    return "# no comment"\n'
    )
    modules = modules_of(walls, {"starpos.fix._new": text, "starpos.fix.a": "from starpos.fix._new import f"})
    compiled = modules[:1]
    assert [
        *walls.cimports(compiled),
        *walls.uncalled(modules),
        *walls.words(modules),
        *walls.comments(modules),
    ] == []
