# SPDX-License-Identifier: Apache-2.0
"""The catalogue's build, on records written byte by byte as the ReadMe of CDS I/259 lays them out."""

import hashlib
import importlib
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from tycho2_files import FAINT, main, supplement, write_files

from starpos.errors import CatalogueError
from starpos.sky.catalogue import read
from starpos.units import MAS

TOOLS = Path(__file__).parent.parent / "tools" / "data"
sys.path.insert(0, str(TOOLS))
tycho2 = importlib.import_module("tycho2")
build, johnson_v = tycho2.build, tycho2.johnson_v

STARS = {
    "tyc2.dat.00": main((1, 13, 1), 1.12558209, 2.26739400, (27.7, -0.5), bt="10.488", vt=" 8.670", hip="70")
    # VT never measured.
    + main((1, 14, 1), 1.5, 2.5, bt=" 8.000")
    # BT never measured.
    + main((1, 15, 1), 1.6, 2.5, vt=" 8.000")
    + main((1, 16, 1), pflag="X", vt=" 7.000", bt=" 7.700", observed=(200.0, -30.0))
    + FAINT,
    "tyc2.dat.04": main((3014, 574, 1), pflag="X", vt=" 6.509", bt=" 7.353", observed=(178.23344944, 37.73193528),
        since=("1.88", "1.79")),
    "tyc2.dat.05": main((2682, 3566, 1), 300.87249478, 36.02500143, pflag="P", bt=" 7.201", vt=" 7.088", hip="98753")
    + main((2682, 3566, 2), 300.87249478, 36.02500143, pflag="P", bt=" 7.880", vt=" 7.732", hip="98753"),
    "suppl_1.dat": supplement((5949, 2777, 1), "H", 101.28854105, -16.71314306, (-546.0, -1223.1), vt="-1.088", hip=32349)
    + supplement((2, 580, 1), "T", 3.03708871, 1.57351477, bt=" 8.688", vt=" 8.171"),
}  # fmt: skip


@pytest.fixture
def originals(tmp_path):
    folder = tmp_path / "originals"
    write_files(folder / "data", STARS)
    (folder / "ReadMe").write_text("not a table")
    return folder


@pytest.fixture
def built(originals):
    return build(originals, 11.0)


def star(catalogue, *tyc):
    found = np.flatnonzero((catalogue.tyc == tyc).all(1))
    assert len(found) == 1
    return found


def place(catalogue, index):
    return catalogue.ra_mas[index[0]] / 3.6e6, catalogue.dec_mas[index[0]] / 3.6e6


def test_a_normal_star(built):
    i = star(built, 1, 13, 1)
    assert place(built, i) == pytest.approx((1.12558209, 2.26739400), abs=2e-7)
    # -0.5 rounds to the even.
    assert (built.pm_ra[i], built.pm_dec[i], built.hip[i]) == (28, 0, 70)
    assert built.vmag(i)[0] == pytest.approx(8.670 - 0.09 * (10.488 - 8.670), abs=0.006)
    # sigma: rms of both axes, grown from the mean epoch 1981; stored rounded up
    at_epoch, later = built.sigma(i, 1981.0)[0], built.sigma(i, 2026.0)[0]
    assert at_epoch == pytest.approx(np.hypot(10, 12) / 2**0.5 * MAS, abs=2 * MAS)
    assert later == pytest.approx(np.hypot(at_epoch, 45 * np.hypot(1.5, 2.5) / 2**0.5 * MAS), rel=0.1)


def test_a_missing_magnitude_takes_the_middling_colour(built):
    """BT - VT = 0.7, so V = VT - 0.063."""
    assert built.vmag(star(built, 1, 15, 1))[0] == pytest.approx(8 - 0.063, abs=0.006)
    assert built.vmag(star(built, 1, 14, 1))[0] == pytest.approx(8 - 0.7 - 0.063, abs=0.006)
    assert np.isnan(johnson_v(np.array([np.nan]), np.array([np.nan])))


def test_a_star_without_mean_place_keeps_its_observed_one_with_a_growing_error(built):
    i = star(built, 1, 16, 1)
    assert place(built, i) == pytest.approx((200.0, -30.0), abs=2e-7)
    assert (built.pm_ra[i], built.pm_dec[i]) == (0, 0)
    # the epoch 1991.55 is stored as a whole year
    assert built.sigma(i, 1992.0)[0] == pytest.approx(np.hypot(60, 80) / 2**0.5 * MAS, rel=0.1)
    assert built.sigma(i, 2026.0)[0] == pytest.approx(3400 * MAS, rel=0.05)


