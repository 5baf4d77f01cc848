# SPDX-License-Identifier: Apache-2.0
"""The place from elevations alone, against the truth of a simulated sky."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import fdtri

from starpos.averaging.altitudes import WITHIN, excess, place_of_circles
from starpos.earth.orientation import earth_state
from starpos.errors import FixError
from starpos.fix.circle import circle_of
from starpos.fix.fix import IDEAL
from starpos.fix.solver import Solver
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.units import ARCSEC
from starpos_testing.skies.pointings import pointed_night, without_roll
from starpos_testing.skies.scenes import AIR

FOUR = (0.0, 90.0, 180.0, 270.0)
THREE = (0.0, 120.0, 240.0)


def circles(night, **instrument):
    solver = Solver(replace(night.instrument, clock_stddev_s=0.01, **instrument), (), AIR)
    return [
        circle_of(without_roll(p), t, solver.circumstances(p, IDEAL, earth_state(p.mid_unix_s)))
        for p, t in zip(night.pointings, night.tilts, strict=True)
    ]


def near_of(night):
    return np.radians(night.site.latitude_deg), np.radians(night.site.longitude_deg + 1)


@pytest.mark.parametrize("free", [2, 3, 7, 60])
def test_scatter_widens_by_the_f_distribution_of_scipy(free):
    wide = fdtri(2, max(free, 2), WITHIN) / -np.log(1 - WITHIN)
    assert excess(3.0 * free, free) == pytest.approx(2 * wide, rel=1e-12)


def test_exact_elevations_give_the_exact_place(rng):
    exact = {"sigma_arcsec": 1e-3, "a3_sigma_arcsec": 1e-3, "noise": 1e-3}
    night = pointed_night(rng, THREE, **exact)
    place = place_of_circles(circles(night))
    assert np.abs(night.off_m(place)).max() < 2
    assert np.isnan(place.heading) and np.isnan(place.covariance[2]).all()
    assert (place.frames, place.poses, place.left_out) == (6, 3, 0)


@pytest.mark.montecarlo
@pytest.mark.parametrize(
    ("azimuths", "noise", "least"),
    [(FOUR * 2, 1.0, 0.9), (FOUR, 1.0, 0.9), (THREE, 1.0, 0.8), (FOUR * 2, 3.0, 0.9)],
    ids=["eight directions", "four", "three", "eight, noise three times as stated"],
)
def test_claims_are_true_over_many_nights(azimuths, noise, least):
    found = []
    # a scale that is found in the residuals makes wide tails
    for seed in range(60 if noise > 1 else 12):
        night = pointed_night(np.random.default_rng(seed), azimuths, frames=1, noise=noise)
        found.append(night.place_nees(place_of_circles(circles(night))))
    assert least < np.mean(found) < 2.8
    # half of them lie where half should
    assert np.median(found) < 1.9


def test_three_directions_that_contradict_each_other_are_no_place():
    """One residual does not show by how much they err: 8 of 100 such nights were beyond 5 sigma."""
    refused = []
    for seed in range(6):
        night = pointed_night(np.random.default_rng(seed), THREE, frames=1, noise=120.0)
        try:
            place_of_circles(circles(night))
        except FixError as e:
            refused.append(str(e))
    assert len(refused) >= 5 and all("add directions" in said for said in refused)


def test_an_error_of_every_pose_is_one_error_of_its_frames(rng):
    one, many = (
        place_of_circles(
            circles(
                pointed_night(
                    np.random.default_rng(1), frames=n, errors=InclinometerErrors(pose_rad=60 * ARCSEC)
                )
            )
        )
        for n in (1, 6)
    )
    size = [np.sqrt(next(t.covariance[0, 0] for t in p.terms if t.name == "tilt pose")) for p in (one, many)]
    assert size[1] == pytest.approx(size[0], rel=0.1) and size[0] > 500


def test_directions_around_the_horizon_cancel_an_error_of_a3():
    """A3's error is the same in all directions, so four of them know the place better than one would."""
    night = pointed_night(np.random.default_rng(2), FOUR, a3_sigma_arcsec=100.0)
    place = place_of_circles(circles(night))
    assert np.sqrt(place.covariance[0, 0]) < 1500 < 100 * 31
    assert night.place_nees(place) < 14


def test_one_direction_is_no_place_however_the_sky_turns(rng):
    night = pointed_night(rng, (10.0,), frames=6)
    with pytest.raises(FixError, match="6 elevations in 1 direction do not determine a place"):
        place_of_circles(circles(night))


def test_two_directions_leave_two_places_unless_somebody_says_which(rng):
    night = pointed_night(rng, (10.0, 80.0))
    with pytest.raises(FixError, match="two circles meet in two places"):
        place_of_circles(circles(night))
    assert night.place_nees(place_of_circles(circles(night), near_of(night))) < 14


def test_directions_in_one_plane_leave_two_places(rng):
    """All are on one side, nearly on one great circle that does not hold the zenith."""
    night = pointed_night(rng, (0.0, 20.0, 40.0), sigma_arcsec=600.0, frames=1)
    try:
        place = place_of_circles(circles(night))
    except FixError as e:
        assert "leave two places" in str(e)
        place = place_of_circles(circles(night), near_of(night))
    assert night.place_nees(place) < 20


def test_a_direction_with_a_wrong_tilt_is_left_out(rng):
    night = pointed_night(rng)
    bad = {4, 5}
    tilts = [replace(t, theta_x=t.theta_x + np.radians(0.5 * (k in bad))) for k, t in enumerate(night.tilts)]
    spoilt = replace(night, tilts=tilts)
    place = place_of_circles(circles(spoilt))
    assert (place.left_out, place.poses) == (2, 7)
    assert night.place_nees(place) < 14


def test_directions_that_disagree_widen_the_claim(rng):
    night = pointed_night(rng)
    off = np.radians(rng.normal(0, 0.2, 8)).repeat(2)
    tilts = [
        replace(t, theta_x=t.theta_x + o, theta_y=t.theta_y - o)
        for t, o in zip(night.tilts, off, strict=True)
    ]
    place = place_of_circles(circles(replace(night, tilts=tilts)))
    assert np.sqrt(place.covariance[0, 0]) > 1500
    assert night.place_nees(place) < 14


def test_what_tells_no_elevation_is_refused(rng):
    night = pointed_night(rng)
    upright = night.instrument.calibration.turned_to(np.diag([1.0, -1.0, -1.0]))
    with pytest.raises(FixError, match="from the zenith"):
        circles(night, calibration=upright)
