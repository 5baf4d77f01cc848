# SPDX-License-Identifier: Apache-2.0
"""A tiltmeter that is worse than its file states: the claimed errors stay true; one whose zero jumps is refused."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from sessions import AS_STATED, INSTRUMENT, MARK, SCALE, VACUUM, Worse, drawn

from starpos.errors import FixError
from starpos.zenith.doubts import checked_session, remarks

SESSIONS = 10
NOISE, DRIFT, LOOSE = Worse(noise=3), Worse(drift=5), Worse(scale=10)


@cache
def adjusted(worse, motion, number=SESSIONS):
    """Squares of errors over those claimed, claimed variances, remarks on the tiltmeter, and refusals."""
    nees, claimed, told, refused = [], [], [], []
    for seed in range(number):
        rng = np.random.default_rng([seed, 35])
        session = drawn(rng, frames=8, motion=motion, air=motion / 8, worse=worse)
        try:
            a = checked_session(session.sightings, INSTRUMENT, VACUUM, MARK)
        except FixError as e:
            refused.append(str(e))
            continue
        error = np.array([a.xi_arcsec - session.xi, a.eta_arcsec - session.eta])
        nees.append(error @ np.linalg.solve(a.covariance_arcsec2, error))
        claimed.append(np.trace(a.covariance_arcsec2) / 2)
        said = remarks(a, len(session.sightings), SCALE)
        told.append(next((line for line in said if "the tiltmeter shows" in line), ""))
    return np.array(nees), np.array(claimed), told, refused


# what is worse, how much the air moves the images (arcsec), and the largest median of the claimed errors (arcsec)
CASES = [
    (AS_STATED, 0.05, 0.02),
    (AS_STATED, 0.4, 0.1),
    (NOISE, 0.05, 0.045),
    (DRIFT, 0.05, 0.025),
    (LOOSE, 0.05, 0.025),
    (LOOSE, 0.4, 0.1),
]


def likely(nees) -> bool:
    """Whether errors of two degrees of freedom are those claimed: one set in 500 of true claims is not."""
    low, high = chi2.ppf([0.001, 0.999], 2 * len(nees))
    return low < nees.sum() < high


@pytest.mark.montecarlo
@pytest.mark.parametrize(("worse", "motion", "widest"), CASES)
def test_claimed_errors_are_true_and_no_wider_than_they_have_to_be(worse, motion, widest):
    nees, claimed, _, refused = adjusted(worse, motion)
    assert not refused and likely(nees)
    assert np.sqrt(np.median(claimed)) < widest


@pytest.mark.montecarlo
def test_over_all_of_them_too():
    """Where each alone would let pass a claim of three quarters."""
    assert likely(np.concatenate([adjusted(worse, motion)[0] for worse, motion, _ in CASES]))


@pytest.mark.montecarlo
def test_what_the_file_understates_is_named_and_nothing_else():
    as_stated, drift, loose = (adjusted(worse, 0.05)[2] for worse in (AS_STATED, DRIFT, LOOSE))
    assert sum(map(bool, as_stated)) <= 1
    assert (
        sum("a tilt_scale of 0.0" in line and "its file states 0.001" in line for line in loose)
        > SESSIONS / 2
    )
    # air hides it in most
    assert any("tilt_drift_arcsec_per_sqrt_hour" in line and "its file states 0.05" in line for line in drift)


@pytest.mark.parametrize("motion", [0.05, 0.4])
def test_a_zero_that_jumps_is_no_drift(motion):
    _, _, _, refused = adjusted(Worse(jump_arcsec=3.0), motion, number=4)
    assert len(refused) == 4 and all("jumped" in line or "face" in line for line in refused)
