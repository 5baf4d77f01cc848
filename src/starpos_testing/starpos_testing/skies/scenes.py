# SPDX-License-Identifier: Apache-2.0
"""Simulated exposures of wide fields, whose triangles are quickly built, for the tests of solver and command line."""

from dataclasses import replace

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.simulation.scene import Optics, Scene, detected, expose, read_tilt, scene_of

# 2026-11-02T18:00:00
START = 1793642400.0
EXPOSURE = 0.5
# A diagonal of 15 deg, 44.5 arcsec a pixel.
SIZE, FOCAL_PX = (1000, 700), 4636.0
AIR = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)


def wide_scene(limit_mag=7.5, tilt_noise_deg=0.0035, **more) -> Scene:
    """A 15 deg field of about 200 stars."""
    given = {"size": SIZE, "focal_px": FOCAL_PX, "atmosphere": AIR, "tilt_noise_deg": tilt_noise_deg} | more
    return replace(scene_of(**given), optics=Optics(limit_mag=limit_mag, fwhm_px=2.2, sky_mag_arcsec2=20.0))


def stars_of(scene, catalogue, rng, start=START) -> Stars:
    exposed = expose(scene, catalogue, start, EXPOSURE, rng)
    return detected(scene, exposed, start + EXPOSURE / 2, EXPOSURE, rng)


def tilt_of(scene, rng, start=START) -> Tilt:
    """One reading with its stated error."""
    sigma = max(scene.tilt_errors.noise, np.radians(1e-6))
    return Tilt(*read_tilt(scene, rng), np.eye(2) * sigma**2, utc_unix_s=start + EXPOSURE / 2)


def solver_of(scene, catalogue, **more) -> Solver:
    return Solver(scene.instrument, catalogue, scene.site.atmosphere, **more)


def with_false_stars(stars, xy, flux_factor=10.0) -> Stars:
    """The list with additional stars at xy (N, 2) px, brighter than all others."""
    n = len(xy)
    return replace(
        stars, x=np.r_[xy[:, 0], stars.x], y=np.r_[xy[:, 1], stars.y],
        flux=np.r_[np.linspace(2, 1, n) * flux_factor * max(stars.flux.max(initial=1.0), 1.0), stars.flux],
        snr=np.r_[np.full(n, 1000.0), stars.snr],
        covariance=np.concatenate([np.eye(2)[None].repeat(n, 0) * 0.02**2, stars.covariance]),
        flags=np.r_[np.zeros(n, np.uint8), stars.flags],
    )  # fmt: skip


def random_attitude(rng):
    """A rotation (3, 3), any with the same probability."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.linalg.det(q)


def random_stars(n, rng, width=SIZE[0], height=SIZE[1], mid_unix_s=START) -> Stars:
    """Random points, which are no part of the sky."""
    x, y = rng.uniform(0, width - 1, n), rng.uniform(0, height - 1, n)
    flux = np.sort(rng.exponential(1e4, n))[::-1]
    covariance = np.eye(2)[None].repeat(n, 0) * 0.05**2
    return Stars(
        x=x,
        y=y,
        flux=flux,
        snr=np.full(n, 50.0),
        covariance=covariance,
        flags=np.zeros(n),
        width=width,
        height=height,
        mid_unix_s=mid_unix_s,
        exposure_s=EXPOSURE,
        source="random",
    )
