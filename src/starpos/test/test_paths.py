# SPDX-License-Identifier: Apache-2.0
"""Which file a calibration_url names."""

from pathlib import Path

import pytest

from starpos.errors import InstrumentError
from starpos.files import path_of


def test_a_file_url_and_a_path_name_a_file():
    assert str(path_of("file:///a/b%20c.yaml")) == "/a/b c.yaml"
    assert str(path_of("/a/b%20c.yaml")) == "/a/b%20c.yaml"
    assert path_of("~/b.yaml") == Path.home() / "b.yaml"


@pytest.mark.parametrize(
    "url",
    [
        "http://a/b.yaml",
        "file://host/b.yaml",
        "file:",
        "//[",
        "/" + "x" * 10_000_000,
        "~nobody-of-that-name/b.yaml",
    ],
)
def test_what_names_none_is_refused_with_what_does(url):
    with pytest.raises(InstrumentError, match="give file:///path") as raised:
        path_of(url)
    assert len(str(raised.value)) < 200


def test_a_package_of_ros_has_its_files_where_ament_finds_them(tmp_path, monkeypatch):
    index = tmp_path / "share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "robot").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    assert path_of("package://robot/config/a%20b.yaml") == tmp_path / "share/robot/config/a b.yaml"
    with pytest.raises(InstrumentError, match="no such package is installed"):
        path_of("package://rob/config/a.yaml")
