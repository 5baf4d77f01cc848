# SPDX-License-Identifier: Apache-2.0
"""The extinction by the identified stars of a night: right within its error, or unknown."""

import numpy as np
import pytest

from starpos.night.watching import Light, air_mass, extinction

EXTINCTION = 0.32


def night(rng, lowest_deg=8.0, lean_deg=6.0, gamma=1.0, blotches=0.05, count=2000):
    """Stars to V = 5.5 on a fisheye that leans, with vignetting, a sensor of its own colours and a sky in blotches."""
    up = rng.uniform(np.sin(np.radians(lowest_deg)), 1, count)
    azimuth, mass = rng.uniform(0, 2 * np.pi, count), air_mass(np.degrees(np.arcsin(up)))
    v = np.log10(rng.uniform(10**2.5, 10**5.5, count))
    across = np.sqrt(1 - up**2)
    lean = np.radians(lean_deg)
    east, north = across * np.sin(azimuth), across * np.cos(azimuth)
    axis = up * np.cos(lean) + east * np.sin(lean)
    ray = np.stack([east * np.cos(lean) - up * np.sin(lean), north], -1)
    theta = np.arccos(np.clip(axis, -1, 1))
    off = ray / np.maximum(np.hypot(*ray.T), 1e-9)[:, None] * theta[:, None]
    dimmed = 0.3 * theta**2 + blotches * rng.normal(0, 1, (16, 16))[tuple(np.floor(off * 4).astype(int).T)]
    measured = gamma * (v + EXTINCTION * mass + dimmed) + rng.normal(0, 0.2, count) - 12
    seen = rng.permutation(count)[: count // 2]
    return [Light(v[part], measured[part], mass[part], off[part]) for part in np.array_split(seen, 4)]


@pytest.mark.parametrize("blotches", [0.0, 0.1])
def test_the_extinction_lies_within_its_error(blotches):
    found = [extinction(night(np.random.default_rng(k), blotches=blotches)) for k in range(40)]
    pulls = [(k - EXTINCTION) / sigma for k, sigma in found if np.isfinite(k)]
    assert len(pulls) > 30 and 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4 and np.abs(pulls).max() < 4.5


def test_dew_that_grows_dims_each_frame_otherwise():
    pulls = []
    for k in range(20):
        frames = night(np.random.default_rng(k), count=6000)
        dewed = [
            Light(*(part[f.v < 5.5 - dim] for part in (f.v, f.measured + dim, f.air_mass, f.off)))
            for f, dim in zip(frames, (0.0, 0.6, 1.2, 2.0), strict=True)
        ]
        found, sigma = extinction(dewed)
        pulls.append((found - EXTINCTION) / sigma)
    assert np.isfinite(pulls).sum() > 15 and np.nanmax(np.abs(pulls)) < 4


def test_where_the_stars_do_not_tell_it_it_is_unknown(rng):
    # without low stars, few stars, brightness that is stretched as pictures have it
    assert np.isnan(extinction(night(rng, lowest_deg=40))).all()
    assert np.isnan(extinction(night(rng, count=100))).all()
    assert np.isnan(extinction(night(rng, gamma=0.45))).all()
