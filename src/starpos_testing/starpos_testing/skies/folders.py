# SPDX-License-Identifier: Apache-2.0
"""Folders of a drive and of a zenith camera's session: lists of the catalogue's stars, with records of the sensors."""

import json
from dataclasses import asdict

import numpy as np

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.frames.frame import Stars
from starpos.frames.tables import write_star_list
from starpos.instrument.camera import Camera
from starpos.sky.site import Site
from starpos.units import ARCSEC, utc_text
from starpos_testing.voyages import INDUSTRIAL

DRIVE_CAMERA = Camera.from_focal(1000, 700, 29670 / 6.4)
EXPOSURE_S, SIGMA_PX = 0.02, 0.1
ZENITH_CAMERA = Camera.from_focal(1000, 700, 4636.0)
LATITUDE, LONGITUDE, HEIGHT_M = 61.2, 24.5, 900.0
# large, so that refraction towards the plumb line, not the ellipsoid's normal, is 7 mas of it
XI, ETA = 30.0, -12.0
ZENITH_BEGIN = 1.75e9
ZENITH_INSTRUMENT = """starpos_instrument: 1
camera: {focal_mm: 29.6704, pixel_um: 6.4}
tilt_noise_deg: 1.0e-5
tilt_quantum_deg: 1.0e-7
tilt_drift_arcsec_per_sqrt_hour: 0.01
tilt_temperature_arcsec_per_c: 0
tilt_scale: 1.0e-4
clock_stddev_s: 1.0e-4
shutter: {readout_s: 0, readout_stddev_s: 0}
"""


def write_drive(folder, catalogue, record):
    """Write a MadeVoyage: stars_NNN.csv, imu.csv, velocity.csv and imu.yaml, in air of 1000 hPa and 5 C."""
    rng = np.random.default_rng(1)
    air = Atmosphere(pressure_pa=100_000.0, temperature_c=5.0)
    for k, t in enumerate(record.frames_s):
        state = earth_state(t)
        site = Site(*np.degrees([record.latitude[k], record.longitude[k]]), air)
        camera_to_enu = site.enu @ record.body_to_itrs[k] @ record.mount
        index = site.overhead(catalogue, state, camera_to_enu[:, 2], DRIVE_CAMERA.half_diagonal_rad, 7.0)
        xy = DRIVE_CAMERA.project(site.observed(catalogue, index, state) @ camera_to_enu)
        xy = (xy + rng.normal(0, SIGMA_PX, xy.shape))[((xy > 0) & (xy < [999, 699])).all(1)]
        stars = Stars(
            x=xy[:, 0],
            y=xy[:, 1],
            flux=np.linspace(1000, 10, len(xy)),
            snr=np.full(len(xy), 50.0),
            covariance=np.tile(np.eye(2) * SIGMA_PX**2, (len(xy), 1, 1)),
            flags=np.zeros(len(xy)),
            width=1000,
            height=700,
            exposure_s=EXPOSURE_S,
        )
        write_star_list(folder / f"stars_{k:03d}.csv", stars, utc_text(t - EXPOSURE_S / 2).rstrip("Z"))
    imu = np.column_stack([record.imu.utc_unix_s, record.imu.gyro, record.imu.force])
    log = np.column_stack([record.velocity.utc_unix_s, record.velocity.velocity, record.velocity.sigma])
    for name, columns, table in (
        ("imu.csv", "utc_unix_s,gx,gy,gz,ax,ay,az", imu),
        ("velocity.csv", "utc_unix_s,vx,vy,vz,sigma", log),
    ):
        np.savetxt(folder / name, table, fmt="%.9f", delimiter=",", header=columns, comments="")
    (folder / "imu.yaml").write_text(
        "".join(f"{name}: {value:.6e}\n" for name, value in asdict(INDUSTRIAL).items())
    )


def write_zenith_session(folder, catalogue):
    """Write four faces of two star lists each, their tilts and the instrument's file; the plumb line leans by XI, ETA."""
    rng = np.random.default_rng(5)
    cosine = np.cos(np.radians(LATITUDE))
    air = Atmosphere(pressure_pa=90_000.0, temperature_c=5.0, humidity=0.3)
    # far from the poles: Phi = phi + xi, Lambda = lambda + eta / cos(phi)
    site = Site(LATITUDE + XI / 3600, LONGITUDE + ETA / 3600 / cosine, air)
    a3 = rotation.about_axis(2, np.radians(95.0)) @ rotation.from_vector([0.003, -0.004, 0.0])
    rows = ["utc_unix_s,theta_x_deg,theta_y_deg"]
    for k in range(8):
        level = rotation.from_vector([*rng.normal(0, 20, 2) * ARCSEC, 0.0])
        sensor = level @ rotation.about_axis(2, np.radians(90.0 * (k // 2) + 3))
        at = ZENITH_BEGIN + 40.0 * k
        # readings in units of 1e-7 deg, with a little noise
        theta = np.degrees(np.arcsin(sensor[:2, 2])) + rng.normal(0, 3e-6, (5, 2))
        rows += [f"{at - 0.2 + 0.1 * j:.3f},{x:.7f},{y:.7f}" for j, (x, y) in enumerate(theta)]
        _zenith_list(folder / f"stars_{k}.csv", catalogue, site, at, a3.T @ sensor)
    (folder / "tilt.csv").write_text("\n".join(rows) + "\n")
    (folder / "instrument.yaml").write_text(ZENITH_INSTRUMENT)


def _zenith_list(path, catalogue, site, at, axes):
    """Write the stars that a camera with these axes (rows, in east, north, up) sees."""
    state = earth_state(at)
    index = site.overhead(catalogue, state, axes[2], ZENITH_CAMERA.half_diagonal_rad, 7.5)
    xy = ZENITH_CAMERA.project(site.observed(catalogue, index, state) @ axes.T)
    on = ((xy > 2) & (xy < [997, 697])).all(1)
    flux = 10 ** (-0.4 * (catalogue.vmag(index) - 14))
    head = {"DATE-OBS": utc_text(at - 0.25).rstrip("Z"), "EXPTIME": 0.5, "NAXIS1": 1000, "NAXIS2": 700}
    stars = np.column_stack([xy, flux, np.full(len(flux), 0.01)])[on]
    text = "\n".join(",".join(f"{v:.5f}" for v in star) for star in stars)
    path.write_text(f"# {json.dumps(head)}\nx,y,flux,sigma\n{text}\n")
