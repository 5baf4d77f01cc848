# SPDX-License-Identifier: Apache-2.0
"""Results of compiled code for a fix, against plain forms: derivatives, directions, scatter, roots."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import station_velocity
from starpos.earth.refraction import MIN_COS_ZENITH, Atmosphere
from starpos.fix._adjustment import gain_of, spread
from starpos.fix._scatter import distances2
from starpos.fix.star_fit import (
    OUTLIER_SIGMA,
    adjustment_of,
    expected_extra,
    fitted,
    judged,
)
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.units import MEDIAN_OF_CHI2

LENSES = {
    "pinhole": Camera.from_focal(1400, 1000, 1800.0),
    "distorted": Camera(
        width=1400, height=1000, fx=1800.0, fy=1790.0, cx=690, cy=510, distortion=(-0.28, 0.11, 1e-3, -8e-4, 0.0)
    ),
    "fisheye": Camera(
        model=EQUIDISTANT,
        width=1400, height=1000, fx=400.0, fy=401.0, cx=690, cy=510, distortion=(0.02, -0.01, 2e-3, 0.0)
    ),
}  # fmt: skip


def problem_of(camera, off_zenith_rad, rng, stars=40):
    """An adjustment with stars all over the frame of a camera that leans, A4, and their directions in L.

    The ground does not move.
    """
    v = camera.directions(*rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (stars, 2)).T)
    # On the axis.
    v[0] = [0.0, 0.0, 1.0]
    g = rotation.about_axis(0, off_zenith_rad)
    air = Atmosphere().refraction()
    a4 = rotation.from_vector(rng.normal(0, 1, 3))
    local = air.unbend(v @ g.T)
    return adjustment_of(camera.project(v), camera, g, local @ a4, air), a4, local


def bent(v):
    """Unrefracted directions (N, 3) in L as they are observed, by ERFA's formula (eraAtioq) in plain steps."""
    air = Atmosphere().refraction()
    tan = np.hypot(v[:, 0], v[:, 1]) / np.maximum(v[:, 2], MIN_COS_ZENITH)
    w = air.b * tan**2
    angle = (air.a + w) * tan / (1 + (air.a + 3 * w) / np.maximum(v[:, 2], MIN_COS_ZENITH) ** 2)
    axis = np.cross(v, [0.0, 0.0, 1.0])
    turns = angle[:, None] * axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-12)[:, None]
    return np.array([rotation.from_vector(t) @ u for t, u in zip(turns, v, strict=True)])


def moved(a4, scale, p):
    return rotation.from_vector(p[:3]) @ a4, scale * (1 + p[3])


@pytest.mark.parametrize("off_zenith_deg", [0.0, 25.0, 60.0])
@pytest.mark.parametrize("lens", LENSES)
def test_derivatives_are_central_differences(lens, off_zenith_deg, rng):
    problem, a4, _ = problem_of(LENSES[lens], np.radians(off_zenith_deg), rng)
    step, columns = 1e-6, []
    for p in step * np.eye(4):
        ahead, behind = (problem.predict(*moved(a4, 1.01, q)) for q in (p, -p))
        columns.append((ahead - behind) / (2 * step))
    slope = problem.jacobian(a4, 1.01)
    np.testing.assert_allclose(slope, np.stack(columns, -1), rtol=2e-5, atol=2e-5 * np.abs(slope).max())


@pytest.mark.parametrize("off_zenith_deg", [0.0, 25.0, 60.0, 88.5])
@pytest.mark.parametrize("lens", LENSES)
def test_predicted_places_are_those_of_plain_steps(lens, off_zenith_deg, rng):
    camera = LENSES[lens]
    problem, a4, _ = problem_of(camera, np.radians(off_zenith_deg), rng)
    seen = bent(rotation.normalised(problem.itrs + station_velocity(a4[2])) @ a4.T) @ problem.g
    centre = np.array([camera.cx, camera.cy])
    plain = centre + 1.02 * (camera.project(seen) - centre)
    np.testing.assert_allclose(problem.predict(a4, 1.02), plain, atol=1e-9)


def test_directions_are_bent_and_unbent_as_in_plain_steps(rng):
    """Down to the horizon and below it, where the model has no more meaning but has to stay finite."""
    v = rotation.normalised(rng.normal(size=(300, 3)))
    air = Atmosphere().refraction()
    np.testing.assert_allclose(air.bend(v), bent(v), atol=1e-15)
    high = v[v[:, 2] > 0.5]
    np.testing.assert_allclose(air.unbend(air.bend(high)), high, atol=2e-9)
    stack = v.reshape(3, 100, 3)
    np.testing.assert_array_equal(air.bend(stack), air.bend(v).reshape(stack.shape))


