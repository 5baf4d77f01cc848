# SPDX-License-Identifier: Apache-2.0
import os
import pickle
from dataclasses import fields

import numpy as np
import pytest

from starpos.errors import CatalogueError
from starpos.sky import catalogue as module
from starpos.sky.catalogue import Catalogue, load_catalogue, pack, read, save
from starpos.units import ARCSEC, MAS


def unit(ra_deg, dec_deg):
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def sexagesimal(h, m, s, sign, d, arcmin, arcsec):
    return 15 * (h + m / 60 + s / 3600), sign * (d + arcmin / 60 + arcsec / 3600)


def random_catalogue(rng, n):
    dec = np.degrees(np.arcsin(rng.uniform(-1, 1, n)))
    dec[:4] = 90, -90, 0, 89.9999999
    ra = rng.uniform(0, 360, n)
    ra[4:8] = 0, 359.99999999, 180, 1e-9
    return pack(
        rng.integers(1, (9538, 12122, 5), (n, 3)), rng.integers(0, 3, n) * 60000, rng.uniform(-1, 11, n), ra, dec,
        rng.normal(0, 50, n), rng.normal(0, 50, n), rng.uniform(1, 300, n), rng.uniform(0.2, 50, n),
        rng.uniform(1915, 1992, n),
    )  # fmt: skip


def test_a_pipe_is_no_catalogue_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "tycho2.npz")
    with pytest.raises(CatalogueError, match="no regular file"):
        read(tmp_path / "tycho2.npz")


def test_pack_save_read(tmp_path, rng):
    c = random_catalogue(rng, 20000)
    save(c, tmp_path / "c.npz")
    back = read(tmp_path / "c.npz")
    for name in Catalogue.__dataclass_fields__:
        there, here = getattr(back, name), getattr(c, name)
        assert there.dtype == here.dtype or name == "zone_start"
        np.testing.assert_array_equal(there, here, err_msg=name)
    assert back.fingerprint == c.fingerprint != random_catalogue(rng, 20000).fingerprint


def test_pack_keeps_a_milliarcsecond_and_rounds_errors_up():
    c = pack(
        [[1, 2, 3]], [7], [4.567], [123.456789012], [-45.678901234], [-10.4], [7.6], [3.1], [1.01], [1985.4]
    )
    assert np.linalg.norm(c.directions([0])[0] - unit(123.456789012, -45.678901234)) < 0.8 * MAS
    assert (c.vmag([0])[0], c.pm_ra[0], c.pm_dec[0]) == pytest.approx((4.57, -10, 8))
    sigma = c.sigma(np.array([0]), 1985.0)[0]
    assert 3.1 * MAS <= sigma <= 3.1 * 1.031 * MAS
    later = np.hypot(3.1, 1.01 * 10) * MAS
    assert later <= c.sigma(np.array([0]), 1995.0)[0] <= 1.031 * later


@pytest.mark.parametrize("source", ["random", "committed"])
def test_a_cone_is_what_brute_force_finds(source, rng, catalogue):
    c = random_catalogue(rng, 30000) if source == "random" else catalogue
    v = c.directions(slice(None))
    places = [
        unit(0, 90),
        unit(0, -90),
        unit(0, 0),
        unit(359.999, 12),
        unit(0.001, -89),
        unit(180, 45),
        unit(77, 88.5),
    ]
    random = rng.normal(size=(8, 3))
    places += list(random / np.linalg.norm(random, axis=1, keepdims=True))
    for k, centre in enumerate(places):
        for radius in np.radians([0.5, 2.1, 9.0]) if source == "committed" else (0.02, 0.3, 1.4, 2.5):
            limit = np.inf if k % 2 else 8.0
            found = c.cone(centre, radius, limit)
            expected = np.flatnonzero((v @ centre >= np.cos(radius)) & (c.vmag() < limit))
            assert set(found) == set(expected)
            assert np.all(np.diff(c.vmag_centi[found]) >= 0)


