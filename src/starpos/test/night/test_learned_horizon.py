# SPDX-License-Identifier: Apache-2.0
"""The horizon that a camera learns from where bright stars never are."""

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.night import horizon


def frames(rng, ground, number, hidden=0.05, margin=None):
    """Frames of stars all over the sky, of which those above the ground are seen, but for a hidden share."""
    azimuth, altitude = rng.uniform(0, 360, number), np.degrees(np.arcsin(rng.uniform(0, 1, number)))
    seen = (altitude > ground(azimuth)) & (rng.uniform(0, 1, number) > hidden)
    margin = np.full(number, 20.0) if margin is None else margin
    return np.array_split(np.array([azimuth, altitude, seen, margin]), 5, axis=1)


def trees(azimuth):
    return np.where((azimuth > 90) & (azimuth < 200), 35.0, 12.0)


def test_trees_are_found_and_no_sky_is_called_ground(rng, tmp_path):
    azimuth, altitude = horizon.horizon(frames(rng, trees, 20_000)).T
    inside = np.abs((azimuth - 90 + 180) % 360 - 180) > 15
    inside &= np.abs(azimuth - 200) > 15
    off = (altitude - trees(azimuth))[inside]
    assert np.abs(off).max() < 2.5 and off.mean() < 0.5
    # clouds hide half of the stars
    _, cloudy = horizon.horizon(frames(rng, trees, 20_000, hidden=0.5)).T
    assert np.abs(cloudy - trees(azimuth))[inside].max() < 5
    horizon.write(tmp_path / "h.csv", np.column_stack([azimuth, altitude]))
    read = horizon.read(str(tmp_path / "h.csv"))
    assert np.abs(read[:, 1] - altitude).max() < 0.06


def test_stars_that_the_air_dims_are_no_ground(rng):
    # by 1 mag at 13 deg, with 0.3 mag per air mass: lower ones of this margin may be missed under any sky
    dimmed = frames(rng, lambda azimuth: 12 + 0 * azimuth, 20_000, margin=np.full(20_000, 2.5))
    assert np.nanmax(horizon.horizon(dimmed, 0.3)[:, 1]) < 2
    assert np.nanmax(horizon.horizon(dimmed)[:, 1]) < 2
    assert np.nanmedian(horizon.horizon(dimmed, 0.0)[:, 1]) > 11


def test_where_few_stars_have_passed_the_horizon_is_not_known(rng, tmp_path):
    few = horizon.horizon(frames(rng, trees, 60))
    assert np.isnan(few[:, 1]).any()
    # no star is missed: nothing is called ground
    open_sky = horizon.horizon(frames(rng, lambda azimuth: 0 * azimuth, 5_000, hidden=0.0))
    assert np.nanmax(open_sky[:, 1]) < 1
    for text in ("", "azimuth_deg\n1\n", "azimuth_deg,altitude_deg\n", "azimuth_deg,altitude_deg\n1,nan\n"):
        (tmp_path / "h.csv").write_text(text)
        with pytest.raises(FrameError):
            horizon.read(str(tmp_path / "h.csv"))
