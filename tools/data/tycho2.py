# SPDX-License-Identifier: Apache-2.0
"""Build the compact catalogue from the original Tycho-2 files (CDS I/259), tyc2.dat.* and suppl_1.dat.

    python tools/data/tycho2.py [ORIGINALS] [--limit-mag 11] --out tycho2.npz

ORIGINALS is a folder of the files, or the archive of Debian's source package tycho2 (2-4), which `apt-get source
--download-only tycho2` brings; without it the archive is fetched from Debian.  Proxies come from the environment.

Sources: Tycho-2, Hog et al. 2000, A&A 355, L27; byte positions from the catalogue's own ReadMe.
"""

import argparse
import hashlib
import lzma
import sys
import tarfile
import tempfile
import urllib.request
from collections.abc import Iterator
from http.client import HTTPException
from pathlib import Path

import numpy as np

from starpos.cli.console import ProgressBar
from starpos.errors import CatalogueError
from starpos.files import open_regular, read_regular
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import EPOCH, Catalogue, pack, parallaxes_mas, save

# Motions (in right ascension times cos dec) of the fast stars for which Tycho-2 has none: of all faster than this and
# V < 9 (fast_stars.py).  Tycho-2 compares the satellite's places with places on old plates: of bright stars,
# which the plates show as blots, and of fast ones, which were not found again, it has only the satellite's place (pflag
# X).  Some of these move by arcminutes until today.  Their motions are from Hipparcos (ESA SP-1200, 1997); many are
# pairs, whose orbits it saw for three years only.
FAST_STARS = Path(__file__).with_name("fast_stars.csv")
MIN_MAS_YEAR, FAST_SIGMA_MAS_YEAR = 400.0, 10.0
ARCHIVE = "https://deb.debian.org/debian/pool/main/t/tycho2/tycho2_2.orig.tar.xz"
SHA256 = "b0d74bd4280e53f7cfc4b37ccb30a1cfbbc30131907dda81c706bbbab5632dfa"
# Time after which a silent server is given up.
SILENCE_S = 30.0


def fetch(address: str, path: Path) -> Path:
    """Fetch the archive of the original files; CatalogueError if it does not come, or is another file."""
    digest = hashlib.sha256()
    try:
        with urllib.request.urlopen(address, timeout=SILENCE_S) as answer, open(path, "wb") as file:
            while chunk := answer.read(1 << 18):
                file.write(chunk)
                digest.update(chunk)
    except (OSError, HTTPException) as e:
        raise CatalogueError(f"{address}: it does not come ({e}): {CURE}") from None
    if digest.hexdigest() != SHA256:
        raise CatalogueError(f"{address}: the checksum is not that of Tycho-2's original files: {CURE}")
    return path


SUPPLEMENT_EPOCH = 1991.25
# 1 sigma of a motion, along one axis, that Tycho-2 does not have. It is the root mean square in Hipparcos of the same
# stars, without the fast ones (63 to 97 from V = 2 to 9; fast_stars.py). They move faster than other stars,
# because fast stars were not found again on old plates.
UNMEASURED_MAS_YEAR = 100.0
# A record and its newline.
MAIN_BYTES, SUPPLEMENT_BYTES = 207, 123
# Four times the largest of the original files.
MAX_BYTES = 120_000_000
CURE = "give tycho2_2.orig.tar.xz, or a folder with tyc2.dat.00 .. 19 and suppl_1.dat"

# Each column's first byte (from 0) and length, by name.
_MAIN = {
    "tyc1": (0, 4), "tyc2": (5, 5), "tyc3": (11, 1), "pflag": (13, 1), "ra_mean": (15, 12), "dec_mean": (28, 12),
    "pm_ra": (41, 7), "pm_dec": (49, 7), "e_ra": (57, 3), "e_dec": (61, 3), "e_pm_ra": (65, 4), "e_pm_dec": (70, 4),
    "epoch_ra": (75, 7), "epoch_dec": (83, 7), "bt": (110, 6), "vt": (123, 6), "hip": (142, 6),
    "ra": (152, 12), "dec": (165, 12), "since_ra": (178, 4), "since_dec": (183, 4),
    "e_ra_observed": (188, 5), "e_dec_observed": (194, 5),
}  # fmt: skip
_SUPPLEMENT = {
    "tyc1": (0, 4), "tyc2": (5, 5), "tyc3": (11, 1), "flag": (13, 1), "ra": (15, 12), "dec": (28, 12),
    "pm_ra": (41, 7), "pm_dec": (49, 7), "e_ra": (57, 5), "e_dec": (63, 5), "e_pm_ra": (69, 5), "e_pm_dec": (75, 5),
    "bt": (83, 6), "vt": (96, 6), "hip": (115, 6),
}  # fmt: skip


