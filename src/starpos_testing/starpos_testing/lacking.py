# SPDX-License-Identifier: Apache-2.0
"""What a test does without the program or the package that it runs against."""

import os

import pytest


def lacks(package: str, install: str = "sudo apt-get install") -> None:
    """Skip the test: this machine lacks what the package has. Where STARPOS_COMPLETE is set, as in CI, it fails."""
    refuse = pytest.fail if os.environ.get("STARPOS_COMPLETE") else pytest.skip
    refuse(f"not on this machine: {install} {package}")
