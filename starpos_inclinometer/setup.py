# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = "starpos_inclinometer"

setup(
    name=package,
    version="0.4.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "README.md", "PROTOCOL.md"]),
    ],
    install_requires=["setuptools", "numpy", "pyserial"],
    zip_safe=True,
    maintainer="starpos maintainers",
    description="The starpos inclinometer: serial protocol, driver and node.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["inclinometer = starpos_inclinometer.main:inclinometer"]},
)
