# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

package = "starpos_bringup"

setup(
    name=package,
    version="0.4.0",
    description="Launch files, default parameters, recording and playing of the whole instrument",
    maintainer="starpos maintainers",
    license="Apache-2.0",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["data/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{package}/config", sorted(glob("config/*.yaml") + glob("config/*.xml"))),
        (f"share/{package}/sros2", sorted(glob("sros2/*.xml"))),
        (f"share/{package}/layouts", sorted(glob("layouts/*"))),
        (f"share/{package}/urdf", sorted(glob("urdf/*"))),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "record = starpos_bringup.record:record",
            "replay = starpos_bringup.replay:replay",
            "folder = starpos_bringup.record:folder",
        ]
    },
)
