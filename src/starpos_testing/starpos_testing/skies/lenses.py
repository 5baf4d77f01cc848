# SPDX-License-Identifier: Apache-2.0
"""Cameras with lenses, the sky as they see it, and the error of a fitted one, for the tests of calibration."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from starpos import rotation
from starpos.calibration.camera_adjustment import CameraSighting
from starpos.earth.refraction import Atmosphere
from starpos.fix.star_fit import MatchedStars
from starpos.instrument.camera import Camera
from starpos.simulation.scene import Optics, detected, expose, scene_of
from starpos_testing.skies.scenes import EXPOSURE, START

AIR = Atmosphere(pressure_pa=88000.0, temperature_c=12.0, humidity=0.3)
VACUUM = Atmosphere(pressure_pa=0.0, temperature_c=10.0, humidity=0.0)
# field of view in deg: size, focal length, limit of the stars
FIELDS = {3.4: ((5616, 3744), 93750.0, 10.0), 11: ((1024, 768), 5118.0, 8.0), 25: ((1000, 700), 2750.0, 6.8)}
# 1 sigma of what k1, k2, p1, p2, k3 shift the corner by.
CORNER = (0.008, 0.002, 0.001, 0.001, 0.0005)


def ideal(field) -> Camera:
    size, focal_px, _ = FIELDS[field]
    return Camera.from_focal(*size, focal_px)


def k1_of(camera: Camera, corner: float) -> float:
    """The k1 that shifts the corner by this share of half the diagonal."""
    return corner * 4 * camera.fx**2 / (camera.width**2 + camera.height**2)


def random_camera(field, rng) -> Camera:
    """A camera with a lens, 1.5 % off in focal length and 2 % of the frame off centre."""
    c = ideal(field)
    r = np.hypot(c.width, c.height) / 2 / c.fx
    distortion = rng.normal(0, CORNER) / [r**2, r**4, 3 * r, 3 * r, r**6]
    f = c.fx * (1 + rng.uniform(-0.015, 0.015))
    cx, cy = (np.array(c.centre_px) + rng.normal(0, 0.02, 2) * [c.width, c.height]).tolist()
    return Camera(
        width=c.width,
        height=c.height,
        fx=f,
        fy=f * (1 + rng.normal(0, 5e-4)),
        cx=cx,
        cy=cy,
        distortion=tuple(distortion.tolist()),
    )


def sightings(camera, frames, stars, rng, sigma=0.05, level=None) -> list[CameraSighting]:
    """Identified stars all over the frames of a camera in a vacuum, with attitudes 20 arcsec off."""
    made = []
    for _ in range(frames):
        attitude = rotation.from_vector(rng.normal(0, 1, 3))
        xy = rng.uniform(0, [camera.width - 1, camera.height - 1], (stars, 2))
        places = camera.directions(*xy.T) @ attitude
        measured = xy + rng.normal(0, sigma, xy.shape)
        covariance = np.eye(2)[None].repeat(stars, 0) * sigma**2
        off = rotation.from_vector(rng.normal(0, 1e-4, 3)) @ attitude
        made.append(
            CameraSighting(
                stars=MatchedStars(measured, covariance, places, np.full(stars, 1e-10)),
                attitude=off,
                level=level,
                timed=True,
            )
        )
    return made


def night(camera, frames, catalogue, rng, limit_mag, air=AIR, altitude=(60, 89), roll=(-180, 180)):
    """Star lists of a simulated sky, and the rotation (3, 3) of C into L for each."""
    lists, levels = [], []
    base = scene_of(size=(camera.width, camera.height), focal_px=camera.fx, atmosphere=air)
    for k in range(frames):
        scene = replace(
            base, camera=camera, azimuth_deg=rng.uniform(0, 360), altitude_deg=rng.uniform(*altitude),
            roll_deg=rng.uniform(*roll), optics=Optics(limit_mag=limit_mag, fwhm_px=2.2, sky_mag_arcsec2=20.0),
        )  # fmt: skip
        start = START + 60 * k
        exposed = expose(scene, catalogue, start, EXPOSURE, rng)
        lists.append(detected(scene, exposed, start + EXPOSURE / 2, EXPOSURE, rng, f"frame {k}"))
        levels.append(scene.attitude)
    return lists, levels


def values(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def prediction_errors(true: Camera, fitted: Camera, side=21) -> np.ndarray:
    """Errors (N, 2) in px of a fitted camera over the frame, after a fit of attitude and scale."""
    x, y = np.meshgrid(np.linspace(0, true.width - 1, side), np.linspace(0, true.height - 1, side))
    xy = np.stack([x.ravel(), y.ravel()], -1)
    v = true.directions(*xy.T)

    def off(p):
        return (fitted.scaled(1 + p[3]).project(v @ rotation.from_vector(p[:3]).T) - xy).ravel()

    return least_squares(off, np.zeros(4), x_scale=np.full(4, 1e-3)).fun.reshape(-1, 2)
