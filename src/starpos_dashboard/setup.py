# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

package = "starpos_dashboard"

setup(
    name=package,
    version="0.4.0",
    description="One page in a browser that shows what the instrument says",
    maintainer="starpos maintainers",
    license="Apache-2.0 AND ISC AND MIT",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["assets/*", "assets/vendor/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["dashboard = starpos_dashboard.main:dashboard"]},
)
