# SPDX-License-Identifier: Apache-2.0
"""The deeper catalogue: kept in the cache, taken by fields that need it, named where it is missing."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.instrument.camera import Camera
from starpos.sky import deeper
from starpos.sky.catalogue import pack, save
from starpos.sky.deeper import stars_on_frame
from starpos_testing.command_line import run

SMALL = Camera.from_focal(1000, 700, 80_000.0)
WIDE = Camera.from_focal(1000, 700, 4_000.0)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "starpos"


@pytest.fixture
def stars(rng):
    """Right ascensions, declinations and magnitudes of an even sky, brightest first."""
    n = 5000
    return (
        rng.uniform(0, 360, n),
        np.degrees(np.arcsin(rng.uniform(-1, 1, n))),
        np.sort(rng.uniform(5, 13, n)),
    )


def packed(stars, number):
    """A catalogue of the brightest."""
    ra, dec, mag = (column[:number] for column in stars)
    none, tyc = np.zeros(len(mag)), np.ones((len(mag), 3), int)
    return pack(tyc, none, mag, ra, dec, none, none, none + 10, none + 1, none + 1990)


def test_a_field_with_too_few_stars_takes_the_deeper_catalogue_once_it_is_kept(stars):
    bright, deep = packed(stars, 3000), packed(stars, 5000)
    assert deeper.for_field(bright, SMALL) is bright and deeper.kept() is None
    deeper.keep(deep)
    deeper.KEPT.forget()
    kept = deeper.kept()
    assert kept.fingerprint == deep.fingerprint
    assert deeper.for_field(bright, SMALL) is kept
    everywhere = Camera.from_focal(1000, 700, 300.0)
    assert deeper.for_field(bright, everywhere) is bright


def test_what_is_broken_in_the_cache_counts_as_not_kept(stars, own_cache):
    deeper.keep(packed(stars, 5000))
    (folder,) = own_cache.glob("stars-*")
    deeper.KEPT.forget()
    np.save(folder / "hip.npy", np.zeros(3, np.int32))
    assert deeper.kept() is None
    deeper.keep(packed(stars, 4000))
    assert len(deeper.kept()) == 4000


def test_a_thin_field_says_what_it_holds_what_it_needs_and_what_to_type(catalogue):
    said = deeper.too_thin(catalogue, SMALL)
    assert "a field of 0.72 x 0.5 deg holds only 8.2 stars of the catalogue (V < 11.0) on average" in said
    assert "needs one to V = 13.0; all of Tycho-2 would be 22" in said
    assert said.endswith("type `starpos catalogue deepen FILE`")
    assert deeper.too_thin(catalogue, WIDE) == ""


def test_a_field_too_small_for_tycho_2_says_so(catalogue, stars):
    deeper.keep(packed(stars, 5000))
    said = deeper.too_thin(catalogue, SMALL)
    assert "deeper than Tycho-2: name one in STARPOS_CATALOGUE" in said and "deepen" not in said


@pytest.mark.parametrize("camera", [SMALL, WIDE, replace(WIDE, fx=800.0, fy=800.0)])
def test_the_mean_number_of_stars_on_a_frame_is_that_of_random_frames(camera, catalogue, rng):
    counts = []
    for _ in range(100 if camera is SMALL else 12):
        attitude, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        index = catalogue.cone(attitude[2], camera.half_diagonal_rad)
        xy = camera.project(catalogue.directions(index) @ attitude.T)
        counts.append(((xy > -0.5).all(1) & (xy < [camera.width - 0.5, camera.height - 0.5]).all(1)).sum())
    mean, sparse = stars_on_frame(camera, catalogue)
    assert mean == pytest.approx(np.mean(counts), rel=0.35)
    assert 0.4 < sparse / mean < 0.55


def test_the_command_line_keeps_it_and_says_that_it_is_there(stars, tmp_path, capsys):
    assert "no deeper catalogue in the cache" in run(capsys, "catalogue", "info")[1]
    save(packed(stars, 5000), tmp_path / "deep.npz")
    status, out, errors = run(capsys, "catalogue", "deepen", tmp_path / "deep.npz")
    assert (status, out, len(errors)) == (0, "", 1) and "small fields take them from now on" in errors[0]
    assert "5000 stars of the deeper catalogue are in the cache" in run(capsys, "catalogue", "info")[1]
    status, _, errors = run(capsys, "catalogue", "deepen", tmp_path / "none.npz")
    assert (status, len(errors)) == (2, 1) and "no catalogue there" in errors[0]
