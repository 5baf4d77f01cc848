# SPDX-License-Identifier: Apache-2.0
"""Sentences about fixes with a partly or wholly unknown A3."""

from collections.abc import Iterable

import numpy as np

from starpos.fix.budget import CALIBRATION, ErrorTerm
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import UNNAMED

# what to do, in the options of `starpos solve` and in the parameters of the node
BY_OPTIONS = (
    "turn the instrument on the spot and give --self-calibrate, find it at a known place with starpos calibrate "
    "--site, or state it with --misalignment and --misalignment-stddev"
)
BY_PARAMETERS = (
    "turn the instrument on the spot and set self_calibration:=true, find it at a known place with solver/calibrate or "
    "starpos calibrate --site and set calibration_url, or set misalignment and misalignment_stddev"
)
# the same for the errors of the inclinometer
MODEL_BY_OPTIONS = (
    "name it with --inclinometer MODEL, or its model or errors (tilt_...) in an instrument file"
)
MODEL_BY_PARAMETERS = "set inclinometer.model, or name it or its errors in the file of calibration_url"
# of one lean nothing is known of the turn about the plumb line: then an angle has a sigma of some 100 deg
UNKNOWN_DEG = 60.0
# a turn that is known better than so is said to be known; a place that is wider is worth a word
KNOWN_DEG, WIDE_M = 5.0, 10_000.0
FIND_TURN = (
    "calibrate with leans of some degrees between the frames, or state it with --misalignment and "
    "--turn-stddev"
)


def unknown_a3(
    calibration: Calibration, covariance: np.ndarray, terms: Iterable[ErrorTerm], ways: str = BY_OPTIONS
) -> str:
    """Say in a sentence that A3, or its turn about the plumb line, makes a place wide, and what to do; '' if not.

    covariance: of the place, (2, 2) or larger, of east m and north m first.  terms: the budget of it, or of a fix there.
    ways: what to do where nothing is known of A3.
    """
    metres = float(np.sqrt(np.diag(covariance)[:2].max()))
    if calibration.unknown:
        return (
            f"the misalignment of camera and inclinometer is not known, so the position error is "
            f"{metres / 1000:.0f} km (1 sigma): {ways}"
        )
    own = sum(np.trace(t.covariance[:2, :2]) for t in terms if t.name == CALIBRATION)
    if metres < WIDE_M or own < 0.5 * np.trace(covariance[:2, :2]) or not may_turn(calibration):
        return ""
    return (
        "the instrument leans otherwise than when A3 was found, and A3's turn about the plumb line, "
        f"{_known(calibration)}, makes the position error {metres / 1000:.0f} km (1 sigma): lean it as then, "
        f"or {FIND_TURN}"
    )


def unnamed_inclinometer(instrument: Instrument, ways: str = MODEL_BY_OPTIONS) -> str:
    """Say that no inclinometer is stated, and which one is assumed; '' if one is stated."""
    if instrument.vertical is not None or instrument.inclinometer_model or instrument.inclinometer != UNNAMED:
        return ""
    return (
        "the inclinometer's model is not stated: the errors of an SCA100T as sold are assumed, "
        f"{np.degrees(UNNAMED.pose_rad):.2f} deg, 7 km or more (1 sigma): {ways}"
    )


def may_turn(calibration: Calibration) -> bool:
    """Whether A3's turn about the plumb line is hardly known."""
    return calibration.turn_stddev_deg > KNOWN_DEG


def at_another_lean(calibration: Calibration) -> str:
    """Say how well A3's turn about the plumb line is known, which counts at another lean."""
    return f"at another lean A3's turn about the plumb line matters, {_known(calibration)}"


def _known(calibration: Calibration) -> str:
    turn_deg = calibration.turn_stddev_deg
    return "which is not known" if turn_deg > UNKNOWN_DEG else f"known to {turn_deg:.2g} deg"
