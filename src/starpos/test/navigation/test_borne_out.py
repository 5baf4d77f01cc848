# SPDX-License-Identifier: Apache-2.0
"""A law of motion weighed by a record: what its means say of the wind, and the claims that follow."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from voyage_calls import navigated, nees, sigma_m

from starpos.navigation.evidence import independent_means
from starpos.navigation.vessel import LAWS
from starpos_testing.voyages import made, turbulent_wind, walking_wind

T = np.arange(0.0, 420.0, 1.5)


@pytest.fixture(params=[100.0, 1000.0, np.inf], ids=["circling", "turning slowly", "straight on"])
def side(request):
    turn = 2 * np.pi * T / request.param
    return np.stack([-np.sin(turn), np.cos(turn)], 1)


def test_combinations_of_means_are_independent_of_each_other_and_of_trends(side):
    """Against the covariances of all velocities, written down by definition."""
    values = np.stack([independent_means(T, side, one, 7).values for one in np.eye(len(T))], 1)
    means = independent_means(T, side, np.zeros(len(T)), 7)
    assert len(means.walks) >= 5
    assert values @ values.T == pytest.approx(np.eye(len(values)), abs=1e-9)
    walked = np.minimum.outer(T, T) * (side @ side.T)
    assert values @ walked @ values.T == pytest.approx(np.diag(means.walks), abs=1e-9 * means.walks.max())
    trend = side @ [3.0, -2.0] + T * (side @ [0.01, 0.02])
    assert values @ trend == pytest.approx(np.zeros(len(values)), abs=1e-8)
    swing = (side @ [0.0, 1.0]) * np.sin(2 * np.pi * T / T[-1]) * T[-1] / (2 * np.pi)
    assert values @ swing == pytest.approx(means.swings[:, 3], abs=1e-8)


def test_likelihood_is_that_of_all_covariances_together(side, rng):
    means = independent_means(T, side, rng.normal(size=len(T)), 7)
    variance = rng.uniform(0.5, 2, (3, len(means.values)))
    for one, likely in zip(variance, means.log_likelihood(variance, 0.003), strict=True):
        covariance = np.diag(one) + 0.003**2 * means.swings @ means.swings.T
        by_definition = multivariate_normal(np.zeros(len(one)), covariance).logpdf(means.values)
        assert likely - len(one) * np.log(2 * np.pi) / 2 == pytest.approx(by_definition)


@cache
def voyage_in(wind, seed):
    record = made("drone", 900, seed, rate_hz=10, cadence_s=3.0, more_wind=wind)
    return record, navigated(record, "drone", velocity=False)


def test_a_wind_as_the_law_has_it_is_claimed_as_it_is():
    """NEES of place and heading, 3 in the mean: the sum of three lies between 0.1 % and 99.9 % of chi-squared of 9."""
    scores = []
    for seed in range(3):
        record, voyage = voyage_in(walking_wind(LAWS["drone"].drift_walk), seed)
        scores.append(nees(voyage, record))
        assert not voyage.faults
    assert 1.15 < sum(scores) < 27.9, scores


def test_a_wind_that_changes_more_widens_the_claim_and_is_told():
    record, voyage = voyage_in(turbulent_wind(1.0), 5)
    assert voyage.last.law.drift_walk > 2 * LAWS["drone"].drift_walk
    assert "wind or current change" in voyage.faults[0]
    assert sigma_m(voyage) > 2 * sigma_m(voyage_in(None, 5)[1])
    assert nees(voyage, record) < 16


def test_a_steady_wind_is_not_believed_to_stay_so():
    """An unseen trend of 0.3 m/s in ten minutes remains possible; unseen gusts do not."""
    _, voyage = voyage_in(None, 5)
    law = voyage.last.law
    assert law.drift_walk == pytest.approx(LAWS["drone"].drift_walk, rel=0.05)
    assert law.rest_stddev < 0.5 * LAWS["drone"].rest_stddev


def test_a_wind_that_changes_more_than_the_law_says_widens_the_claim():
    record = made("drone", 900, 4, rate_hz=10, cadence_s=3.0, more_wind=walking_wind(0.05))
    walking = navigated(record, "drone", velocity=False)
    assert any("change" in fault for fault in walking.faults)
    assert sigma_m(walking) > 1.5 * sigma_m(voyage_in(None, 5)[1])