@pytest.mark.parametrize("lens", LENSES)
def test_a_fit_is_the_least_squares_solution_and_leaves_a_wrong_star_out(lens, rng):
    problem, _, local = problem_of(LENSES[lens], 0.3, rng)
    xy = problem.xy + rng.normal(0, 0.1, problem.xy.shape)
    xy[7] += [30.0, -20.0]
    noisy = adjustment_of(xy, LENSES[lens], problem.g, problem.itrs, Atmosphere().refraction())
    stated = np.tile(np.diag([0.01, 0.02]), (len(xy), 1, 1))
    fit = fitted(noisy, local, stated)
    assert np.flatnonzero(~fit.keep).tolist() == [7]
    np.testing.assert_allclose(fit.residual, noisy.predict(fit.a4, fit.scale) - xy, atol=1e-6)

    def errors(p):
        off = (noisy.predict(*moved(fit.a4, fit.scale, p * 1e-3)) - xy)[fit.keep]
        return (off / np.sqrt(np.array([0.01, 0.02]) + fit.jitter2)).ravel()

    best = least_squares(errors, np.zeros(4), xtol=1e-14, ftol=1e-15, gtol=1e-14).x * 1e-3
    assert np.abs(best).max() < 1e-8


def test_gain_and_spread_are_those_of_a_linear_fit(rng):
    slope, root = rng.normal(size=(9, 2, 4)) * [1e5, 1e5, 1e3, 1e2], rng.normal(0, 0.1, (9, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 1e-3 * np.eye(2)
    rows, weight = slope.reshape(-1, 4), np.zeros((18, 18))
    for k in range(9):
        weight[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.linalg.inv(covariance[k])
    expected = np.linalg.solve(rows.T @ weight @ rows, rows.T @ weight)[:3]
    gain = gain_of(slope, covariance)
    np.testing.assert_allclose(gain.reshape(3, 18), expected, rtol=1e-8, atol=1e-12 * np.abs(expected).max())
    own = np.linalg.inv(rows.T @ weight @ rows)[:3, :3]
    np.testing.assert_allclose(spread(gain, covariance), own, rtol=1e-7, atol=1e-12 * np.abs(own).max())


def test_what_stars_do_not_tell_apart_has_no_gain():
    assert np.isnan(gain_of(np.zeros((4, 2, 4)), np.tile(np.eye(2), (4, 1, 1)))).all()


@pytest.mark.parametrize("size", [1, 2, 3, 5, 9])
def test_a_root_is_symmetric_and_its_square_is_the_covariance(size, rng):
    for rank in range(size + 1):
        half = rng.normal(size=(size, rank)) * 10.0 ** rng.uniform(-6, 3, rank)
        covariance = half @ half.T
        root = symmetric_root(covariance)
        np.testing.assert_array_equal(root, root.T)
        np.testing.assert_allclose(
            root @ root, covariance, atol=1e-14 * max(np.abs(covariance).max(), 1e-300)
        )
        assert np.linalg.eigvalsh(root).min() >= -1e-7 * np.abs(root).max()
    assert np.isnan(symmetric_root(np.full((size, size), np.nan))).all()


def searched(residual, covariance, share, median_of_chi2):
    """The extra variance of residuals, by plain halving."""

    def excess(extra):
        d2 = distances2(residual, covariance + extra * np.eye(2))
        return (np.median(d2) / median_of_chi2 if median_of_chi2 else d2.mean() / 2) - share

    low, high = 0.0, 8 * np.sum(residual**2)
    if excess(0.0) <= 0:
        return 0.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


@pytest.mark.parametrize("stars", [3, 4, 21, 88])
def test_scatter_is_what_halving_finds(stars, rng):
    """The mean makes the claim, the median the gate, which a star just within it passes."""
    root = rng.normal(0, 0.05, (stars, 2, 2))
    covariance, every = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(2), np.ones(stars, bool)
    for scatter in (0.01, 0.1, 3.0):
        residual = rng.normal(0, scatter, (stars, 2))
        expected = searched(residual, covariance, 0.9, 0.0)
        assert judged(residual, covariance, every, 0.9)[0] == pytest.approx(expected, rel=1e-3)
        # of any size far out: the median stays
        residual[0] = [1e3, 0.0]
        typical = searched(residual, covariance, 0.9, MEDIAN_OF_CHI2)
        unit2 = distances2(np.array([[1.0, 0.0]]), covariance[:1] + typical * np.eye(2))[0]
        for within in (0.998, 1.002):
            residual[0, 0] = within * OUTLIER_SIGMA / np.sqrt(unit2)
            assert judged(residual, covariance, every, 0.9)[1][0] == (within < 1)


def test_stars_are_judged_by_those_that_are_kept(rng):
    residual, covariance = rng.normal(0, 0.1, (30, 2)), np.tile(1e-4 * np.eye(2), (30, 1, 1))
    residual[3], keep = [9.0, 9.0], np.arange(30) != 3
    extra, good = judged(residual, covariance, keep, 0.9)
    alone, _ = judged(residual[keep], covariance[keep], np.ones(29, bool), 0.9)
    assert extra == alone and extra == pytest.approx(0.01, rel=0.5)
    assert np.flatnonzero(~good).tolist() == [3]
    # one that is wrong, and still counts, widens the scatter but not the gate
    extra, good = judged(residual, covariance, np.ones(30, bool), 0.9)
    assert extra > 1.0 and np.flatnonzero(~good).tolist() == [3]


@pytest.mark.parametrize("stars", [3, 21, 88])
def test_the_expected_scatter_is_the_mean_of_its_posterior(stars, rng):
    root = rng.normal(0, 0.05, (stars, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 1e-3 * np.eye(2)
    for scatter in (0.01, 0.1, 3.0):
        residual = rng.normal(0, scatter, (stars, 2))
        stated = np.median(np.trace(covariance, axis1=1, axis2=2)) / 2
        extra = np.geomspace(1e-3 * stated, 1e2 * max(stated, np.sum(residual**2)), 4000)
        whole = covariance + extra[:, None, None, None] * np.eye(2)
        d2 = np.einsum("ki,gkij,kj->gk", residual, np.linalg.inv(whole), residual)
        log_density = -0.5 * (d2 + 0.9 * np.log(np.linalg.det(whole))).sum(1) + np.log(
            extra / (stated + extra)
        )
        density = np.exp(log_density - log_density.max())
        expected = density @ extra / density.sum()
        assert expected_extra(residual, covariance, 0.9) == pytest.approx(expected, rel=2e-2)


@pytest.mark.parametrize("scale", [1e-22, 1e-6, 1e6, 1e40])
def test_the_expected_scatter_has_the_unit_of_its_errors(scale, rng):
    """Products of determinants must not run over, however small or large the unit is."""
    residual, covariance = rng.normal(0, 0.1, (30, 2)), np.tile(1e-3 * np.eye(2), (30, 1, 1))
    plain = expected_extra(residual, covariance, 0.9)
    assert expected_extra(residual * scale, covariance * scale**2, 0.9) == pytest.approx(plain * scale**2)


def test_it_does_not_matter_how_arrays_lie_in_memory(rng):
    residual, covariance, keep = (
        rng.normal(0, 0.1, (30, 2)),
        np.tile(1e-3 * np.eye(2), (30, 1, 1)),
        np.arange(30) > 2,
    )
    extra, good = judged(residual, covariance, keep, 0.9)
    other, same = judged(np.asfortranarray(residual), np.asfortranarray(covariance), keep.astype(int), 0.9)
    assert other == extra and np.array_equal(same, good)
    assert expected_extra(np.asfortranarray(residual), np.asfortranarray(covariance), 0.9) == expected_extra(
        residual, covariance, 0.9
    )


def test_arrays_that_do_not_fit_to_each_other_are_refused(rng):
    problem, a4, local = problem_of(LENSES["pinhole"], 0.3, rng, stars=8)
    slope, covariance = problem.jacobian(a4, 1.0), np.tile(np.eye(2), (8, 1, 1))
    keep = np.ones(8, np.uint8)
    for call in (
        lambda: adjustment_of(
            problem.xy, LENSES["pinhole"], problem.g, problem.itrs[1:], Atmosphere().refraction()
        ),
        lambda: problem.closed_form(local[1:]),
        lambda: problem.predict(np.eye(2), 1.0),
        lambda: problem.refine(a4, 1.0, slope, covariance[1:], keep, 1e-11, 20),
        lambda: problem.refine(a4, 1.0, slope, covariance, keep[1:], 1e-11, 20),
        lambda: gain_of(slope, covariance[1:]),
        lambda: spread(gain_of(slope, covariance), covariance[:1]),
        lambda: judged(problem.xy, covariance[1:], keep, 0.9),
        lambda: distances2(problem.xy, covariance[1:]),
        lambda: expected_extra(problem.xy[:, :1], covariance, 0.9),
        lambda: symmetric_root(np.ones((2, 3))),
    ):
        with pytest.raises(ValueError):
            call()
