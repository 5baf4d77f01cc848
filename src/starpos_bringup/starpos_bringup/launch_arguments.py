# SPDX-License-Identifier: Apache-2.0
"""Values of launch arguments, read from their texts; needs no ROS."""

import math
import re
from collections.abc import Collection, Mapping


class LaunchError(Exception):
    """An argument is wrong; the text is one sentence."""


def is_true(told: Mapping[str, str], name: str) -> bool:
    """Read an argument; LaunchError if it is neither true nor false."""
    words = {"true": True, "1": True, "false": False, "0": False}
    try:
        return words[told[name].lower()]
    except KeyError:
        raise LaunchError(f"{name}:={told[name]}: give true or false") from None


def name_of(told: Mapping[str, str], name: str) -> str:
    """Read an argument that names a namespace; LaunchError if it is no valid one."""
    found = told[name].strip().strip("/")
    if not re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", found, re.ASCII):
        raise LaunchError(f"{name}:={told[name]}: give a name such as stars")
    return found


def one_of(told: Mapping[str, str], name: str, words: Collection[str]) -> str:
    """Read an argument; LaunchError if it is not one of the words."""
    if told[name].lower() not in words:
        raise LaunchError(f"{name}:={told[name]}: give {', '.join(words)}")
    return told[name].lower()


def number(told: Mapping[str, str], name: str, low: float, high: float) -> float:
    """Read an argument; LaunchError if it is not a number from `low` to `high`."""
    try:
        value = float(told[name])
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise LaunchError(f"{name}:={told[name]}: give a number from {low:g} to {high:g}")
    return value
