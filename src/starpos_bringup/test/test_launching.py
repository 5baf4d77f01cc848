# SPDX-License-Identifier: Apache-2.0
"""What the launch files have in common."""

import importlib
import os
from pathlib import Path

import pytest

TOLD = {"log_level": "info", "enclaves": "/starpos", "outputs": ""}


@pytest.fixture
def launching(launch):
    """The module, which imports launch."""
    return importlib.import_module("starpos_bringup.launching")


@pytest.fixture
def environment(launching, tmp_path, monkeypatch):
    """Variables of a process besides the environment's, given variables of the user's."""
    parameters = tmp_path / "mine.yaml"
    parameters.write_text("")
    told = TOLD | {"params_file": str(parameters)}
    for name in launching.PROFILES:
        monkeypatch.delenv(name, raising=False)

    def environment(**of_user):
        from launch import LaunchContext

        for name, value in of_user.items():
            monkeypatch.setenv(name, value)
        context, process = LaunchContext(), launching.process("starpos_solver", "solver", told)
        return dict(
            ("".join(part.perform(context) for part in text) for text in pair)
            for pair in process.additional_env or ()
        )

    return environment


def test_nodes_find_each_other_at_once_and_the_rest_of_the_robot_is_as_it_was(environment, launching):
    profiles = environment()
    assert set(profiles) == set(launching.PROFILES)
    assert all(Path(path).name == "quick_start.xml" and Path(path).is_file() for path in profiles.values())
    assert not set(launching.PROFILES) & set(os.environ)


@pytest.mark.parametrize("name", ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"])
def test_profiles_of_the_users_stay(environment, name):
    assert environment(**{name: "/home/robot/lossy_link.xml"}) == {}


def test_outputs_are_put_under_a_name_of_their_own(launching):
    words = launching.ros_arguments("solver", TOLD | {"outputs": "stars"})
    assert [w for w in words if ":=" in w] == [
        "fix:=stars/fix",
        "fix_averaged:=stars/fix_averaged",
        "heading/imu:=stars/heading/imu",
    ]
    assert "-r" not in launching.ros_arguments("solver", TOLD)