def build(source: Path | str, limit_mag: float, progress: Progress = quiet) -> Catalogue:
    """Build the catalogue of all stars with V < limit_mag from a folder of the originals, or Debian's tycho2_*.tar.xz.

    Every star has its own position error. It has the mean position and motion if Tycho-2 gives them; else (pflag X) the
    observed place, and the motion of FAST_STARS, or an unknown one. A pair with pflag P becomes one star at its
    photocentre. The epoch of supplement 1 is 1991.25. CatalogueError if files are missing or damaged.
    """
    parts, seen = [], 0
    for name, text in originals(Path(source)):
        supplement = name.startswith("suppl")
        table = table_of(name, text)
        parts.append(_supplement_stars(table) if supplement else _main_stars(table))
        parts[-1] = {k: v[parts[-1]["vmag"] < limit_mag + 1] for k, v in parts[-1].items()}
        seen += 1
        progress(name, seen / 21)
    if seen < 21:
        raise CatalogueError(f"{source}: it holds {seen} of the 21 original files of Tycho-2: {CURE}")
    stars = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    stars = _merge_photocentres(stars)
    kept = {k: v[stars["vmag"] < limit_mag] for k, v in stars.items() if k != "photocentre"}
    return pack(**kept, parallax_mas=parallaxes_mas(kept["tyc"]))


def table_of(name: str, text: bytes) -> dict[str, np.ndarray]:
    """Columns of the original file of a name; CatalogueError if its content is not such a table."""
    if name.startswith("suppl"):
        return _read(text, _SUPPLEMENT, SUPPLEMENT_BYTES, name)
    return _read(text, _MAIN, MAIN_BYTES, name)


def originals(source: Path) -> Iterator[tuple[str, bytes]]:
    """Name and content of each original file in a folder or archive."""
    wanted = {f"tyc2.dat.{i:02d}" for i in range(20)} | {"suppl_1.dat"}
    try:
        if source.is_dir():
            for path in sorted(p for p in source.rglob("*") if p.name in wanted):
                yield path.name, read_regular(path, MAX_BYTES)
            return
        with open_regular(source) as packed, tarfile.open(fileobj=packed) as archive:
            for member in archive:
                file = archive.extractfile(member) if member.isfile() else None
                if file is not None and Path(member.name).name in wanted:
                    yield Path(member.name).name, file.read()
    except (OSError, tarfile.TarError, lzma.LZMAError, EOFError) as e:
        # for a file that is not an archive tarfile's message is a table of all its attempts
        reason = f" ({e.strerror})" if isinstance(e, OSError) and e.strerror else ""
        raise CatalogueError(
            f"{source}: not a folder or archive of Tycho-2's original files{reason}: {CURE}"
        ) from None


def _read(text: bytes, columns: dict, record_bytes: int, name: str) -> dict[str, np.ndarray]:
    if not text or len(text) % record_bytes:
        raise CatalogueError(f"{name}: {len(text)} bytes are no whole number of {record_bytes}-byte records")
    layout = np.dtype(
        {
            "names": list(columns),
            "formats": [f"S{length}" for _, length in columns.values()],
            "offsets": [first for first, _ in columns.values()],
            "itemsize": record_bytes,
        }
    )
    rows = np.frombuffer(text, layout)
    try:
        return {c: rows[c] if c in ("pflag", "flag") else _numbers(rows[c]) for c in columns}
    except ValueError as e:
        raise CatalogueError(
            f"{name}: a column of numbers holds something else ({e}): get the file again"
        ) from None


def _numbers(column: np.ndarray) -> np.ndarray:
    stripped = np.char.strip(column)
    return np.where(stripped == b"", b"nan", stripped).astype(float)


def johnson_v(bt: np.ndarray, vt: np.ndarray) -> np.ndarray:
    """Johnson V from Tycho magnitudes, VT - 0.09 (BT - VT); without a colour BT - VT is taken as 0.7."""
    colour = np.where(np.isfinite(bt) & np.isfinite(vt), bt - vt, 0.7)
    return np.where(np.isfinite(vt), vt, bt - colour) - 0.09 * colour


