# SPDX-License-Identifier: Apache-2.0
import os
import sys
from glob import glob
from importlib.metadata import version
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

package = "starpos"
WINDOWS = sys.platform == "win32"
# the code of views of arrays, which Cython from 3.1 on need not put into each module: that halves the time of a build
VIEWS = f"{package}._numeric._views" if tuple(map(int, version("cython").split(".")[:2])) >= (3, 1) else None
# a compiled module is a .pyx next to the Python that calls it; what several of them share is in .pxd
SHARED = sorted(glob("starpos/*/*.pxd"))
COMPILED = [
    Extension(
        ".".join(Path(source).with_suffix("").parts),
        [source],
        depends=[*SHARED, "setup.py"],
        # else the loader takes the oldest exp, which is slow
        libraries=[] if WINDOWS else ["m"],
        extra_compile_args=["/O2", "/clang:-fno-math-errno"]
        if WINDOWS
        else ["-O3", "-g0", "-fno-math-errno"],
    )
    for source in [*sorted(glob("starpos/*/*.pyx")), *(["starpos/_numeric/_views.c"] if VIEWS else [])]
]


class BuildCompiled(build_ext):
    """Compiles several modules at once."""

    def build_extensions(self):
        from Cython.Build import cythonize

        at_once = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        sharing = {"shared_utility_qualified_name": VIEWS} if VIEWS else {}
        made = cythonize(self.extensions, nthreads=at_once, force=self.force, **sharing)
        sources = {module.name: module.sources for module in made}
        for extension in self.extensions:
            extension.sources = sources[extension.name]
        self.parallel = at_once
        if self.compiler.compiler_type == "msvc":
            # Microsoft's own compiler has no vectors of C; LLVM's takes its options (the runners of GitHub have it)
            self.compiler.initialize()
            self.compiler.cc = "clang-cl.exe"
        super().build_extensions()


# What colcon needs stands here, because it builds with links to this file alone. All else that is said of the package
# is in pyproject.toml.
setup(
    name=package,
    version="0.4.0",
    license="Apache-2.0 AND BSD-2-Clause AND ISC AND LicenseRef-Natural-Earth",
    license_files=["LICENSES/*"],
    python_requires=">=3.10",
    packages=find_packages(include=["starpos", "starpos.*"]),
    package_data={package: ["*/data/*", "*.pyi", "py.typed"]},
    ext_modules=COMPILED,
    cmdclass={"build_ext": BuildCompiled},
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
        "sgp4>=2.15",
        "exifread>=3",
    ],
    extras_require={
        "picture": ["matplotlib"],
        "raw": ["rawpy"],
        "heif": ["pillow-heif"],
        "report": ["matplotlib", "rosbags>=0.11"],
        "ephemeris": ["jplephem>=2.19"],
        "completion": ["argcomplete"],
        "test": ["pytest"],
    },
    entry_points={"console_scripts": ["starpos = starpos.cli:main"]},
)
