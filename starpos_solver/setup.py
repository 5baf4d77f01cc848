# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package = "starpos_solver"

setup(
    name=package,
    version="0.1.0",
    description="Stars and tilt in, position and heading out",
    maintainer="starpos maintainers",
    maintainer_email="maintainers@starpos.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    package_data={f"{package}.dashboard": ["assets/*", "assets/vendor/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*.yaml") + glob("config/*.xml"))),
        (f"share/{package}/sros2", sorted(glob("sros2/*.xml"))),
        (f"share/{package}/layouts", sorted(glob("layouts/*"))),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "dashboard = starpos_solver.dashboard.main:dashboard",
            "record = starpos_solver.record:record",
            "replay = starpos_solver.replay:replay",
            "solver = starpos_solver.main:solver",
        ]
    },
)
