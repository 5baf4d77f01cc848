# SPDX-License-Identifier: Apache-2.0
"""Frames of which nothing is known, from the command line: an all-sky picture is found, and a search ends in its time."""

import json

import cv2
import numpy as np
import pytest

from starpos_testing.skies.all_sky import AllSky


@pytest.fixture
def picture(catalogue, rng, tmp_path):
    """A file with a picture of the whole sky."""
    sky = AllSky(
        catalogue=catalogue, rng=rng, lens="equisolid", width=1000, height=800, radius_px=380.0, limit_mag=5.0
    )
    cv2.imwrite(str(tmp_path / "sky.png"), sky.horizon().picture().pixels)
    return tmp_path / "sky.png", sky


def test_an_all_sky_picture_needs_no_option(picture, run):
    path, sky = picture
    status, out, err = run("identify", path, "--json")
    assert status == 0, err
    answer = json.loads(out)
    ra, dec = np.radians([answer["ra"], answer["dec"]])
    axis = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    assert np.degrees(np.arccos(min(1.0, axis @ sky.axis))) < 0.5
    assert answer["lens"] == "equidistant" and answer["focal_px"] == pytest.approx(sky.focal_px, rel=0.02)
    assert ", a fisheye" in run("identify", path)[1]


def test_a_search_has_the_time_that_is_given(tmp_path, rng, run):
    lines = ['# {"NAXIS1": 1600, "NAXIS2": 1200}', "x,y,flux"]
    xy = rng.normal([800, 600], [30, 30], (60, 2))
    lines += [f"{x:.3f},{y:.3f},{1000 - k}" for k, (x, y) in enumerate(xy)]
    (tmp_path / "swarm.csv").write_text("\n".join(lines))
    status, _, err = run("identify", tmp_path / "swarm.csv", "--search-time", "0.5")
    assert status == 1 and "in 0.5 s of CPU" in err[-1] and "--search-time" in err[-1]
    assert run("identify", tmp_path / "swarm.csv", "--search-time", "0")[0] == 2
