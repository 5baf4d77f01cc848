# SPDX-License-Identifier: Apache-2.0
"""The instrument as a tree of frames: base link, camera, inclinometer, as far as the solver knows how they are turned."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.instrument.instrument import Instrument


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

    So is the inclinometer where A3 is not known, or where there is none.
    """
    if not camera:
        return ()
    found = [_transform(link, camera, np.asarray(instrument.link_to_camera, float).T)]
    if inclinometer and instrument.vertical is None and not instrument.calibration.unknown:
        found.append(_transform(camera, inclinometer, instrument.calibration.a3.T))
    return tuple(t for t in found if t.parent != t.child)


def _transform(parent: str, child: str, matrix: np.ndarray) -> Transform:
    return Transform(parent, child, tuple(rotation.to_quaternion(matrix).tolist()))
