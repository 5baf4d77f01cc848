# SPDX-License-Identifier: Apache-2.0
"""A breach of each kind of the walls of the house is seen; that they hold, `make lint` sees."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def walls():
    spec = importlib.util.spec_from_file_location("walls", ROOT / "tools" / "walls.py")
    sys.modules["walls"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules["walls"]


FIELDS = "".join(f"    {name}: float\n" for name in "abcdef")
BREACHES = [
    ("layers", {"starpos.frames.new": "from starpos.sky.catalogue import Catalogue"}, "floor 1"),
    ("layers", {"starpos.frames.new": "from starpos.fix import fix"}, "floor 1"),
    (
        "layers",
        {"starpos.frames.new": "from starpos import Solver"},
        "frames (floor 1) imports fix (floor 5)",
    ),
    ("layers", {"starpos.frames.new": "import starpos"}, "opens every floor"),
    ("layers", {"starpos.frames.new": "import starpos.fix.fix"}, "opens every floor"),
    ("layers", {"starpos.frames.new": "from ..fix.solver import Solver"}, "write the full name"),
    ("layers", {"starpos_solver.new": "from . import node"}, "write the full name"),
    ("layers", {"starpos.earth.new": "from starpos.instrument.camera import Camera"}, "floor 2"),
    ("layers", {"starpos.units": "from starpos.frames.frame import Frame"}, "floor 0"),
    ("layers", {"starpos.cellar.new": ""}, "no floor"),
    ("layers", {"starpos.fix.new": "def f():\n    from rclpy.node import Node"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "from sensor_msgs.msg import Image"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "from starpos_interfaces.msg import Tilt"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "import tf2_ros"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "from rosbag2_py import SequentialReader"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "from starpos_common import exits"}, "does not allow"),
    ("layers", {"starpos_solver.new": "import starpos_camera.camera"}, "does not allow"),
    ("layers", {"starpos_common.new": "import starpos_testing.nodes"}, "does not allow"),
    (
        "circles",
        {
            "starpos.fix.a": "from starpos.fix.b import x",
            "starpos.fix.b": "def f():\n    from starpos.fix import a",
        },
        "in a circle",
    ),
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
    ("words", {"starpos.fix.new": "x = 1\n" * 500}, "500 lines"),
    ("words", {"starpos.fix.new": 'def f():\n    """By how much."""'}, "a verb or a noun"),
    ("words", {"starpos.fix._new": 'cdef f():\n    """And more.\n    """'}, "new.py:2"),
    ("words", {"starpos.fix._new": "x = 1\n" * 500}, "500 lines"),
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
    (
        "circles",
        {"starpos.fix.solver": "from starpos.fix import a", "starpos.fix.a": "from starpos import Solver"},
        "in a circle",
    ),
]


def house_of(walls, sources):
    return [
        (walls.Compiled if "._" in name else walls.Module)(name, ROOT / "new.py", text)
        for name, text in sources.items()
    ]


@pytest.mark.parametrize(("rule", "sources", "sentence"), BREACHES)
def test_a_breach_is_seen(walls, rule, sources, sentence):
    found = list(getattr(walls, rule)(house_of(walls, sources)))
    assert len(found) == 1 and sentence in found[0]


def test_what_is_allowed_is_no_breach(walls):
    sources = {
        "starpos.fix.new": "import numpy as np\nfrom starpos.identification import Sky\nimport yaml\nimport json",
        "starpos_solver.new": "from starpos.fix.solver import Solver\nfrom starpos_interfaces.msg import Tilt",
        "starpos.rotation": "from starpos.units import ARCSEC",
        "starpos.parallel.same": "import starpos",
        "starpos.cli.new": "from starpos import Solver, __version__",
        "starpos_bringup.new": "import starpos\nimport tf2_ros",
    }
    house = house_of(walls, sources)
    assert [*walls.layers(house), *walls.aliases(house)] == []


def test_what_a_compiled_module_may_is_no_breach(walls):
    text = (
        '# Above, "as it stands.\n"""Text: from rclpy import Node."""\n'
        "from libc.math cimport sqrt\nfrom starpos._numeric.algebra cimport Point\ncimport starpos._numeric.wide\n"
        "from starpos.earth._air cimport Air\n"
        'cdef extern from *:\n    """\n    By C.\n    """\n    void f()\n'
        'def f():\n    """As many as `many`."""\n    return "# no comment"\n'
    )
    house = house_of(walls, {"starpos.fix._new": text, "starpos.fix.a": "from starpos.fix._new import f"})
    compiled = house[:1]
    assert [
        *walls.cimports(compiled),
        *walls.uncalled(house),
        *walls.words(house),
        *walls.comments(house),
    ] == []
