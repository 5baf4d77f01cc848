# SPDX-License-Identifier: Apache-2.0
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup

package = "starpos"
# the compiled core: a module is a .pyx; what several of them share is in .pxd
SHARED = sorted(glob("starpos/core/*.pxd"))
CORE = [
    Extension(
        f"starpos.core.{Path(source).stem}",
        [source],
        depends=[*SHARED, "setup.py"],
        # else the loader takes the oldest exp, which is slow
        libraries=["m"],
        extra_compile_args=["-O3", "-g0", "-fno-math-errno"],
    )
    for source in sorted(glob("starpos/core/*.pyx"))
]

# What colcon needs stands here, because it builds with links beside this file alone. All else that is said of the package
# is in pyproject.toml.
setup(
    name=package,
    version="0.1.0",
    license="Apache-2.0 AND BSD-2-Clause AND ISC AND LicenseRef-Natural-Earth",
    license_files=["LICENSES/*"],
    python_requires=">=3.10",
    packages=find_packages(include=["starpos", "starpos.*"]),
    package_data={package: ["*/data/*", "*.pyi", "py.typed"]},
    ext_modules=CORE,
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        (f"share/{package}/LICENSES", sorted(glob("LICENSES/*"))),
    ],
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "astropy>=6.0",
        "pyerfa>=2.0.1",
        "opencv-python-headless>=4.6",
        "PyYAML",
    ],
    extras_require={
        "picture": ["matplotlib"],
        "raw": ["rawpy", "exifread>=3"],
        "heif": ["pillow-heif", "exifread>=3"],
        "report": ["matplotlib", "rosbags>=0.11"],
        "cluster": ["distributed"],
        "completion": ["argcomplete"],
        "test": ["pytest"],
    },
    entry_points={"console_scripts": ["starpos = starpos.cli:main"]},
)
