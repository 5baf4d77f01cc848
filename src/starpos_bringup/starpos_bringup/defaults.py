# SPDX-License-Identifier: Apache-2.0
"""Parameter file of all nodes, written from their tables.

python -m starpos_bringup.defaults > config/starpos.yaml
"""

import starpos_camera.parameters
import starpos_dashboard.parameters
import starpos_inclinometer.parameters
import starpos_solver.driver
from starpos.session import detector_parameters, navigator_parameters
from starpos_common.parameters import to_yaml

NODES = {
    "camera": starpos_camera.parameters.PARAMETERS,
    "detector": detector_parameters.PARAMETERS,
    "inclinometer": starpos_inclinometer.parameters.PARAMETERS,
    "solver": starpos_solver.driver.PARAMETERS,
    "navigator": navigator_parameters.PARAMETERS,
    "dashboard": starpos_dashboard.parameters.PARAMETERS,
}


def parameter_file() -> str:
    """Write every parameter of every node with its default, each below its meaning, unit and range."""
    parts = [to_yaml(node, table).split("\n", 1) for node, table in NODES.items()]
    licence = parts[0][0]
    about = (
        "# All parameters at their defaults; keep what you change. Written by starpos_bringup/defaults.py."
    )
    return "\n".join([licence, about, *(body for _, body in parts)])


if __name__ == "__main__":
    print(parameter_file(), end="")