def test_an_empty_cone(catalogue):
    assert len(catalogue.cone(unit(10, 10), 1e-7)) == 0


# ICRS, epoch J2000.0, mas/yr (motion in RA with cos dec) as the Hipparcos catalogue has them (via SIMBAD)
HIPPARCOS = {
    "Sirius": (32349, sexagesimal(6, 45, 8.91728, -1, 16, 42, 58.0171), -546.01, -1223.07),
    "Vega": (91262, sexagesimal(18, 36, 56.33635, 1, 38, 47, 1.2802), 200.94, 286.23),
    "Arcturus": (69673, sexagesimal(14, 15, 39.67207, 1, 19, 10, 56.6730), -1093.39, -2000.06),
    "eps Eri": (16537, sexagesimal(3, 32, 55.84496, -1, 9, 27, 29.7312), -975.17, 19.49),
}


@pytest.mark.parametrize("name", HIPPARCOS)
def test_bright_fast_stars_are_where_hipparcos_has_them_in_2026(name, catalogue):
    hip, (ra, dec), pm_ra, pm_dec = HIPPARCOS[name]
    index = np.flatnonzero(catalogue.hip == hip)
    index = index[[np.argmin(catalogue.vmag(index))]]
    years = 26.5
    there = unit(ra + years * pm_ra / 3.6e6 / np.cos(np.radians(dec)), dec + years * pm_dec / 3.6e6)
    error = np.linalg.norm(catalogue.directions(index, 2000 + years)[0] - there)
    assert error < 0.1 * ARCSEC


def test_barnards_star(catalogue):
    """275 arcsec in 26.5 years; Tycho-2's own motion of it is 51 mas/yr short of Hipparcos'."""
    ra, dec = sexagesimal(17, 57, 48.49803, 1, 4, 41, 36.2072)
    index = np.flatnonzero(catalogue.hip == 87937)
    there = unit(ra - 26.5 * 798.58 / 3.6e6, dec + 26.5 * 10328.12 / 3.6e6)
    now = catalogue.directions(index, 2026.5)[0]
    assert np.linalg.norm(now - there) < 2 * ARCSEC
    assert np.linalg.norm(now - catalogue.directions(index)[0]) / ARCSEC == pytest.approx(273, abs=2)


# without a motion in Tycho-2: HIP, place at J2000.0 and motion as above
UNMEASURED = {
    "Groombridge 1830": (57939, sexagesimal(11, 52, 58.76809, 1, 37, 43, 7.2396), 4003.98, -5813.62),
    "tau Ceti": (8102, sexagesimal(1, 44, 4.08338, -1, 15, 56, 14.9262), -1721.05, 854.16),
}


@pytest.mark.parametrize("name", UNMEASURED)
def test_fast_stars_without_a_motion_in_tycho2_are_within_their_error_in_2026(name, catalogue):
    """Groombridge 1830 was 247 arcsec off where 1.1 were claimed."""
    hip, (ra, dec), pm_ra, pm_dec = UNMEASURED[name]
    index, years = np.flatnonzero(catalogue.hip == hip), 26.5
    there = unit(ra + years * pm_ra / 3.6e6 / np.cos(np.radians(dec)), dec + years * pm_dec / 3.6e6)
    error = np.linalg.norm(catalogue.directions(index, 2000 + years)[0] - there)
    sigma = catalogue.sigma(index, 2000 + years)[0]
    assert error < 3 * sigma
    assert sigma < 1.0 * ARCSEC


def test_a_star_whose_motion_nobody_measured_may_be_arcseconds_off(catalogue):
    """1 sigma is 100 mas/yr since 1991: as fast as such stars are, and not as fast as others of their magnitude."""
    sigma = catalogue.sigma(slice(None), 2026.5)
    still = (catalogue.pm_ra == 0) & (catalogue.pm_dec == 0) & (sigma > 1 * ARCSEC)
    assert 13_000 < still.sum() < 14_000
    assert np.all(np.abs(sigma[still] / (35.3 * 0.1 * ARCSEC) - 1) < 0.1)


