# SPDX-License-Identifier: Apache-2.0
"""Voyages of the reference against their truth: exact ones anywhere on Earth, and the claims of those with errors."""

from dataclasses import replace

import numpy as np
import pytest
from voyage_calls import errors, navigated, nees, sigma_m, vessel

from starpos.navigation.voyage import adjust_voyage
from starpos_testing.voyages import CAMERA_TO_BODY, INDUSTRIAL, TACTICAL, made


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg"),
    [(48, 11), (89.999, 40), (-90, 0), (0, 180), (-33, -179.999)],
    ids=["Europe", "pole", "south pole", "equator", "date line"],
)
def test_an_exact_voyage_is_found_to_a_metre_from_nothing(latitude_deg, longitude_deg):
    """The vehicle drives and turns; neither place nor attitude nor level is given, and the height is as expected."""
    about = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "height_m": 500.0}
    exact = made("rover", 60, 3, rate_hz=100, errors=False, **about)
    voyage = navigated(exact)
    off = voyage.motion.place - exact.place
    up = exact.place / np.linalg.norm(exact.place, axis=1)[:, None]
    assert np.linalg.norm(off - up * np.sum(off * up, 1)[:, None], axis=1).max() < 1.0
    # height is only determined by the strength of gravity, of which the reference has fewer terms
    assert np.abs(np.sum(off * up, 1)).max() < 5.0
    ahead = np.einsum("kij,kij->kj", voyage.motion.attitude, exact.body_to_itrs)
    assert np.degrees(np.arccos(np.minimum(ahead, 1))).max() * 3600 < 2.0
    if abs(latitude_deg) < 89:
        assert np.abs(errors(voyage, exact)).max(0) == pytest.approx(np.zeros(3), abs=1.0)


@pytest.mark.parametrize(("kind", "model"), [("rover", INDUSTRIAL), ("ship", TACTICAL)])
def test_claims_hold(kind, model):
    """NEES of place and heading, 3 in the mean: the sum of eight lies between 0.1 % and 99.9 % of chi-squared of 24."""
    scores = []
    for seed in range(8):
        record = made(kind, 100, seed, model=model, rate_hz=25, cadence_s=2.0)
        scores.append(nees(navigated(record, kind, model=model), record))
    assert 6.9 < sum(scores) < 51.2, scores


@pytest.mark.parametrize("kind", ["drone", "parked"])
def test_without_velocity_the_claim_is_wide_and_holds(kind):
    record = made(kind, 120, 4, rate_hz=25)
    voyage = navigated(record, kind, velocity=False)
    assert nees(voyage, record) < 16 and sigma_m(voyage) > 1000


def test_frames_whose_clock_is_worse_than_the_instruments_widen_the_claim():
    """A clock that is 1 s off puts all places 464 m east or west at the equator."""
    record = made("rover", 60, 3, rate_hz=25, latitude_deg=0.0)
    late = [replace(f, clock_stddev_s=1.0) for f in record.frames]
    own, by_frames = (
        adjust_voyage(frames, record.imu, record.velocity, vessel()) for frames in (record.frames, late)
    )
    stated = adjust_voyage(record.frames, record.imu, record.velocity, replace(vessel(), clock_stddev_s=1.0))
    east, east_late = (v.fixes[-1].covariance[0, 0] for v in (own, by_frames))
    assert east_late - east == pytest.approx(464.6**2, rel=0.01)
    assert by_frames.fixes[-1].covariance == pytest.approx(stated.fixes[-1].covariance)
    assert by_frames.last.clock_stddev_s == 1.0


def test_a_vehicle_that_nobody_names_has_a_wider_claim():
    record = made("rover", 90, 4, rate_hz=25)
    unnamed, named = (navigated(record, kind, velocity=False) for kind in (None, "rover"))
    assert sigma_m(unnamed) > 3 * sigma_m(named)
    assert nees(unnamed, record) < 16 and nees(named, record) < 16


def test_the_mount_is_found_on_the_way():
    record = made("ship", 120, 7, rate_hz=25, mount_deg=1.0)
    motion = navigated(record, "ship").motion
    off = np.degrees(np.arccos((np.trace(motion.camera_to_body @ record.mount.T) - 1) / 2))
    before = np.degrees(np.arccos((np.trace(CAMERA_TO_BODY @ record.mount.T) - 1) / 2))
    assert before > 0.5 and off < 0.15
