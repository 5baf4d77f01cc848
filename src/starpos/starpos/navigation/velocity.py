# SPDX-License-Identifier: Apache-2.0
"""Velocities over ground that the vehicle measures itself: wheel odometry, a ship's log, airspeed without wind."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starpos.errors import VoyageError
from starpos.navigation.table import read_record

COLUMNS = ("vx", "vy", "vz", "sigma")
# below it a stated error is a mistake; above it nothing is measured
MIN_SIGMA, MAX_SIGMA = 1e-6, 1000.0
# In m/s.
FASTEST = 1000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class VelocityLog:
    """N velocities (N, 3) in m/s along the body's axes, their 1 sigma an axis (N,), at times (N,) in order."""

    utc_unix_s: np.ndarray
    velocity: np.ndarray
    sigma: np.ndarray
    faults: tuple[str, ...] = ()


def read_velocity(path: Path | str) -> VelocityLog:
    """Read a CSV of utc_unix_s, vx, vy, vz, sigma (m/s); VoyageError says why one cannot be used."""
    record = read_record(path, COLUMNS, "velocities")
    velocity, sigma = record.values[:, :3], record.values[:, 3]
    if not ((sigma >= MIN_SIGMA) & (sigma <= MAX_SIGMA)).all():
        raise VoyageError(
            f"{path}: a sigma is not between {MIN_SIGMA:g} and {MAX_SIGMA:g} m/s: state 1 sigma of an axis"
        )
    if np.abs(velocity).max() > FASTEST:
        raise VoyageError(f"{path}: a velocity is beyond {FASTEST:g} m/s: give m/s along the body's axes")
    return VelocityLog(utc_unix_s=record.utc_unix_s, velocity=velocity, sigma=sigma, faults=record.faults)
