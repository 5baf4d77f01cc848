# SPDX-License-Identifier: Apache-2.0
"""Sessions that bear no deflection say why, in a sentence."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import INSTRUMENT, MARK, SCALE, VACUUM, drawn, shifted

from starpos.errors import FixError
from starpos.units import ARCSEC
from starpos.zenith import doubts
from starpos.zenith.doubts import checked_session, remarks


def session(sightings):
    return checked_session(sightings, INSTRUMENT, VACUUM, MARK)


def said(sightings, frames=None):
    found = session(sightings)
    return " ".join(remarks(found, frames or len(sightings), SCALE))


def test_a_sound_session_has_no_remarks(rng):
    sightings = drawn(rng).sightings
    # their order does not count
    assert said(sightings[::-1]) == ""


def test_faces_that_do_not_come_round(rng):
    with pytest.raises(FixError, match=r"faces do not come round: .* half a turn"):
        session(drawn(rng, azimuths=(0, 20)).sightings)


def test_a_clock_that_jumps_is_told_with_its_step(rng):
    sightings = drawn(rng).sightings
    # half a second: 15.041 arcsec a second, at the mark's latitude
    east = 0.5 * 15.041 * np.cos(MARK.latitude)
    jumped = [shifted(s, east * (k >= 30), 0.0) for k, s in enumerate(sightings)]
    with pytest.raises(FixError, match=r"clock .* jumped by [+-]0\.[45]\d* s"):
        session(jumped)


def test_a_tiltmeter_whose_zero_jumps(rng):
    sightings = drawn(rng).sightings
    jumped = [_tilted(s, 3.0 * (k >= 20)) for k, s in enumerate(sightings)]
    with pytest.raises(FixError, match=r"zero seems to have jumped by \+[23]\.\d+"):
        session(jumped)


def test_a_face_unlike_the_others_is_named(rng):
    sightings = drawn(rng).sightings
    off = [shifted(s, 4.0 * (12 <= k < 18), -3.0 * (12 <= k < 18)) for k, s in enumerate(sightings)]
    with pytest.raises(FixError, match=r"face 3 \(top of the frame .* 6 frames\) is [45]\.\d+ arcsec off"):
        session(off)


def test_a_site_that_is_a_kilometre_off_is_told_by_its_size(rng):
    sightings = [shifted(s, 0.0, -32.4) for s in drawn(rng).sightings]
    assert "high mountains" in said(sightings) and "km off" in said(sightings)
    with pytest.raises(FixError, match="no place of the Earth"):
        session([shifted(s, 0.0, -200.0) for s in sightings])


def test_clouds_in_one_face(rng):
    sightings = drawn(rng).sightings
    told = said(sightings[:13] + sightings[18:], frames=len(sightings))
    assert "face 3 has 1 frames of the usual 6" in told and "5 of 48 frames are left out" in told


def test_a_tiltmeter_that_is_not_level_enough(rng):
    assert "level every face to" in said(drawn(rng, lean=300.0).sightings)


def test_a_value_better_than_the_catalogues_zones_says_so(rng, monkeypatch):
    quiet = drawn(rng, motion=0.01, air=0.0, frames=12).sightings
    # 1 mas, and 0.5 mas for each of 34 years
    assert "zonal errors of Tycho-2, up to 0.018 arcsec" in said(quiet)
    monkeypatch.setattr(doubts, "load_catalogue", LikeGaia)
    assert said(quiet) == ""


class LikeGaia:
    """A catalogue whose stars err by 0.1 mas."""

    def sigma(self, index, year):
        return np.full(len(index), 1e-4 * ARCSEC)


def test_no_sighting_is_no_deflection():
    with pytest.raises(FixError, match="0 frames make no session"):
        session([])


def _tilted(sighting, arcsec):
    tilt = sighting.tilt
    return replace(sighting, tilt=replace(tilt, theta_x=tilt.theta_x + arcsec * ARCSEC))
