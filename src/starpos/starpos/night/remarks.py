# SPDX-License-Identifier: Apache-2.0
"""Remarks on a night: each is a kind and a sentence, shown with the night."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from starpos.averaging.average import Average
from starpos.calibration.misalignment import Calibrated
from starpos.calibration.unknown import (
    BY_OPTIONS,
    FIND_TURN,
    MODEL_BY_OPTIONS,
    at_another_lean,
    may_turn,
    unknown_a3,
    unnamed_inclinometer,
)
from starpos.fix.fix import Fix
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_doubt import like_radians
from starpos.instrument.tilt_log import TiltLog
from starpos.utc import utc_text

# with a larger error of A3 (arcsec) the headings hardly determine it
WORTH_SAVING_ARCSEC = 600.0


class Kind(str, Enum):
    """What a remark is about."""

    TILTS = "tilts"
    INCLINOMETER = "inclinometer"
    FOCAL_LENGTH = "focal length"
    AXIS = "optical axis"
    EARTH_ROTATION = "earth rotation"
    LEFT_OUT = "left out"
    MOVED = "moved"
    CALIBRATED = "calibrated"
    NOT_CALIBRATED = "not calibrated"
    UNKNOWN_A3 = "unknown A3"
    MISTAKEN = "mistaken"
    FAR = "far"
    RECORDED = "recorded"
    GNSS = "gnss"


@dataclass(frozen=True)
class Remark:
    """A sentence about a night, which begins with a small letter and ends without a full stop."""

    kind: Kind
    text: str

    def __str__(self) -> str:
        return self.text


def of_tilts(log: TiltLog, path: str) -> tuple[Remark, ...]:
    """Say that a table of tilts looks like radians."""
    doubt = like_radians(log)
    return (Remark(Kind.TILTS, f"{path}: {doubt}"),) if doubt else ()


def of_inclinometer(instrument: Instrument, ways: str = MODEL_BY_OPTIONS) -> tuple[Remark, ...]:
    """Say that the inclinometer's model is not stated; ways: what to do then."""
    sentence = unnamed_inclinometer(instrument, ways)
    return (Remark(Kind.INCLINOMETER, sentence),) if sentence else ()


def of_axis(doubt: str) -> tuple[Remark, ...]:
    """Say that the optical axis of a night's frames is not known; doubt: the sentence, '' if it is known."""
    return (Remark(Kind.AXIS, doubt),) if doubt else ()


def of_focal_length(place: str, focal_px: float) -> Remark:
    """Say which focal length fits a frame that was not identified with the given one."""
    return Remark(Kind.FOCAL_LENGTH, f"{place}: a focal length of {focal_px:.0f} px fits: give that one")


def of_extrapolation(fix: Fix, days: float) -> tuple[Remark, ...]:
    """Say by how many days a fix lies beyond the IERS table, and how far it may be off for that."""
    if days <= 0:
        return ()
    (ut1,) = (t for t in fix.terms if t.name == "ut1")
    sentence = (
        f"the Earth's rotation is extrapolated {days:.0f} days beyond the IERS table, "
        f"{np.sqrt(ut1.covariance[0, 0]):.0f} m east (1 sigma, in the budget): upgrade astropy-iers-data"
    )
    return (Remark(Kind.EARTH_ROTATION, sentence),)


def of_average(whole: Average) -> Iterator[Remark]:
    """Say what an average leaves out."""
    if whole.moved:
        begin = utc_text(whole.began_unix_s)
        yield Remark(
            Kind.MOVED,
            f"the instrument was moved: the average is of its last place, {whole.frames} frames since {begin}",
        )
    if whole.left_out:
        yield Remark(
            Kind.LEFT_OUT,
            f"{whole.left_out} fixes lie further from the others than their errors allow: they are not in the average",
        )


def of_a3(calibration: Calibration, place: Fix | Average, ways: str = BY_OPTIONS) -> tuple[Remark, ...]:
    """Say that A3's error makes the position error large; ways: what to do then."""
    sentence = unknown_a3(calibration, place.covariance, place.terms, ways)
    return (Remark(Kind.UNKNOWN_A3, sentence),) if sentence else ()


def of_turn(turned: Calibrated) -> Iterator[Remark]:
    """Say how well A3 was found by turning."""
    error = f"the plumb line in the camera is known to {turned.plumb_stddev_arcsec:.2f} arcsec"
    if turned.plumb_stddev_arcsec > WORTH_SAVING_ARCSEC:
        yield Remark(
            Kind.NOT_CALIBRATED, f"not calibrated: the headings hardly determine A3, {error}: turn it further"
        )
        return
    found = turned.instrument.calibration
    yield Remark(Kind.CALIBRATED, f"calibrated: {error}; {at_another_lean(found)}")
    if may_turn(found):
        yield Remark(Kind.CALIBRATED, f"to use A3 at another lean, {FIND_TURN}")
    if turned.beyond:
        yield Remark(Kind.INCLINOMETER, turned.beyond)
