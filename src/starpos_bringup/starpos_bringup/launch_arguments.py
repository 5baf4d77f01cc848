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


def names(told: Mapping[str, str], name: str) -> list[str]:
    """Read an argument of names of namespaces, separated by commas; LaunchError if one is invalid, or comes twice."""
    found = [word.strip().strip("/") for word in told[name].split(",")]
    sound = all(re.fullmatch(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", word, re.ASCII) for word in found)
    if not sound or len(set(found)) < len(found):
        raise LaunchError(
            f"{name}:={told[name]}: give different names separated by commas, such as left,right"
        )
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
