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
        "package://a/b.yaml",
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
