# SPDX-License-Identifier: Apache-2.0
"""Skips tests whose program or package is not on this machine."""

import os
from importlib.util import find_spec

import pytest

# packages not named as their modules
PYPI = {"alpaca": "alpyca", "alpaca_simulators": "alpaca-simulators", "pillow_heif": "pillow-heif"}


def lacks(package: str, install: str = "sudo apt-get install") -> None:
    """Skip the test, because this machine lacks a package; with STARPOS_COMPLETE set, as in CI, the test fails."""
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
