# SPDX-License-Identifier: Apache-2.0
"""A launch argument that is wrong is named."""

import pytest

from starpos_bringup.launch_arguments import LaunchError, is_true, names, number, one_of


@pytest.mark.parametrize("text", ["abc", "", "nan", "90.5", "inf"])
def test_what_is_no_number_in_its_range_is_named_with_its_argument(text):
    with pytest.raises(LaunchError, match=f"latitude:={text}: give a number from -90 to 90"):
        number({"latitude": text}, "latitude", -90, 90)


def test_names_of_instruments_are_read_and_none_comes_twice():
    assert names({"instruments": "left, right/upper"}, "instruments") == ["left", "right/upper"]
    for text in ("", "left,", "left,left", "1st", "le ft", "left//right"):
        with pytest.raises(LaunchError, match=f"instruments:={text}: give different names"):
            names({"instruments": text}, "instruments")


def test_a_word_is_one_of_those_that_there_are():
    assert one_of({"log_level": "WARN"}, "log_level", ("info", "warn")) == "warn"
    with pytest.raises(LaunchError, match="log_level:=loud: give info, warn"):
        one_of({"log_level": "loud"}, "log_level", ("info", "warn"))


def test_numbers_and_truths_are_read_as_people_write_them():
    assert number({"latitude": "-3e1"}, "latitude", -90, 90) == -30
    assert is_true({"dashboard": "True"}, "dashboard") and not is_true({"dashboard": "0"}, "dashboard")
    with pytest.raises(LaunchError, match="dashboard:=yes: give true or false"):
        is_true({"dashboard": "yes"}, "dashboard")
