# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = "starpos_common"

setup(
    name=package,
    version="0.4.0",
    packages=[package],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="starpos maintainers",
    description="What every starpos node shares.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
)
