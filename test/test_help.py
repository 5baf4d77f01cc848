# SPDX-License-Identifier: Apache-2.0
"""Every executable says with --help what it is and which parameters it has, and starts nothing."""

import subprocess
from importlib.metadata import entry_points

import pytest

from starpos.parameters.table import NODES, parameters_of
from starpos_testing.graph.graph import executable
from starpos_testing.patience import WAIT_S

EXECUTABLES = sorted(
    (entry.module.split(".")[0], entry.name)
    for entry in entry_points(group="console_scripts")
    if entry.module.startswith("starpos_")
)
# by executable; the others have arguments instead of parameters
NODES_OF = {name: (name,) for name in NODES} | {"camera_detector": ("camera", "detector")}


def test_all_are_asked():
    assert {name for _, name in EXECUTABLES} == {*NODES_OF, "emulator", "folder", "record", "replay"}


@pytest.mark.parametrize(("package", "name"), EXECUTABLES, ids=[name for _, name in EXECUTABLES])
def test_help_says_what_it_is_and_its_parameters(package, name):
    command = [executable(package, name), "--help"]
    if name in NODES_OF:
        # a node that started would refuse this
        command += ["--ros-args", "-p", "nonsense"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: ") and name in done.stdout.splitlines()[0]
    for node in NODES_OF.get(name, ()):
        assert f"ros2 run {package} {name}" in done.stdout and "--params-file" in done.stdout
        for parameter in parameters_of(node):
            assert f"\n  {parameter.name}: " in done.stdout
            assert parameter.constraint.split()[0] in done.stdout
