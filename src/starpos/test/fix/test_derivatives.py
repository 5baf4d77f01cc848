# SPDX-License-Identifier: Apache-2.0
"""What the compiled core computes for a fix, beside plain forms of it: derivatives, bent directions, scatter."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.core.observed import observed
from starpos.earth.orientation import station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.fix.fix import _Adjustment
from starpos.fix.outliers import _extra_variance, distance2
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.normal import MEDIAN_OF_CHI2

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
    """An adjustment with stars all over the frame of a camera that leans, and the estimate from which they come."""
    v = camera.directions(*rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (stars, 2)).T)
    # On the axis.
    v[0] = [0.0, 0.0, 1.0]
    g = rotation.about_axis(0, off_zenith_rad)
    air = Atmosphere().refraction()
    a4 = rotation.from_vector(rng.normal(0, 1, 3))
    problem = _Adjustment(camera.project(v), camera, g, air.unbend(v @ g.T) @ a4, air)
    return problem, problem.closed_form()


@pytest.mark.parametrize("off_zenith_deg", [0.0, 25.0, 60.0])
@pytest.mark.parametrize("lens", LENSES)
def test_derivatives_are_central_differences(lens, off_zenith_deg, rng):
    problem, state = problem_of(LENSES[lens], np.radians(off_zenith_deg), rng)
    step, columns = 1e-6, []
    for p in step * np.eye(4):
        ahead, behind = (problem.predict(problem.moved(state, q)) for q in (p, -p))
        columns.append((ahead - behind) / (2 * step))
    slope = problem.jacobian(state)
    np.testing.assert_allclose(slope, np.stack(columns, -1), rtol=2e-5, atol=2e-5 * np.abs(slope).max())


@pytest.mark.parametrize("off_zenith_deg", [0.0, 25.0, 60.0, 88.5])
def test_observed_directions_are_those_of_plain_steps(off_zenith_deg, rng):
    problem, state = problem_of(LENSES["fisheye"], np.radians(off_zenith_deg), rng)
    ground = station_velocity(state.a4[2])
    plain = problem.refraction.bend(rotation.normalised(problem.itrs + ground) @ state.a4.T) @ problem.g
    seen = observed(problem.itrs, state.a4, ground, problem.refraction.compiled, problem.g)
    np.testing.assert_allclose(seen, plain, atol=1e-15)


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_stretches_by_its_derivatives(lens, rng):
    camera, step = replace(LENSES[lens], cx=700.0), 1e-6
    v = camera.directions(*rng.uniform([0, 0], [1399, 999], (50, 2)).T)
    columns = [(camera.project(v + p) - camera.project(v - p)) / (2 * step) for p in step * np.eye(3)]
    slope = camera.slopes(v)
    np.testing.assert_allclose(slope, np.stack(columns, -1), rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def searched(residual, covariance, share, median_of_chi2):
    """The variance of `_extra_variance`, by halving."""

    def excess(extra):
        d2 = distance2(residual, covariance, extra)
        return (np.median(d2) / median_of_chi2 if median_of_chi2 else d2.mean() / 2) - share

    low, high = 0.0, 8 * np.sum(residual**2)
    if excess(0.0) <= 0:
        return 0.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


@pytest.mark.parametrize("median_of_chi2", [0.0, MEDIAN_OF_CHI2])
@pytest.mark.parametrize("stars", [3, 4, 21, 88])
def test_scatter_is_what_halving_finds(stars, median_of_chi2, rng):
    root = rng.normal(0, 0.05, (stars, 2, 2))
    covariance = root @ root.transpose(0, 2, 1) + 1e-4 * np.eye(2)
    for scatter in (0.01, 0.1, 3.0):
        residual = rng.normal(0, scatter, (stars, 2))
        expected = searched(residual, covariance, 0.9, median_of_chi2)
        assert _extra_variance(residual, covariance, 0.9, median_of_chi2) == pytest.approx(expected, rel=2e-3)
