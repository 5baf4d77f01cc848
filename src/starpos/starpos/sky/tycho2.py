# SPDX-License-Identifier: Apache-2.0
"""Build the compact catalogue from the original Tycho-2 files (CDS I/259), tyc2.dat.* and suppl_1.dat, and fetch them.

Sources: Tycho-2, Hog et al. 2000, A&A 355, L27; byte positions from the catalogue's own ReadMe. The files come from a
mirror of Debian: resumed where the connection broke off, checked before they are used.
"""

import hashlib
import http.client
import lzma
import ssl
import tarfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.errors import LETTERS, CatalogueError
from starpos.files import open_regular, read_regular
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import EPOCH, Catalogue, pack, parallaxes_mas
from starpos.table_cache import cache_folder

# Motions (in right ascension times cos dec) of the fast stars for which Tycho-2 has none: of all faster than this and
# V < 9 (tools/data/fast_stars.py).  Tycho-2 compares the satellite's places with places on old plates: of bright stars,
# which the plates show as blots, and of fast ones, which were not found again, it has only the satellite's place (pflag
# X).  Some of these move by arcminutes until today.  Their motions are from Hipparcos (ESA SP-1200, 1997); many are
# pairs, whose orbits it saw for three years only.
FAST_STARS = Path(__file__).with_name("data") / "fast_stars.csv"
MIN_MAS_YEAR, FAST_SIGMA_MAS_YEAR = 400.0, 10.0
# The archive of Debian's source package tycho2 (2-4), and where a mirror has it.
ARCHIVE = "tycho2_2.orig.tar.xz"
IN_MIRROR = f"pool/main/t/tycho2/{ARCHIVE}"
SHA256, BYTES = "b0d74bd4280e53f7cfc4b37ccb30a1cfbbc30131907dda81c706bbbab5632dfa", 121_142_216
# Debian's mirror network, and its archive of all former packages.
MIRRORS = "https://deb.debian.org/debian", "https://snapshot.debian.org/archive/debian/20250520T000000Z"
# Time after which a silent server is given up.
SILENCE_S = 30.0
CHUNK_BYTES = 1 << 18
FETCH_CURE = (
    "check the network, or give another mirror of Debian or the address of the file "
    "(`starpos catalogue deepen --fetch URL`)"
)


def fetch(mirror: str | None = None, progress: Progress = quiet) -> Path:
    """Fetch the archive of the original files into the cache; the caller removes it once it is used.

    mirror: URL of a Debian mirror, or of the file itself (it ends in .xz); None: Debian's own.
    If the connection breaks off, the received part stays, and the next call goes on from there.  Proxies come from the
    environment (https_proxy).  Raises CatalogueError if no mirror has the file, or if its checksum is another one.
    """
    path = cache_folder() / f"{ARCHIVE}.part"
    addresses = [_address(m) for m in ((mirror,) if mirror else MIRRORS)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file, _alone(file, path):
            _complete(file, addresses, progress)
    except OSError as e:
        raise CatalogueError(
            f"{path}: cannot be written ({e.strerror}): make room, or set XDG_CACHE_HOME"
        ) from None
    return path


def _address(mirror: str) -> str:
    """The address of the archive on a mirror, or the mirror itself where that is a file."""
    if "://" not in mirror:
        raise CatalogueError(
            f"{mirror}: no URL of a mirror: give one that begins with https://, or `starpos catalogue deepen FILE` "
            "for a file that is here"
        )
    return mirror if mirror.endswith(".xz") else f"{mirror.rstrip('/')}/{IN_MIRROR}"


@contextmanager
def _alone(file: BinaryIO, path: Path) -> Iterator[None]:
    """Let one process write the file, if files can be locked; a killed process holds no lock."""
    with suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CatalogueError(f"{path}: another process fetches it: wait for that one") from None
    yield


def _complete(file: BinaryIO, addresses: list[str], progress: Progress) -> None:
    """Append what a file lacks of the archive, from the first address that has it; CatalogueError if none has."""
    reasons = []
    for address in addresses:
        if reason := _append(file, address, progress):
            reasons.append(f"{address}: {reason}")
        elif _is_right(file):
            return
        else:
            _empty(file)
            reasons.append(f"{address}: the checksum is not that of Tycho-2's original files")
    raise CatalogueError(f"{'; '.join(reasons)}: {FETCH_CURE}")


def _append(file: BinaryIO, address: str, progress: Progress) -> str:
    """Append what an address has beyond the end of a file; returns why the file is not whole yet, or ''."""
    have = file.tell()
    if have == BYTES:
        return ""
    request = urllib.request.Request(address, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        # urlopen's opener would keep the proxies of its first call
        with urllib.request.build_opener().open(request, timeout=SILENCE_S) as answer:
            # a server that knows no ranges sends all of it
            if have and answer.status != http.client.PARTIAL_CONTENT:
                _empty(file)
            while chunk := answer.read(CHUNK_BYTES):
                if file.tell() + len(chunk) > BYTES:
                    _empty(file)
                    return f"it has more than {BYTES} bytes"
                file.write(chunk)
                progress(f"fetching {ARCHIVE}", file.tell() / BYTES)
    except urllib.error.HTTPError as e:
        return f"the server answers {e.code} {e.reason}"
    except urllib.error.URLError as e:
        return str(getattr(e.reason, "strerror", None) or e.reason)[:LETTERS]
    except (http.client.HTTPException, ssl.SSLError, TimeoutError, ConnectionError) as e:
        return f"the connection broke off ({str(e)[:LETTERS] or type(e).__name__})"
    if file.tell() < BYTES:
        return f"it ended after {file.tell()} of {BYTES} bytes"
    return ""


def _empty(file: BinaryIO) -> None:
    """Remove the content of a file that is open for writing."""
    file.seek(0)
    file.truncate()


def _is_right(file: BinaryIO) -> bool:
    """Whether a file that is open for writing holds the archive."""
    file.flush()
    with open(file.name, "rb") as written:
        digest = hashlib.sha256()
        while chunk := written.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest() == SHA256


SUPPLEMENT_EPOCH = 1991.25
# 1 sigma of a motion, along one axis, that Tycho-2 does not have. It is the root mean square in Hipparcos of the same
# stars, without the fast ones (63 to 97 from V = 2 to 9; tools/data/fast_stars.py). They move faster than other stars,
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
