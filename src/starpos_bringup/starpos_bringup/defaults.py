# SPDX-License-Identifier: Apache-2.0
"""The parameter file of all nodes, from their own tables.

python -m starpos_bringup.defaults > config/starpos.yaml
"""

from starpos_camera.camera_parameters import PARAMETERS as CAMERA
from starpos_camera.detector_parameters import PARAMETERS as DETECTOR
from starpos_common.parameters import to_yaml
from starpos_dashboard.parameters import PARAMETERS as DASHBOARD
from starpos_inclinometer.node import PARAMETERS as INCLINOMETER
from starpos_solver.parameters import PARAMETERS as SOLVER

NODES = {
    "camera": CAMERA,
    "detector": DETECTOR,
    "inclinometer": INCLINOMETER,
    "solver": SOLVER,
    "dashboard": DASHBOARD,
}


def parameter_file() -> str:
    """Every parameter of every node at its default, each under its meaning, unit and range."""
    parts = [to_yaml(node, table).split("\n", 1) for node, table in NODES.items()]
    licence = parts[0][0]
    about = (
        "# All parameters at their defaults; keep what you change. Written by starpos_bringup/defaults.py."
    )
    return "\n".join([licence, about, *(body for _, body in parts)])


if __name__ == "__main__":
    print(parameter_file(), end="")
