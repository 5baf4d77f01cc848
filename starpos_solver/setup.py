# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package = "starpos_solver"

setup(
    name=package,
    version="0.4.0",
    description="Stars and tilt in, position and heading out",
    maintainer="starpos maintainers",
    license="Apache-2.0",
    packages=find_packages(include=[package, f"{package}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "navigator = starpos_solver.main:navigator",
            "solver = starpos_solver.main:solver",
        ]
    },
)