def _motions(t: dict) -> dict[str, np.ndarray]:
    """Proper motions and their errors, mas/yr; a motion that Tycho-2 does not have is taken from FAST_STARS, or 0."""
    measured = np.isfinite(t["pm_ra"])
    motion = np.nan_to_num(np.stack([t["pm_ra"], t["pm_dec"]], -1))
    sigma = np.where(
        measured, np.nan_to_num(np.hypot(t["e_pm_ra"], t["e_pm_dec"])) / np.sqrt(2), UNMEASURED_MAS_YEAR
    )
    fast = {tuple(row[:3]): row[3:] for row in np.loadtxt(FAST_STARS, delimiter=",", skiprows=1).tolist()}
    for k in np.flatnonzero(~measured):
        if (known := fast.get((t["tyc1"][k], t["tyc2"][k], t["tyc3"][k]))) is not None:
            motion[k], sigma[k] = known, FAST_SIGMA_MAS_YEAR
    return {"pm_ra": motion[:, 0], "pm_dec": motion[:, 1], "sigma_pm": sigma}


def _identity(t: dict) -> dict[str, np.ndarray]:
    return {
        "tyc": np.stack([t["tyc1"], t["tyc2"], t["tyc3"]], -1).astype(np.int32),
        "hip": np.nan_to_num(t["hip"]).astype(np.int32),
        "vmag": johnson_v(t["bt"], t["vt"]),
    }


def _main_stars(t: dict) -> dict[str, np.ndarray]:
    mean, motions = np.isfinite(t["ra_mean"]), _motions(t)
    observed = 1990 + t["since_ra"], 1990 + t["since_dec"]
    ra, dec = _at_epoch(t["ra"], t["dec"], motions, *observed)
    return (
        _identity(t)
        | motions
        | {
            "ra_deg": np.where(mean, t["ra_mean"], ra),
            "dec_deg": np.where(mean, t["dec_mean"], dec),
            "sigma_mas": np.where(
                mean, np.hypot(t["e_ra"], t["e_dec"]), np.hypot(t["e_ra_observed"], t["e_dec_observed"])
            )
            / np.sqrt(2),
            "epoch": np.where(mean, t["epoch_ra"] + t["epoch_dec"], sum(observed)) / 2,
            "photocentre": t["pflag"] == b"P",
        }
    )


def _supplement_stars(t: dict) -> dict[str, np.ndarray]:
    motions, epoch = _motions(t), np.full(len(t["ra"]), SUPPLEMENT_EPOCH)
    ra, dec = _at_epoch(t["ra"], t["dec"], motions, epoch, epoch)
    return (
        _identity(t)
        | motions
        | {
            "ra_deg": ra,
            "dec_deg": dec,
            "sigma_mas": np.hypot(t["e_ra"], t["e_dec"]) / np.sqrt(2),
            "epoch": epoch,
            "photocentre": np.zeros(len(epoch), bool),
        }
    )


def _at_epoch(
    ra: np.ndarray, dec: np.ndarray, motions: dict[str, np.ndarray], year_ra: np.ndarray, year_dec: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (deg) at EPOCH of stars observed at ra, dec (deg), each in its own year."""
    east, north = (EPOCH - year_ra) * motions["pm_ra"], (EPOCH - year_dec) * motions["pm_dec"]
    return (ra + east / 3.6e6 / np.cos(np.radians(dec))) % 360, dec + north / 3.6e6


def _merge_photocentres(stars: dict) -> dict[str, np.ndarray]:
    """Keep one row, with the light of both, of each pair with pflag P: its two rows have the same mean place."""
    pair = np.flatnonzero(stars["photocentre"])
    place = np.stack([stars["ra_deg"][pair], stars["dec_deg"][pair]], -1)
    _, first, group = np.unique(place, axis=0, return_index=True, return_inverse=True)
    light = np.bincount(group.ravel(), 10 ** (-0.4 * stars["vmag"][pair]))
    stars["vmag"][pair[first]] = -2.5 * np.log10(light)
    keep = np.ones(len(stars["vmag"]), bool)
    keep[np.setdiff1d(pair, pair[first])] = False
    return {k: v[keep] for k, v in stars.items()}


def main() -> None:
    """Build a catalogue; the program ends with status 2 and one sentence where that cannot be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("originals", nargs="?", type=Path)
    parser.add_argument("--limit-mag", type=float, default=11.0, help="faintest V (11); 20: all of Tycho-2")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            originals = args.originals or fetch(ARCHIVE, Path(folder) / "originals.tar.xz")
            made = build(originals, args.limit_mag, ProgressBar())
            save(made, args.out)
        except (CatalogueError, OSError) as e:
            parser.exit(2, f"tycho2.py: {e}\n")
    print(f"{args.out}: {len(made)} stars to V = {made.vmag().max():.2f}", file=sys.stderr)


if __name__ == "__main__":
    main()
