# SPDX-License-Identifier: Apache-2.0
"""A camera at rest, touched, or with stamps that contradict each other: detected by its attitude on the Earth alone."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.poses import slip_s
from starpos.earth.orientation import ROTATION_RAD_S, earth_state
from starpos.units import ARCSEC
from starpos_testing.skies.fields import SkyField


@pytest.fixture
def fix(rng):
    """Boresight known to 0.1 arcsec, roll to 5, as of a few stars of a narrow field."""
    field = SkyField(stars=12, altitude=60.0)
    state = earth_state(field.utc)
    made = field.solve(*field.places(state, rng), state)
    axis = made.camera.rotation[:, 2]
    return known_to(made, (np.eye(3) * 0.1**2 + np.outer(axis, axis) * 5**2) * ARCSEC**2)


def known_to(fix, covariance):
    return replace(fix, camera=replace(fix.camera, covariance=covariance))


def slip(fix, first, stated_s=0.0):
    return slip_s(fix.camera, first.camera, fix.latitude, stated_s)


def turned(fix, vector):
    """Fix after a turn (rad) about the Earth's axes."""
    return replace(
        fix, camera=replace(fix.camera, rotation=rotation.from_vector(vector) @ fix.camera.rotation)
    )


def stamped(fix, off_s):
    return turned(fix, [0.0, 0.0, ROTATION_RAD_S * off_s])


@pytest.mark.parametrize("off_s", [1.5, -1.5, 3600.0, -40000.0])
def test_a_stamp_that_is_off_is_told_by_where_the_optical_axis_points(fix, off_s):
    # the roll alone would allow 2.8 s
    assert slip(stamped(fix, off_s), fix) == pytest.approx(abs(off_s), rel=1e-3)


def test_a_mount_may_creep(fix):
    assert slip(stamped(fix, 0.6), fix) == 0
    assert slip(turned(fix, np.array([6.0, -6.0, 4.0]) * ARCSEC), fix) == 0


def test_what_the_stars_cannot_tell_is_no_contradiction(fix):
    roll = fix.camera.rotation[:, 2] * 30 * ARCSEC
    assert slip(turned(fix, roll), fix) == 0
    known = known_to(fix, np.eye(3) * (0.1 * ARCSEC) ** 2)
    assert slip(turned(known, roll), known) is None


@pytest.mark.parametrize("vector", [(1.0, 0.0, 0.0), (0.0, -0.02, 3.0), (np.pi, 0.0, 0.0), (0.0, 1e-3, 0.0)])
def test_a_turn_about_any_other_axis_is_a_touch(fix, vector):
    assert slip(turned(fix, vector), fix) is None


def test_a_stated_error_of_the_stamps_allows_as_much(fix):
    assert slip(stamped(fix, 20.0), fix, stated_s=5.0) == 0
    assert slip(stamped(fix, 40.0), fix, stated_s=5.0) == pytest.approx(40.0, rel=1e-2)


def test_at_a_pole_it_is_a_touch(fix):
    at_pole = replace(stamped(fix, 100.0), latitude=np.radians(89.9))
    assert slip(at_pole, fix) is None
    assert slip(replace(fix, latitude=np.radians(89.9)), fix) == 0


def test_the_attitude_scatters_as_its_covariance_says(rng):
    field = SkyField(stars=25, altitude=70.0)
    state = earth_state(field.utc)
    xy, places = field.places(state, rng)
    true = field.solve(xy, places, state).camera.rotation
    chi2 = []
    for _ in range(150):
        fix = field.solve(xy + rng.normal(0, 0.3, xy.shape), places, state,
                          covariance_px2=np.eye(2)[None].repeat(25, 0) * 0.3**2)  # fmt: skip
        v = rotation.to_small_vector(fix.camera.rotation @ true.T)
        chi2.append(v @ np.linalg.solve(fix.camera.covariance, v))
    assert np.mean(chi2) / 3 == pytest.approx(0.95, abs=0.25)