def test_space_motion_is_linear_and_needs_no_index_array(catalogue):
    index = catalogue.cone(unit(83, -5), 0.05)[:50]
    v0, v1, v2 = (catalogue.directions(index, y) for y in (1980.0, 2000.0, 2020.0))
    np.testing.assert_allclose(v1, (v0 + v2) / 2, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(v2, axis=1), 1, atol=1e-15)
    np.testing.assert_array_equal(catalogue.directions(index.tolist(), 2020), v2)


def test_errors_grow_with_time(catalogue):
    sigma = [
        np.median(catalogue.sigma(slice(None, None, 50), year)) / MAS for year in (1995, 2010, 2026, 2040)
    ]
    assert np.all(np.diff(sigma) > 0)
    # They are stored rounded up.
    assert 43 <= np.median(catalogue.sigma(catalogue.vmag() < 9.5, 2026.0)) / MAS < 52
    assert np.all(catalogue.sigma(slice(None, None, 50), 2026.0) > 0)


def test_bright_stars_come_from_the_supplement(catalogue):
    """43 of the 47 stars with V <= 2 are only in supplement 1, epoch 1991.25.

    Three more here: Algieba, Polaris and Hamal round to 2.00 or blend otherwise; none may be missing.
    """
    bright = catalogue.vmag_centi <= 200
    assert 47 <= bright.sum() <= 50
    epochs = catalogue.epoch_code[bright].astype(int) + 1900
    assert np.sum(epochs == 1991) >= 43
    # Sirius, Canopus, alf Cen A, Arcturus, Vega, Capella, Rigel, Procyon, Achernar, Betelgeuse, Altair, Aldebaran,
    # Antares, Spica, Pollux, Fomalhaut, Deneb, Acrux, Regulus, Castor, Polaris
    named = [32349, 30438, 71683, 69673, 91262, 24608, 24436, 37279, 7588, 27989, 97649, 21421, 80763, 65474, 37826,
             113368, 102098, 60718, 49669, 36850, 11767]  # fmt: skip
    assert set(named) <= set(catalogue.hip[bright].tolist())


def test_names(catalogue):
    sirius = np.flatnonzero(catalogue.hip == 32349)
    unnamed = np.flatnonzero(catalogue.hip == 0)[:1]
    assert catalogue.labels(sirius)[0] == ("HIP 32349",)
    assert catalogue.labels(unnamed)[0][0] == "TYC {}-{}-{}".format(*catalogue.tyc[unnamed[0]])


def test_size_of_the_committed_catalogue(catalogue):
    """130,343 stars with V < 9 in the main table, 130,737 with the supplement, pairs merged."""
    rounded = catalogue.vmag_centi
    assert np.sum(rounded < 900) + np.sum(rounded == 900) / 2 == pytest.approx(130_737, abs=100)
    assert len(catalogue) > 900_000
    assert catalogue.vmag().max() <= 11


