# SPDX-License-Identifier: Apache-2.0
"""The instrument as a tree of frames: base link, camera, inclinometer, as far as their rotations are known."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos import rotation
from starpos.instrument.instrument import Instrument
from starpos.parameters.table import FRAME_NAME


@dataclass
class FrameNames:
    """The frame names of camera and inclinometer in their messages; '' before the first one."""

    camera: str = ""
    inclinometer: str = ""


def name_in(message: Any) -> str:
    """The frame of a message with a header; '' if it is not a valid name."""
    name: str = message.header.frame_id
    return name if FRAME_NAME.fits(name) else ""


@dataclass(frozen=True)
class Transform:
    """Rotation of a frame in another one; its position there is not measured.

    quaternion  (x, y, z, w): takes vectors of the child into the parent
    """

    parent: str
    child: str
    quaternion: tuple[float, ...]


def transforms_of(instrument: Instrument, link: str, camera: str, inclinometer: str) -> tuple[Transform, ...]:
    """Make the transforms of an instrument whose frames have these names; a frame without a name is left out.

    So is the inclinometer without a known A3, a missing inclinometer, and a frame that is in the tree already.
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