def test_a_fast_star_without_mean_place_moves_from_when_it_was_observed(built):
    """Groombridge 1830, as Tycho-2 saw it, in 2000 by Hipparcos: 11 52 58.76809 +37 43 07.2396."""
    i = star(built, 3014, 574, 1)
    there = 15 * (11 + 52 / 60 + 58.76809 / 3600), 37 + 43 / 60 + 7.2396 / 3600
    ra, dec = np.subtract(place(built, i), there) * 3600
    assert abs(ra * np.cos(np.radians(there[1]))) < 0.3
    assert abs(dec) < 0.3
    assert (built.pm_ra[i], built.pm_dec[i]) == pytest.approx((4004, -5813), abs=1)
    assert built.sigma(i, 2026.0)[0] < 500 * MAS


def test_a_pair_with_one_photocentre_is_one_star_with_both_lights(built):
    i = star(built, 2682, 3566, 1)
    a, b = (vt - 0.09 * (bt - vt) for bt, vt in ((7.201, 7.088), (7.880, 7.732)))
    assert built.vmag(i)[0] == pytest.approx(-2.5 * np.log10(10 ** (-0.4 * a) + 10 ** (-0.4 * b)), abs=0.006)
    assert not (built.tyc == (2682, 3566, 2)).all(1).any()


def test_supplement_stars_move_from_1991_25_to_2000(built):
    i = star(built, 5949, 2777, 1)
    # Hipparcos' own place of Sirius at J2000: 6 45 08.9173 -16 42 58.017
    assert place(built, i) == pytest.approx(
        (15 * (6 + 45 / 60 + 8.9173 / 3600), -(16 + 42 / 60 + 58.017 / 3600)), abs=1e-6
    )
    assert built.epoch_code[i] == 91
    assert built.sigma(i, 2026.0)[0] == pytest.approx(np.hypot(5, 34.75 * 1.0) / 2**0.5 * MAS, rel=0.15)


def test_a_supplement_star_without_motion(built):
    i = star(built, 2, 580, 1)
    assert (built.pm_ra[i], built.pm_dec[i]) == (0, 0)
    assert built.sigma(i, 2026.0)[0] > 500 * MAS


def test_the_limit_is_on_v(originals):
    bright = build(originals, 7.5)
    # 1-14-1 has V 7.24, 1-16-1 V 6.94, the pair V 6.60, Groombridge 1830, Sirius
    assert sorted(bright.tyc[:, 1].tolist()) == [14, 16, 574, 2777, 3566]


def test_from_an_archive_with_progress(originals, tmp_path):
    archive = tmp_path / "tycho2_2.orig.tar.xz"
    with tarfile.open(archive, "w:xz") as f:
        f.add(originals, "tycho2-2")
    seen = []
    made = build(archive, 11.0, lambda what, done: seen.append(done))
    assert len(made) == 8
    assert len(seen) == 21
    assert seen[-1] == pytest.approx(1)


@pytest.mark.parametrize(
    "kind",
    ["missing", "incomplete", "short record", "no archive", "truncated archive", "words", "empty file"],
)
def test_bad_originals_give_one_sentence(kind, originals, tmp_path):
    data, source = originals / "data", originals
    if kind == "missing":
        source = tmp_path / "none"
    elif kind == "incomplete":
        (data / "tyc2.dat.07").unlink()
    elif kind == "short record":
        (data / "tyc2.dat.07").write_bytes(FAINT[:-10])
    elif kind == "no archive":
        source = tmp_path / "x.tar.xz"
        source.write_bytes(b"nothing of the kind" * 99)
    elif kind == "truncated archive":
        source = tmp_path / "x.tar.xz"
        with tarfile.open(source, "w:xz") as f:
            f.add(originals, "tycho2-2")
        source.write_bytes(source.read_bytes()[:-500])
    elif kind == "words":
        (data / "tyc2.dat.07").write_bytes(FAINT.replace(b"14.000", b"a word"))
    elif kind == "empty file":
        (data / "tyc2.dat.07").write_bytes(b"")
    with pytest.raises(CatalogueError) as e:
        build(source, 11.0)
    assert "\n" not in str(e.value)


def test_the_command_writes_a_catalogue_or_one_sentence(originals, tmp_path):
    def run(*arguments):
        command = [sys.executable, TOOLS / "tycho2.py", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    made = tmp_path / "made.npz"
    assert "8 stars to V" in run(originals, "--out", made).stderr
    assert len(read(made)) == 8
    done = run(tmp_path / "none", "--out", made)
    assert done.returncode == 2 and "not a folder or archive" in done.stderr.splitlines()[-1]


def test_what_is_fetched_is_checked(tmp_path, monkeypatch):
    there = tmp_path / "archive.tar.xz"
    there.write_bytes(b"stars" * 999)
    with pytest.raises(CatalogueError, match="the checksum is not"):
        tycho2.fetch(there.as_uri(), tmp_path / "here")
    monkeypatch.setattr(tycho2, "SHA256", hashlib.sha256(there.read_bytes()).hexdigest())
    assert tycho2.fetch(there.as_uri(), tmp_path / "here").read_bytes() == there.read_bytes()
    with pytest.raises(CatalogueError, match="does not come"):
        tycho2.fetch((tmp_path / "none").as_uri(), tmp_path / "here")
