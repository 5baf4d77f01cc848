# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that stands still: a knock is found the same night, and none is invented."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos import rotation
from starpos.cli import watch_output
from starpos.fix.attitude import Attitude
from starpos.fix.searching import Sight
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.frame import Frame, Stars
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.night.watching import NightPose, kept, sky_mag
from starpos.units import ARCSEC

FRAMES, SHARED = 4 * ARCSEC, 100 * ARCSEC


def month(rng, wander, knock=None, nights=30, dewed=()):
    """Poses with errors of their own, a large one that all share, a wander; a knock before one night; nights with dew."""
    pose, common = rotation.from_vector([1.0, 0.4, 2.0]), rotation.from_vector(rng.normal(0, SHARED, 3))
    made = []
    for k in range(nights):
        own = FRAMES * (50 if k in dewed else 1)
        terms = tuple(
            ErrorTerm(name, np.vstack([np.zeros((3, 3)), np.eye(3) * sigma]), shared=kind)
            for name, sigma, kind in (("centroids", own, None), ("lens", SHARED, ALWAYS))
        )
        if k == knock:
            axis = rng.normal(0, 1, 3)
            pose = rotation.from_vector(np.radians(0.05) * axis / np.linalg.norm(axis)) @ pose
        off = rotation.from_vector(rng.normal(0, np.hypot(own, wander), 3))
        optics = Attitude(common @ off @ pose, np.eye(3), of="camera", into="ENU", terms=terms)
        made.append(
            NightPose(
                day=str(k),
                utc_unix_s=k,
                frames=2,
                stars=900,
                optics=optics,
                focal_px=1,
                limit_mag=5,
                worst_limit_mag=2 if k in dewed else 4.5,
                worst_unix_s=k,
                extinction=np.nan,
                extinction_sigma=np.nan,
                sky_mag=21,
            )
        )
    return made


@pytest.mark.parametrize("wander", [0.0, 2 * ARCSEC, 10 * ARCSEC])
def test_a_knock_is_found_the_same_night_and_none_is_invented(wander, rng):
    sigmas = []
    for knock in (2, 9, 17, 28, None):
        found = kept(month(rng, wander, knock))
        assert [k for k, night in enumerate(found) if night.alarm] == ([] if knock is None else [knock])
        sigmas += [night.turned / night.sigma for night in found[15:] if not night.alarm]
        if knock is not None:
            assert found[knock].moved_arcsec == pytest.approx(180, abs=5 * found[knock].sigma_arcsec)
    # neither too small nor too large
    assert 0.8 < np.std(sigmas) < 1.2


def test_nights_with_dew_hardly_count_and_a_sentence_says_so(rng):
    for dewed in ((0, 1, 5), (3, 4, 8)):
        found = kept(month(rng, 2 * ARCSEC, nights=12, dewed=dewed))
        clear = [night for k, night in enumerate(found) if k > 8 and k not in dewed]
        assert not any(night.alarm for night in found)
        assert max(night.moved_arcsec for night in clear) < 20
        assert max(np.abs(night.turned / night.sigma).max() for night in clear) < 4
        said = [watch_output.dimmed_of(found[: k + 1]) for k in range(12)]
        assert [k for k in range(12) if said[k]] == list(dewed)
        assert "V 2.0, 3.0 mag brighter than usual" in said[dewed[1]]


def test_a_post_that_wanders_far_is_no_alarm():
    months = [kept(month(np.random.default_rng(k), 35 * ARCSEC)) for k in range(20)]
    assert sum(night.alarm for nights in months for night in nights) == 0


def test_the_brightness_of_the_sky_by_its_stars(rng):
    camera = Camera.from_focal(600, 600, 100.0, EQUIDISTANT)
    y, x = np.mgrid[:600, :600] - 299.5
    # 21.0 per square arcsec over a black level of 240, in the picture alone
    v, zero = np.sort(rng.uniform(2, 5, 40)), 16.0
    sky = 10 ** (-0.4 * (21.0 - zero)) * camera.scale_arcsec**2
    pixels = (240 + np.where(np.hypot(x, y) < 160, sky, 0)).round().astype(np.uint16)
    places, flux = rng.uniform(200, 400, (2, 40)), 10 ** (-0.4 * (v - zero))
    stars = Stars(
        width=600,
        height=600,
        x=places[0],
        y=places[1],
        flux=flux,
        covariance=np.tile(np.eye(2), (40, 1, 1)),
        snr=flux,
        flags=np.zeros(40, np.uint8),
    )
    solution = SimpleNamespace(star=np.arange(40), magnitudes=v)
    assert sky_mag(Frame(pixels), Sight(stars, solution), camera) == pytest.approx(21.0, abs=0.02)
    # levels that are no light, and a frame without a corner that is dark
    assert np.isnan(sky_mag(Frame(pixels.astype(np.uint8)), Sight(stars, solution), camera))
    assert np.isnan(sky_mag(Frame(pixels), Sight(stars, solution), camera.scaled(5)))
