# SPDX-License-Identifier: Apache-2.0
"""What the residuals of elevations deny: an A3, single tilts, all that is stated."""

import re
from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging import elevation_axis
from starpos.fix.solver import Solver
from starpos.instrument.instrument import UNKNOWN_ARCSEC, Calibration
from starpos.night.together import from_elevations
from starpos.rotation import about_axis
from starpos_testing.skies.pointings import TRUE_A3, pointed_night, without_roll
from starpos_testing.skies.scenes import AIR

TWELVE = tuple(range(0, 360, 30))


def answered(night, off_deg=0.0, stated=(60.0, 60.0, 60.0), blunders=()):
    """The place of a night whose A3 is off by an angle, with blunders of 0.5 deg in some tilts."""
    a3 = about_axis(1, np.radians(off_deg)) @ TRUE_A3
    told = Calibration.of((0.0, 0.0, 0.0), stated).turned_to(a3)
    tilts = [
        replace(t, theta_x=t.theta_x + np.radians(0.5) * (k in blunders)) for k, t in enumerate(night.tilts)
    ]
    solver = Solver(replace(night.instrument, calibration=told), None, AIR)
    pointings = list(map(without_roll, night.pointings))
    return from_elevations(solver, pointings, replace(night, tilts=tilts).tilt)[1]


@pytest.fixture
def night():
    return pointed_night(np.random.default_rng(4), TWELVE, frames=1, spread_deg=4.0)


def doubts(found):
    """Which of the words the remarks have: an A3 that is denied, elevations that are left out, or scatter."""
    return {word for word in ("deny", "left out", "scatter") for r in found.remarks if word in r}


@pytest.mark.parametrize("stated", [(60.0, 60.0, 60.0), UNKNOWN_ARCSEC], ids=["to 60 arcsec", "unknown"])
def test_a_right_a3_is_not_denied(night, stated):
    found = answered(night, stated=stated)
    assert not doubts(found) and found.average.left_out == 0
    assert night.place_nees(found.average) < 14


def test_an_a3_that_the_residuals_deny_is_replaced_by_theirs(night):
    found = answered(night, off_deg=1.0)
    place, sigma_m = found.average, np.sqrt(found.average.covariance[0, 0])
    assert night.place_nees(place) < 14 and sigma_m < 1000
    assert re.match(r"the elevations deny the A3 given, by \d+ sigma", found.remarks[0])


@pytest.mark.parametrize("off_deg, stated", [(0.0, UNKNOWN_ARCSEC), (1.0, (60.0, 60.0, 60.0))])
def test_blundered_tilts_are_left_out_whether_a3_is_unknown_or_wrong(night, off_deg, stated):
    found = answered(night, off_deg, stated, blunders=(2, 7))
    assert "left out" in doubts(found) and found.average.left_out == 2
    assert night.place_nees(found.average) < 14
    assert np.sqrt(found.average.covariance[0, 0]) < 1000


def test_tilts_that_all_scatter_widen_the_claim():
    wild = pointed_night(np.random.default_rng(5), TWELVE, frames=1, spread_deg=4.0, noise=30.0)
    found = answered(wild)
    assert doubts(found) == {"scatter"}
    assert wild.place_nees(found.average) < 14


def test_an_axis_that_the_fit_leaves_at_the_border_of_what_the_frames_can_have_is_no_answer(
    night, monkeypatch
):
    """The best axis brings a frame nearer to the zenith than any may be: the fit ends there, far from a minimum."""
    solved, calls = elevation_axis._solved, []
    monkeypatch.setattr(
        elevation_axis, "_solved", lambda *a, **more: (calls.append(a), solved(*a, **more))[1]
    )
    answered(night, off_deg=-1.0, stated=UNKNOWN_ARCSEC)
    a3, _, circles, _, ray, _ = first = calls[0]
    up = np.array([c.up for c in circles])
    begin, end = (np.sin(rotation.angle(up, m @ ray)).min() for m in (a3, solved(*first).a3))
    monkeypatch.setattr(elevation_axis, "MIN_SINE", begin + 0.01 * (end - begin))
    assert end < begin and solved(*first) is None