@pytest.mark.parametrize(
    "kind",
    [
        "missing",
        "folder",
        "empty",
        "text",
        "truncated",
        "flipped",
        "another npz",
        "format",
        "a short column",
        "beyond 360 deg",
        "beyond the pole",
    ],
)
def test_a_bad_file_gives_one_sentence_with_its_path(kind, tmp_path, rng):
    path = tmp_path / "c.npz"
    save(random_catalogue(rng, 3000), path)
    good = path.read_bytes()
    if kind == "missing":
        path = tmp_path / "none.npz"
    elif kind == "folder":
        path = tmp_path
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("no catalogue\n" * 100)
    elif kind == "truncated":
        path.write_bytes(good[: len(good) // 2])
    elif kind == "flipped":
        path.write_bytes(good[:5000] + bytes(b ^ 255 for b in good[5000:6000]) + good[6000:])
    elif kind == "another npz":
        np.savez(path, stars=np.zeros(3))
    elif kind == "format":
        with np.load(path) as f:
            np.savez(path, **{**f, "format": 99})
    elif kind == "a short column":
        with np.load(path) as f:
            np.savez(path, **{**f, "pm_ra": f["pm_ra"][:, :-1]})
    else:
        # the highest byte of the last step in right ascension, or of the last declination
        column = "ra_step" if kind == "beyond 360 deg" else "dec_within"
        with np.load(path) as f:
            planes = f[column].copy()
            planes[3, -1] = 127
            np.savez(path, **{**f, column: planes})
    with pytest.raises(CatalogueError) as e:
        read(path)
    assert str(path) in str(e.value)
    assert "\n" not in str(e.value)
    assert "build" in str(e.value) or "catalogue --help" in str(e.value)


def test_the_environment_names_another_catalogue(tmp_path, rng, monkeypatch):
    load_catalogue.cache_clear()
    save(random_catalogue(rng, 100), tmp_path / "mine.npz")
    monkeypatch.setenv("STARPOS_CATALOGUE", str(tmp_path / "mine.npz"))
    assert len(load_catalogue()) == 100
    load_catalogue.cache_clear()


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """An empty cache, of which nothing is remembered."""
    monkeypatch.delenv("STARPOS_CATALOGUE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    load_catalogue.cache_clear()
    yield tmp_path / "starpos"
    load_catalogue.cache_clear()


def test_the_committed_catalogue_is_unpacked_once_then_mapped(own_cache, monkeypatch):
    packed = load_catalogue()
    load_catalogue.cache_clear()
    monkeypatch.setattr(module, "read", lambda path: pytest.fail("unpacked again"))
    kept = load_catalogue()
    for column in fields(Catalogue):
        np.testing.assert_array_equal(getattr(kept, column.name), getattr(packed, column.name))
    assert kept.fingerprint == packed.fingerprint


@pytest.mark.parametrize("column", ["ra_mas", "zone_start", "hip"])
def test_a_broken_copy_of_the_catalogue_is_made_anew(column, own_cache):
    good = load_catalogue().fingerprint
    (folder,) = own_cache.iterdir()
    path = folder / f"{column}.npy"
    values = np.load(path)
    path.unlink()
    np.save(path, values[:-1] if column == "hip" else np.full_like(values, 2**31))
    load_catalogue.cache_clear()
    assert load_catalogue().fingerprint == good


def test_a_newer_catalogue_is_another_copy(own_cache, tmp_path, monkeypatch, rng):
    load_catalogue()
    save(random_catalogue(rng, 100), tmp_path / "newer.npz")
    monkeypatch.setattr(module, "COMMITTED", tmp_path / "newer.npz")
    load_catalogue.cache_clear()
    assert len(load_catalogue()) == 100


def test_a_cache_that_cannot_be_written_costs_a_little_time_and_says_nothing(own_cache, recwarn):
    own_cache.touch()
    assert len(load_catalogue()) > 0
    assert not recwarn.list


def test_it_is_read_once(monkeypatch):
    load_catalogue.cache_clear()
    once = load_catalogue()
    monkeypatch.setattr(module, "read", lambda path: pytest.fail("read again"))
    assert load_catalogue() is once


def test_named_stars_are_looked_up_late_and_sent_without_their_catalogue(catalogue):
    index = np.argsort(catalogue.vmag_centi)[:5]
    named = catalogue.named(index)
    assert len(named) == 5 and "labels" not in vars(named)
    sent = pickle.dumps(named)
    assert len(sent) < 1000 and pickle.loads(sent) == named
    some = catalogue.named(index[[3, 1]])
    assert some != named and some == catalogue.named(index[[3, 1]])
