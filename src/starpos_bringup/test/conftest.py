# SPDX-License-Identifier: Apache-2.0
"""Names of launch and launch_ros for tests that read launch files."""

import sys

import pytest

from starpos_testing.launch_stand_in import modules


@pytest.fixture
def launch(monkeypatch):
    """This process can read launch files: by launch itself where that is installed, else by what stands in for it."""
    for name, module in modules().items():
        monkeypatch.setitem(sys.modules, name, module)
