# SPDX-License-Identifier: Apache-2.0
"""Distances of answers from the true place, in their sigmas; and instruments that differ from the solver's parameters."""

from dataclasses import replace

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.instrument.instrument import Calibration
from starpos.sky.site import Site
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import scene_at, shoot


def misaligned(misalignment_deg=(0.3, -0.2, 0.5), azimuth_deg=40.0):
    """The instrument of the shots with another A3."""
    return replace(
        scene_at(azimuth_deg).instrument, calibration=Calibration(misalignment_deg=misalignment_deg)
    )


def site_at(latitude_deg, longitude_deg) -> Site:
    return Site(latitude_deg, longitude_deg, scene_at().site.atmosphere)


def headings(graph, azimuths, frames=2, **changes):
    """Send shots at each of these azimuths; returns (shot, solution) of each."""
    shots = (shoot(azimuth, **changes) for azimuth in azimuths for _ in range(frames))
    return [(shot, graph.answer(shot)[0]) for shot in shots]


def answer_in(graph, heard: list, shot):
    """Wait for the message in `heard` that has the stamp of a shot."""
    graph.wait(lambda: any(stamp_of(m) == shot.stamp for m in heard), f"for the message of {shot.stamp}")
    return next(m for m in heard if stamp_of(m) == shot.stamp)


def moved_m(site: Site, latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """East, north (2,) in m of a place (deg) from the true one."""
    east = np.radians(longitude_deg - site.longitude_deg) * np.cos(np.radians(site.latitude_deg))
    return np.array([east, np.radians(latitude_deg - site.latitude_deg)]) * EARTH_RADIUS_M


def sigmas(site: Site, latitude_deg: float, longitude_deg: float, covariance) -> float:
    """Distance from the true place in sigma; covariance: row by row, east and north first, m2."""
    size = int(np.sqrt(len(covariance)))
    covariance = np.reshape(covariance, (size, size))[:2, :2]
    moved = moved_m(site, latitude_deg, longitude_deg)
    return float(np.sqrt(moved @ np.linalg.solve(covariance, moved)))


def sigma_m(covariance) -> float:
    """The larger sigma in m of east and north."""
    size = int(np.sqrt(len(covariance)))
    return float(np.sqrt(np.diag(np.reshape(covariance, (size, size)))[:2].max()))
