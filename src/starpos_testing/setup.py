# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package = "starpos_testing"

setup(
    name=package,
    version="0.4.0",
    description="Helpers of the tests",
    maintainer="starpos maintainers",
    license="Apache-2.0",
    packages=find_packages(include=[package, f"{package}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["emulator = starpos_testing.emulator:main"]},
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
)
