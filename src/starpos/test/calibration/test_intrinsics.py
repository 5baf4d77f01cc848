# SPDX-License-Identifier: Apache-2.0
"""The fit of a camera to identified stars: true, with true errors, and none where none can be had."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.calibration.camera import check_sound, fewest_stars, fit_camera, rms
from starpos.calibration.camera_adjustment import CameraSighting, parameters, unbent
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError
from starpos.instrument.camera import Camera
from starpos_testing.skies.lenses import (
    FIELDS,
    VACUUM,
    ideal,
    k1_of,
    prediction_errors,
    random_camera,
    sightings,
    values,
)


def moved(sighting: CameraSighting, rows, by) -> CameraSighting:
    xy = sighting.stars.xy.copy()
    xy[rows] += by
    return with_stars(sighting, xy=xy)


def with_stars(sighting: CameraSighting, **other) -> CameraSighting:
    return replace(sighting, stars=replace(sighting.stars, **other))


@pytest.mark.parametrize("field", FIELDS)
def test_a_camera_is_recovered_to_what_it_claims(field, rng):
    true = random_camera(field, rng)
    fit = fit_camera(sightings(true, 20, 80, rng), ideal(field), VACUUM)
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    assert np.abs(prediction_errors(true, fit.camera)).max() < 0.06
    assert fit.rms_px == pytest.approx(0.05, rel=0.05)
    assert rms(fit.before) > 0.1
    assert fit.xy.shape == fit.residual.shape == fit.before.shape == (20 * 80 - fit.rejected, 2)
    check_sound(fit, ideal(field))


@pytest.mark.montecarlo
@pytest.mark.parametrize("field", FIELDS)
def test_over_many_cameras_the_errors_are_those_claimed(field, rng):
    z, off, claimed, corner = [], [], [], np.zeros((1, 2))
    for _ in range(30):
        true = random_camera(field, rng)
        fit = fit_camera(sightings(true, 8, 60, rng), ideal(field), VACUUM)
        z.append((fit.values - values(true)) / fit.sigma)
        off.append(prediction_errors(true, fit.camera)[0])
        claimed.append(fit.sigma_px(corner)[0])
    z2, off2 = np.square(z), np.square(off) / np.square(claimed)[:, None]
    assert 0.6 < z2.mean() < 1.5
    # chi-square of 30, one in 10000.
    assert (z2.mean(0) < 2.2).all()
    assert (z2.mean(0) > 0.3).all()
    # In squared pixels at the corner, which is what matters.
    assert 0.5 < off2.mean() < 1.7


def test_what_a_few_stars_of_a_narrow_field_cannot_tell_the_prior_holds(rng):
    given = ideal(3.4)
    fit = fit_camera(sightings(given, 1, 30, rng, sigma=0.3), given, VACUUM)
    told = dict(zip(parameters(ideal(11)), fit.determined, strict=True))
    assert told["fx"] and told["fy"] and told["k1"]
    assert not any(told[name] for name in ("cx", "cy"))
    assert (fit.sigma <= fit.prior_sigma).all()
    assert (np.abs(fit.values - values(given)) < 3 * fit.prior_sigma).all()


def test_what_the_prior_holds_stays_near_its_middle(rng):
    """The best guess, not the likeliest: stars that hardly determine the principal point hardly move it."""
    given = ideal(3.4)
    fits = [fit_camera(sightings(given, 1, 40, rng, sigma=1.0), given, VACUUM) for _ in range(12)]
    moved = np.array([(f.values - values(given)) / f.prior_sigma for f in fits])[:, 2:4]
    assert rms(moved) < 0.5


def test_the_end_does_not_depend_on_the_beginning(rng):
    true = random_camera(3.4, rng)
    near = sightings(true, 2, 40, rng, sigma=0.3)
    far = [replace(s, attitude=rotation.from_vector([3e-3, -2e-3, 0.02]) @ s.attitude) for s in near]
    a, b = (fit_camera(s, ideal(3.4), VACUUM) for s in (near, far))
    assert (np.abs(a.values - b.values) < 1e-3 * a.sigma).all()


def test_more_frames_tell_more_and_one_frame_is_enough(rng):
    true = random_camera(11, rng)
    frames = sightings(true, 16, 80, rng)
    one, many = (fit_camera(f, ideal(11), VACUUM) for f in (frames[:1], frames))
    assert np.abs((one.values - values(true)) / one.sigma).max() < 4
    assert (many.sigma < 0.5 * one.sigma).all()
    assert many.worst_sigma_px < 0.5 * one.worst_sigma_px


def test_wrong_matches_move_nothing(rng):
    true = random_camera(11, rng)
    clean = sightings(true, 10, 60, rng)
    spoiled = [
        moved(s, slice(0, 6), rng.uniform(0.7, 6, (6, 2)) * rng.choice([-1, 1], (6, 2))) for s in clean
    ]
    fit, with_them = (fit_camera(s, ideal(11), VACUUM) for s in (clean, spoiled))
    assert 60 <= with_them.rejected < 66
    assert (np.abs(with_them.values - fit.values) < 1.5 * fit.sigma).all()
    assert (np.abs(with_them.values - values(true)) < 4 * with_them.sigma).all()
    assert (with_them.sigma < 1.2 * fit.sigma).all()


def test_scatter_beyond_the_stated_errors_widens_the_claim(rng):
    true = random_camera(11, rng)
    frames = sightings(true, 10, 60, rng, sigma=0.2)
    bold = [with_stars(s, covariance_px2=s.stars.covariance_px2 / 16) for s in frames]
    honest, fit = (fit_camera(f, ideal(11), VACUUM) for f in (frames, bold))
    assert fit.scatter_px == pytest.approx(np.sqrt(0.2**2 - 0.05**2), rel=0.1)
    np.testing.assert_allclose(fit.sigma, honest.sigma, rtol=0.15)


def test_stars_whose_places_are_poorly_known_count_less(rng):
    true = random_camera(11, rng)
    frames, sigma = [], np.repeat([1e-9, 0.5 / true.fx], 40)
    for s in sightings(true, 10, 80, rng):
        off = s.stars.places + rng.normal(0, 1, (80, 3)) * sigma[:, None]
        off /= np.linalg.norm(off, axis=1, keepdims=True)
        frames.append(with_stars(s, places=off, place_sigma=sigma))
    fit = fit_camera(frames, ideal(11), VACUUM)
    assert fit.scatter_px < 0.03
    assert fit.rejected < 5
    assert np.abs((fit.values - values(true)) / fit.sigma).max() < 4
    good = [with_stars(s, **{name: getattr(s.stars, name)[:40] for name in
                             ("xy", "covariance_px2", "places", "place_sigma")}) for s in frames]  # fmt: skip
    assert (fit.sigma < 1.1 * fit_camera(good, ideal(11), VACUUM).sigma).all()


def test_a_stars_whole_covariance_counts(rng):
    """Trailed stars: x errs ten times more than y, and fx ten times more than fy."""
    true = replace(ideal(11), fx=5100.0, fy=5110.0)
    frames = [with_stars(s, xy=s.stars.xy + np.stack([rng.normal(0, 0.5, 80), np.zeros(80)], -1),
                      covariance_px2=np.diag([0.5**2 + 0.05**2, 0.05**2])[None].repeat(80, 0))
              for s in sightings(true, 10, 80, rng)]  # fmt: skip
    fit = fit_camera(frames, ideal(11), VACUUM, ("fx", "fy"))
    assert fit.scatter_px < 0.03
    assert np.abs(fit.values - values(true))[0] < 4 * fit.sigma[0]
    assert np.abs(fit.values - values(true))[1] < 4 * fit.sigma[1]
    assert fit.sigma[0] > 5 * fit.sigma[1]


def test_only_what_is_free_is_fitted(rng):
    true = random_camera(25, rng)
    fit = fit_camera(sightings(true, 5, 60, rng), ideal(25), VACUUM, ("fx", "fy", "k1"))
    changed = fit.values != values(ideal(25))
    assert [name for name, c in zip(parameters(ideal(11)), changed, strict=True) if c] == ["fx", "fy", "k1"]
    assert (fit.sigma > 0).tolist() == changed.tolist() == fit.determined.tolist()


def bent(frames, air: Atmosphere, strength=1.0, lean=(20.0, 50.0)):
    """The frames seen through air, each some other way and some other angle in deg from the zenith."""
    refraction, out = air.refraction(strength), []
    for k, (s, camera) in enumerate(frames):
        level = rotation.about_axis(2, 2.0 * k) @ rotation.about_axis(
            0, np.radians(lean[0] + (lean[1] - lean[0]) * (k % 4) / 3)
        )
        u = refraction.bend(s.stars.places @ s.attitude.T @ level.T) @ level
        out.append(replace(with_stars(s, xy=camera.project(u)), level=level))
    return out


def clean(camera, frames, stars, rng):
    """Sightings without error, each with its camera."""
    return [(s, camera) for s in sightings(camera, frames, stars, rng, sigma=1e-3)]


def test_refraction_is_undone_where_the_level_is_known(rng):
    true, air = random_camera(11, rng), Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
    seen = bent(clean(true, 8, 60, rng), air)
    fit = fit_camera(seen, ideal(11), air)
    assert np.abs(fit.values - values(true))[:2].max() < 0.02
    assert np.abs(prediction_errors(true, fit.camera)).max() < 2e-3
    without = fit_camera([replace(s, level=None) for s in seen], ideal(11), VACUUM)
    # 3e-4 of the focal length: the test can see it.
    assert np.abs(without.values - values(true))[:2].min() > 1.0


def test_air_that_is_stronger_than_said_is_in_the_sigma(rng):
    """Near the zenith, where it is nothing but scale; further down the stars show how strong it is."""
    true, air = random_camera(11, rng), Atmosphere.measured(None, None)
    stronger = 1 + 2 * air.relative_sigma
    high, low = (
        fit_camera(bent(clean(true, 8, 60, rng), air, stronger, lean), ideal(11), air)
        for lean in ((1.0, 3.0), (20.0, 50.0))
    )
    off = (high.values - values(true))[:2]
    assert (np.abs(off) < 3 * high.sigma[:2]).all()
    assert (np.abs(off) > high.sigma[:2]).all()
    assert (low.sigma < 0.2 * high.sigma)[:2].all()
    assert (np.abs(low.values - values(true)) < 4 * low.sigma)[:2].all()


def test_without_levels_refraction_is_in_the_sigma(rng):
    true, air = random_camera(11, rng), Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
    seen = [replace(s, level=None) for s in bent(clean(true, 8, 60, rng), air)]
    fit = fit_camera(seen, ideal(11), air)
    assert (np.abs(fit.values - values(true)) < 3 * fit.sigma)[:2].all()
    assert 1e-5 < fit.sigma[0] / fit.camera.fx < 2e-4
    untimed = fit_camera([replace(s, timed=False) for s in seen], ideal(11), air)
    assert untimed.sigma[0] > 1.1 * fit.sigma[0]


def test_unbent_is_the_inverse_of_what_the_fit_does(rng):
    air = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
    (s,) = bent(clean(ideal(11), 1, 20, rng), air)
    back = unbent(ideal(11).directions(*s.stars.xy.T), s.level, air)
    # The attitude is 20 arcsec off.
    np.testing.assert_allclose(back, s.stars.places @ s.attitude.T, atol=2e-4)
    assert np.linalg.norm(back, axis=1) == pytest.approx(1)
    smaller = unbent(ideal(11).directions(*s.stars.xy.T), None, air)
    assert np.hypot(*smaller[:, :2].T) == pytest.approx(
        np.hypot(*ideal(11).directions(*s.stars.xy.T)[:, :2].T), rel=1e-3
    )
    assert np.linalg.norm(smaller, axis=1) == pytest.approx(1)


def test_too_few_stars(rng):
    frames = sightings(ideal(11), 1, fewest_stars(parameters(ideal(11))) - 1, rng)
    with pytest.raises(CalibrationError, match="29 identified stars are too few"):
        fit_camera(frames, ideal(11), VACUUM)
    with pytest.raises(CalibrationError, match="0 identified"):
        fit_camera([], ideal(11), VACUUM)


def test_stars_that_agree_on_nothing(rng):
    frames = [
        moved(s, slice(None), rng.uniform(-200, 200, s.stars.xy.shape))
        for s in sightings(ideal(11), 5, 40, rng)
    ]
    with pytest.raises(CalibrationError):
        check_sound(fit_camera(frames, ideal(11), VACUUM), ideal(11))


def test_stars_that_agree_on_too_little(rng):
    frames = [
        moved(s, slice(None), rng.normal(0, 2.5, s.stars.xy.shape)) for s in sightings(ideal(11), 5, 40, rng)
    ]
    with pytest.raises(CalibrationError, match=r"lie 2\.\d px off the best camera"):
        check_sound(fit_camera(frames, ideal(11), VACUUM), ideal(11))


def test_a_camera_of_another_focal_length(rng):
    true = ideal(11).scaled(1.2)
    fit = fit_camera(sightings(true, 5, 60, rng), ideal(11), VACUUM)
    with pytest.raises(CalibrationError, match="too different from the given one"):
        check_sound(fit, ideal(11))


def test_a_distortion_that_folds_in_the_corners_none_has_seen(rng):
    given = ideal(25)
    true = replace(given, distortion=(k1_of(given, -0.45), 0.0, 0.0, 0.0, 0.0))
    frames = []
    for s in sightings(replace(true, width=400, height=280, cx=199.5, cy=139.5), 5, 60, rng):
        frames.append(with_stars(s, xy=s.stars.xy + np.array([300.0, 210.0])))
    fit = fit_camera(frames, given, VACUUM, ("fx", "fy", "k1"))
    with pytest.raises(CalibrationError):
        check_sound(fit, given)


def test_a_camera_that_folds_is_refused_whatever_the_rest(rng):
    fit = fit_camera(sightings(ideal(25), 5, 60, rng), ideal(25), VACUUM)
    folded = replace(fit.camera, distortion=(k1_of(fit.camera, -0.6), 0.0, 0.0, 0.0, 0.0))
    near = replace(fit, camera=folded, prior_sigma=np.full(9, np.inf))
    with pytest.raises(CalibrationError, match="folds inside the frame"):
        check_sound(near, ideal(25))


def test_another_camera_to_begin_with_gives_the_same(rng):
    true = random_camera(25, rng)
    frames = sightings(true, 10, 80, rng)
    a = fit_camera(frames, ideal(25), VACUUM)
    b = fit_camera(
        frames,
        Camera(
            width=1000, height=700, fx=2700.0, fy=2710.0, cx=505.0, cy=345.0, distortion=(0.01, 0, 0, 0, 0)
        ),
        VACUUM,
    )
    assert (np.abs(a.values - b.values) < 0.2 * a.sigma).all()
