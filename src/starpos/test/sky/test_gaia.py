# SPDX-License-Identifier: Apache-2.0
"""Gaia's places on the catalogue's stars: from every format of the archive, and only where a star is the same."""

import numpy as np
import pytest
from astropy.table import MaskedColumn, Table

from starpos.cli import main
from starpos.errors import CatalogueError
from starpos.sky import catalogue, gaia
from starpos.sky.catalogue import pack
from starpos.units import MAS

N = 60
# mas a coordinate of Tycho-2's places at 1991, mas/yr of its motions
SIGMA, SIGMA_PM = 30.0, 2.0
FORMATS = {"csv": "ascii.csv", "csv.gz": "ascii.csv", "ecsv": "ascii.ecsv", "fits": "fits", "vot": "votable"}


@pytest.fixture
def truth(rng):
    """A table of stars as Gaia has them, at 2016."""
    table = Table(
        {
            "source_id": rng.integers(1, 2**62, N),
            "ra": rng.uniform(0, 360, N),
            "dec": np.degrees(np.arcsin(rng.uniform(-0.99, 0.99, N))),
            "ra_error": np.full(N, 0.02),
            "dec_error": np.full(N, 0.02),
            "pmra": rng.normal(0, 40, N),
            "pmdec": rng.normal(0, 40, N),
            "pmra_error": np.full(N, 0.03),
            "pmdec_error": np.full(N, 0.03),
            "parallax": np.full(N, 1.0),
            "parallax_error": np.full(N, 0.04),
            "ref_epoch": np.full(N, 2016.0),
            "phot_g_mean_mag": rng.uniform(5, 10, N),
            "ruwe": np.full(N, 1.0),
        }
    )
    for name, unit in gaia.UNITS.items():
        table[name].unit = unit or None
    return table


@pytest.fixture
def base(truth, rng):
    """Return the same stars with Tycho-2's errors; V is G and a bit."""
    pm = np.stack([truth["pmra"], truth["pmdec"]]) + rng.normal(0, SIGMA_PM, (2, N))
    years = 2000 - 2016.0
    # where Tycho-2 saw them in 1991, carried on by its own motions
    off = rng.normal(0, SIGMA, (2, N)) + 9 * rng.normal(0, SIGMA_PM, (2, N))
    east, north = np.stack([truth["pmra"], truth["pmdec"]]) * years + off
    cosine = np.cos(np.radians(truth["dec"]))
    return pack(
        np.stack([np.arange(N), np.ones(N), np.ones(N)], -1), np.arange(N), truth["phot_g_mean_mag"] + 0.2,
        np.asarray(truth["ra"] + east / 3.6e6 / cosine) % 360, np.asarray(truth["dec"] + north / 3.6e6), *pm,
        np.full(N, SIGMA), np.full(N, SIGMA_PM), np.full(N, 1991.0),
    )  # fmt: skip


def written(table, path):
    kind = next(FORMATS[end] for end in sorted(FORMATS, key=len, reverse=True) if path.name.endswith(end))
    table.write(path, format=kind)
    return path


def places(truth, year):
    """Directions (N, 3) of the stars by Gaia's own motion."""
    years = year - 2016.0
    dec = np.radians(truth["dec"] + truth["pmdec"] * years / 3.6e6)
    ra = np.radians(truth["ra"] + truth["pmra"] * years / 3.6e6 / np.cos(np.radians(truth["dec"])))
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)


def off_mas(made, truth, year):
    """How far each star of the catalogue is from where Gaia has it, and their rows."""
    row = np.argsort(made.tyc[:, 0])
    return np.linalg.norm(made.directions(row, year) - places(truth, year), axis=1) / MAS, row


