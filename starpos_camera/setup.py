# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package = "starpos_camera"

setup(
    name=package,
    version="0.4.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "README.md"]),
    ],
    install_requires=["setuptools", "numpy", "pyyaml"],
    zip_safe=True,
    maintainer="starpos maintainers",
    description="The starpos camera: frames from cameras, files or a simulated sky, and the stars in them.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "camera = starpos_camera.main:camera",
            "camera_detector = starpos_camera.main:camera_detector",
            "detector = starpos_camera.main:detector",
        ]
    },
)
