# SPDX-License-Identifier: Apache-2.0
"""The instrument as a tree of frames: base link, camera, inclinometer, as far as the solver knows how they are turned."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos import rotation
from starpos.instrument.instrument import Instrument
from starpos.session.parameter import FRAME_NAME


@dataclass
class FrameNames:
    """The names that messages give the frames of camera and inclinometer; '' of one that has none yet."""

    camera: str = ""
    inclinometer: str = ""


def name_in(message: Any) -> str:
    """The frame of a message with a header; '' where it is no name for a frame."""
    name: str = message.header.frame_id
    return name if FRAME_NAME.fits(name) else ""


@dataclass(frozen=True)
class Transform:
    """How a frame is turned in another one; where it is there nobody has measured.

    quaternion  (x, y, z, w): takes vectors of the child into the parent
    """

    parent: str
    child: str
    quaternion: tuple[float, ...]


def transforms_of(instrument: Instrument, link: str, camera: str, inclinometer: str) -> tuple[Transform, ...]:
    """Make the transforms of an instrument whose frames have these names; a frame without a name is left out.

    So is the inclinometer where A3 is not known, or where there is none, and a frame that is in the tree already.
    """
    if not camera:
        return ()
    found = [_transform(link, camera, np.asarray(instrument.link_to_camera, float).T)]
    if inclinometer and instrument.vertical is None and not instrument.calibration.unknown:
        found.append(_transform(camera, inclinometer, instrument.calibration.a3.T))
    names, tree = {link}, []
    for transform in found:
        if transform.child not in names:
            names.add(transform.child)
            tree.append(transform)
    return tuple(tree)


def _transform(parent: str, child: str, matrix: np.ndarray) -> Transform:
    return Transform(parent, child, tuple(rotation.to_quaternion(matrix).tolist()))
