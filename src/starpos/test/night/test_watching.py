# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that stands still: a knock is found the same night, and none is invented."""

import numpy as np
import pytest

from starpos import rotation
from starpos.fix.attitude import Attitude
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.night.watching import NightPose, kept
from starpos.units import ARCSEC

FRAMES, SHARED = 4 * ARCSEC, 100 * ARCSEC


def month(rng, wander, knock=None, nights=30):
    """Poses with errors of their own, a large one that all share, a wander; a knock before one night."""
    pose, common = rotation.from_vector([1.0, 0.4, 2.0]), rotation.from_vector(rng.normal(0, SHARED, 3))
    factors = ("centroids", FRAMES, None), ("lens", SHARED, ALWAYS)
    terms = tuple(
        ErrorTerm(name, np.vstack([np.zeros((3, 3)), np.eye(3) * sigma]), shared=kind)
        for name, sigma, kind in factors
    )
    made = []
    for k in range(nights):
        if k == knock:
            axis = rng.normal(0, 1, 3)
            pose = rotation.from_vector(np.radians(0.05) * axis / np.linalg.norm(axis)) @ pose
        off = rotation.from_vector(rng.normal(0, np.hypot(FRAMES, wander), 3))
        optics = Attitude(common @ off @ pose, np.eye(3), of="camera", into="ENU", terms=terms)
        made.append(
            NightPose(day=str(k), utc_unix_s=k, frames=2, stars=900, optics=optics, focal_px=1, limit_mag=5)
        )
    return made


@pytest.mark.parametrize("wander", [0.0, 10 * ARCSEC])
def test_a_knock_is_found_the_same_night_and_none_is_invented(wander, rng):
    sigmas = []
    for knock in (2, 9, 17, 28, None):
        found = kept(month(rng, wander, knock))
        assert [k for k, night in enumerate(found) if night.alarm] == ([] if knock is None else [knock])
        sigmas += [night.turned / night.sigma for night in found[15:] if not night.alarm]
        if knock is not None:
            assert found[knock].moved_arcsec == pytest.approx(180, abs=5 * found[knock].sigma_arcsec)
    # neither too small nor much too large
    assert 0.5 < np.std(sigmas) < 1.15
