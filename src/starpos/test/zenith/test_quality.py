# SPDX-License-Identifier: Apache-2.0
"""The quality of a session's faces: one that is off is named with its size."""

import pytest
from sessions import INSTRUMENT, MARK, SCALE, VACUUM, drawn, shifted

from starpos.zenith.adjustment import adjusted
from starpos.zenith.doubts import checked_session, remarks


def adjust(sightings):
    return adjusted(sightings, INSTRUMENT, VACUUM, MARK)


def test_each_face_has_its_distance_from_the_others_and_an_error_that_explains_it(rng):
    sightings = drawn(rng).sightings
    # up leans less to where the stars stand further over
    off = [shifted(s, 1.2 * (12 <= k < 18), -0.9 * (12 <= k < 18)) for k, s in enumerate(sightings)]
    before, after = adjust(sightings).face_quality, adjust(off).face_quality
    assert len(after) == 8 and after[2].frames == 6
    moved = after[2].off_arcsec - before[2].off_arcsec
    assert moved == pytest.approx([0.9, -1.2], abs=0.25)
    assert max(after, key=lambda face: face.chi2).number == 2 and max(f.chi2 for f in before) < 14


def test_a_face_that_is_somewhat_off_is_named_beside_the_value(rng):
    sightings = drawn(rng).sightings
    off = [shifted(s, 0.95 * (12 <= k < 18), -0.95 * (12 <= k < 18)) for k, s in enumerate(sightings)]
    told = remarks(checked_session(off, INSTRUMENT, VACUUM, MARK), len(sightings), SCALE)
    assert (
        len(told) == 1
        and told[0].startswith("face 3 (top of the frame at")
        and "look at its frames" in told[0]
    )
