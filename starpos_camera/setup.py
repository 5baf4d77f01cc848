# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package = "starpos_camera"

setup(
    name=package,
    version="0.1.0",
    description="Frames of the sky from a camera, files or a simulation, and the stars in them",
    maintainer="starpos maintainers",
    maintainer_email="maintainers@starpos.invalid",
    license="Apache-2.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "camera = starpos_camera.camera_node:main",
            "detector = starpos_camera.detector_node:main",
        ],
    },
)
