# SPDX-License-Identifier: Apache-2.0
"""What a test does without the program or the package that it runs against."""

import os
from importlib.util import find_spec

import pytest

PYPI = {"alpaca": "alpyca", "alpaca_simulators": "alpaca-simulators"}  # packages not named as their modules


def lacks(package: str, install: str = "sudo apt-get install") -> None:
    """Skip the test: this machine lacks what the package has. Where STARPOS_COMPLETE is set, as in CI, it fails."""
    refuse = pytest.fail if os.environ.get("STARPOS_COMPLETE") else pytest.skip
    refuse(f"not on this machine: {install} {package}")


def require(*modules: str) -> None:
    """Skip the test, as `lacks` does, where one of the modules cannot be imported."""
    for module in modules:
        if not find_spec(module):
            lacks(PYPI.get(module, module), "pip install")


def needs(module: str) -> pytest.MarkDecorator:
    """A mark of tests that skip without a module; where STARPOS_COMPLETE is set they run, and fail."""
    absent = not find_spec(module) and not os.environ.get("STARPOS_COMPLETE")
    return pytest.mark.skipif(absent, reason=f"not on this machine: pip install {PYPI.get(module, module)}")
