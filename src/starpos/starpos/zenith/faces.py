# SPDX-License-Identifier: Apache-2.0
"""Faces of a session: runs of frames in which the instrument stood at one azimuth."""

from collections.abc import Sequence

import numpy as np

from starpos.rotation import half_turns
from starpos.zenith.sighting import ZenithSighting

# within a face the heading stays: a turntable or a foot that settles moves it by less than this
SAME_FACE_RAD = np.radians(5.0)


def faces_of(sightings: Sequence[ZenithSighting]) -> np.ndarray:
    """Number (N,) of the face of each frame, from 0, of frames in order of time."""
    headings = np.array([s.heading for s in sightings])
    faces, first = np.zeros(len(headings), int), headings[0]
    for k in range(1, len(headings)):
        turned = abs(half_turns(headings[k] - first)) > SAME_FACE_RAD
        faces[k] = faces[k - 1] + turned
        first = headings[k] if turned else first
    return faces


def mean_headings(sightings: Sequence[ZenithSighting], faces: np.ndarray) -> np.ndarray:
    """Azimuth (F,) in rad of the top of the frame in each face."""
    towards = np.exp(1j * np.array([s.heading for s in sightings]))
    return np.angle([towards[faces == k].sum() for k in range(faces.max() + 1)]) % (2 * np.pi)