@pytest.mark.parametrize("ending", FORMATS)
def test_places_are_gaias_to_a_milliarcsecond_whatever_the_format(ending, truth, base, tmp_path):
    extract = gaia.read(written(truth, tmp_path / f"extract.{ending}"))
    made, number = gaia.with_gaia(base, extract, 2026.0)
    off, row = off_mas(made, truth, 2026.0)
    assert number == N and off.max() < 1.1 and off_mas(base, truth, 2026.0)[0].mean() > 30
    sigma = made.sigma(row, 2026.0) / MAS
    assert (sigma < 1.5).all() and np.mean(off**2) < 2 * np.mean(sigma**2)
    # the name and the brightness stay
    assert made.vmag(row) == pytest.approx(np.asarray(truth["phot_g_mean_mag"]) + 0.2, abs=0.006)
    # motions are kept to 0.01 mas a year
    assert off_mas(made, truth, 2046.0)[0].max() < 1.4


def test_stars_that_are_not_surely_the_same_keep_their_places_and_errors(truth, base, tmp_path):
    # a companion 3 arcsec away, another brightness, no motion, no star there
    truth["phot_g_mean_mag"][1] = 16.0
    truth["pmra"] = MaskedColumn(truth["pmra"], mask=np.arange(N) == 2)
    with_companion = Table(truth[np.r_[0:N, 0]], masked=True)
    with_companion["dec"][N] += 3 / 3600
    with_companion["phot_g_mean_mag"][N] += 1.0
    lacking = with_companion[np.arange(N + 1) != 3]
    made, number = gaia.with_gaia(base, gaia.read(written(lacking, tmp_path / "x.vot")), 2026.0)
    assert number == N - 4
    row, before = np.argsort(made.tyc[:, 0])[:4], np.argsort(base.tyc[:, 0])[:4]
    assert (made.directions(row) == base.directions(before)).all()
    for column in ("sigma_code", "pm_sigma_code", "epoch_code", "pm_ra", "pm_dec"):
        assert (getattr(made, column)[row] == getattr(base, column)[before]).all()


def test_a_poor_solution_has_larger_errors_and_a_near_star_has_its_parallax(truth, base, tmp_path):
    truth["ruwe"] = np.where(np.arange(N) == 0, 300.0, 1.0)
    truth["parallax"][1:3] = 100.0, -0.3
    path = tmp_path / "x.fits"
    made, _ = gaia.with_gaia(base, gaia.read(written(truth, path)), 2016.0)
    row = np.argsort(made.tyc[:, 0])[:4]
    assert made.sigma(row[:1], 2016.0) / MAS == pytest.approx(300 * 0.02 * np.sqrt(3), rel=0.04)
    assert made.parallax_mas(row) == pytest.approx([1.0, 100.0, 0.0, 1.0])
    assert (made.sigma(row[1:], 2016.0) < 1.5 * MAS).all()
    truth["parallax_error"][2:] = 10.0
    path.unlink()
    made, _ = gaia.with_gaia(base, gaia.read(written(truth, path)), 2016.0)
    sigma = made.sigma(row[1:], 2016.0) / MAS
    assert sigma[0] < 1.5 and sigma[1:] == pytest.approx(10 / np.sqrt(2), rel=0.04)


def test_what_an_extract_lacks_is_a_sentence(truth, tmp_path):
    truth.remove_column("ref_epoch")
    with pytest.raises(CatalogueError, match="no column ref_epoch: ask the Gaia archive"):
        gaia.read(written(truth, tmp_path / "x.csv"))
    (tmp_path / "y.csv").write_bytes(b"\x00\x01\x02 nothing")
    with pytest.raises(CatalogueError, match=r"no column ra|no table of the Gaia archive"):
        gaia.read(tmp_path / "y.csv")


def test_the_command_line_puts_them_into_the_catalogue_that_is_in_use(
    truth, base, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(catalogue, "load_catalogue", lambda path=None: base)
    path, out = written(truth, tmp_path / "x.csv"), tmp_path / "made.npz"
    assert main(["catalogue", "build", "--gaia", str(path), "--year", "2026", "--out", str(out)]) == 0
    assert f"{N} of them with Gaia's places about 2026" in capsys.readouterr().err
    assert off_mas(catalogue.read(out), truth, 2026.0)[0].max() < 1.1
    nowhere = str(tmp_path / "no" / "such" / "folder.npz")
    assert main(["catalogue", "build", "--gaia", str(path), "--out", nowhere]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "folder.npz" in said and "give another --out" in said
