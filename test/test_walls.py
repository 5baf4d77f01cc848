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
    ("layers", {"starpos.frames.new": "import starpos.fix.fix"}, "floor 1"),
    ("layers", {"starpos.earth.new": "from starpos.instrument.camera import Camera"}, "floor 2"),
    ("layers", {"starpos.units": "from starpos.frames.frame import Frame"}, "floor 0"),
    ("layers", {"starpos.cellar.new": ""}, "no floor"),
    ("layers", {"starpos.fix.new": "def f():\n    from rclpy.node import Node"}, "which is ROS"),
    ("layers", {"starpos.fix.new": "from sensor_msgs.msg import Image"}, "which is ROS"),
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
    ("keywords", {"starpos.fix.new": f"@dataclass(frozen=True)\nclass Six:\n{FIELDS}"}, "6 fields"),
    ("words", {"starpos.fix.new": '"""Of nothing."""'}, "a verb or a noun"),
    ("words", {"starpos.fix.new": "x = 1\n" * 500}, "500 lines"),
    ("comments", {"starpos.fix.new": "# Above.\nx = 1  # noqa: E741\ny = 2  # in m\n"}, "new.py:3"),
]


@pytest.mark.parametrize(("rule", "sources", "sentence"), BREACHES)
def test_a_breach_is_seen(walls, rule, sources, sentence):
    house = [walls.Module(name, ROOT / "new.py", text) for name, text in sources.items()]
    found = list(getattr(walls, rule)(house))
    assert len(found) == 1 and sentence in found[0]


def test_what_is_allowed_is_no_breach(walls):
    sources = {
        "starpos.fix.new": "import numpy as np\nfrom starpos.identification import Sky\nimport starpos.rotation",
        "starpos_solver.new": "from starpos.fix.solver import Solver\nfrom starpos_interfaces.msg import Tilt",
        "starpos.rotation": "from starpos.units import ARCSEC",
    }
    house = [walls.Module(name, ROOT / "new.py", text) for name, text in sources.items()]
    assert [*walls.layers(house), *walls.aliases(house)] == []
