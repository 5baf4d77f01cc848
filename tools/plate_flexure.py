# SPDX-License-Identifier: Apache-2.0
"""Estimate how much the mounting plate bends between camera and level when the instrument leans by one degree more.

The plate counts as a cantilever from the mount's screw to the camera's. At its end the whole weight of camera and lens
pulls, at the height of their centre of mass. The end turns by P L^2 / 2EI under the force P, by M L / EI under the moment
M (Young, Budynas and Sadegh, Roark's Formulas for Stress and Strain, 8th ed., table 8.1, cases 1a and 3a). A lean by
one degree changes a component of the weight by at most sin(1 deg) of it. The camera stiffens the plate, so this is an
upper bound of the plate's share. It does not contain joints, the lens and the sensor's own board.
"""

import argparse
import math
import re
from pathlib import Path

PLATE = Path(__file__).resolve().parents[1] / "starpos_inclinometer" / "hardware" / "plate.scad"
GRAVITY = 9.81
ARCSEC = math.radians(1 / 3600)
# Young's modulus (Pa).
MATERIALS = {"aluminium": 69e9, "steel": 200e9, "printed PLA": 3e9}


def sizes_mm() -> dict[str, float]:
    """Read the sizes in plate.scad, such as {"thickness_mm": 15.0}."""
    return {
        name: float(value)
        for name, value in re.findall(
            r"^(\w+_mm) = ([\d.]+);", PLATE.read_text(encoding="utf-8"), re.MULTILINE
        )
    }


def arcsec_per_deg(modulus: float, mass_kg: float, height_m: float) -> float:
    """Turn of the camera's screw against the mount's (arcsec) for each degree of lean.

    modulus: Young's, Pa; mass_kg and height_m: of camera and lens, and of their centre of mass above the plate.
    """
    size = {name: value / 1000 for name, value in sizes_mm().items()}
    span = abs(size["mount_x_mm"] - size["camera_x_mm"])
    hole = size["camera_hole_mm"]
    stiffness = modulus * (size["width_mm"] - hole) * size["thickness_mm"] ** 3 / 12
    force = mass_kg * GRAVITY * math.sin(math.radians(1))
    return (force * span**2 / 2 + force * height_m * span) / stiffness / ARCSEC


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Print the plate's flexure in arcsec for each degree of lean."
    )
    parser.add_argument("--mass-kg", type=float, default=2.5, help="camera and lens")
    parser.add_argument(
        "--height-mm", type=float, default=60.0, help="of their centre of mass above the plate"
    )
    given = parser.parse_args()
    for name, modulus in MATERIALS.items():
        print(
            f"{name}: {arcsec_per_deg(modulus, given.mass_kg, given.height_mm / 1000):.2f} arcsec per degree"
        )


if __name__ == "__main__":
    main()
