# SPDX-License-Identifier: Apache-2.0
"""The middle of an exposure from what a camera tells of it."""

from collections.abc import Mapping


def middle_of_commanded(commanded_s: float, exposure_s: float, values: Mapping) -> tuple[float, float]:
    """Unix time of the middle and its standard deviation (s), of an exposure known only by when it was asked for."""
    return commanded_s + values["command_lag"] + exposure_s / 2, values["command_lag_stddev"]
