# SPDX-License-Identifier: Apache-2.0
"""What the residuals of elevations contradict: an A3, single tilts, all that is stated."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.fix.solver import Solver
from starpos.instrument.instrument import Calibration
from starpos.night.together import from_elevations
from starpos.rotation import about_axis
from starpos_testing.skies.pointings import TRUE_A3, pointed_night, without_roll
from starpos_testing.skies.scenes import AIR

TWELVE = tuple(range(0, 360, 30))


def answered(night, off_deg=0.0, blunders=()):
    """The place of a night whose A3 is off by an angle, with blunders of 0.5 deg in some tilts."""
    a3 = about_axis(1, np.radians(off_deg)) @ TRUE_A3
    told = Calibration.of((0.0, 0.0, 0.0), (60.0, 60.0, 60.0)).turned_to(a3)
    tilts = [
        replace(t, theta_x=t.theta_x + np.radians(0.5) * (k in blunders)) for k, t in enumerate(night.tilts)
    ]
    solver = Solver(replace(night.instrument, calibration=told), None, AIR)
    return from_elevations(solver, list(map(without_roll, night.pointings)), replace(night, tilts=tilts).tilt)


@pytest.fixture
def night():
    return pointed_night(np.random.default_rng(4), TWELVE, frames=1, spread_deg=4.0)


def test_a_right_a3_is_not_doubted(night):
    found = answered(night)
    assert not any("elevations" in r for r in found.together.remarks)
    assert found.together.average.left_out == 0 and night.place_nees(found.together.average) < 14


def test_an_a3_that_the_residuals_deny_is_no_place(night):
    found = answered(night, off_deg=1.0)
    assert found.together.average is None and "check A3" in found.together.why_not


def test_blundered_tilts_are_left_out(night):
    found = answered(night, blunders=(2, 7))
    assert found.together.average.left_out == 2
    assert any("left out" in r for r in found.together.remarks)
    assert night.place_nees(found.together.average) < 14
    assert np.sqrt(found.together.average.covariance[0, 0]) < 1000


def test_tilts_that_scatter_widen_the_claim():
    wild = pointed_night(np.random.default_rng(5), TWELVE, frames=1, spread_deg=4.0, noise=2.5)
    found = answered(wild)
    assert any("scatter" in r for r in found.together.remarks)
    assert wild.place_nees(found.together.average) < 14
