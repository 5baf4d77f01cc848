# SPDX-License-Identifier: Apache-2.0
"""The star catalogue: a compact Tycho-2 in declination zones, with directions at any date and their errors.

The committed file holds all stars with V < 11, which the instrument sees in half a second. Stars fainter than V = 9.5
give half of the accuracy of the roll about the optical axis, and so of the position. Zones are sorted by right ascension,
so that the rows of a cell of the sky, 1 deg by 1 deg, follow each other.
"""

import hashlib
import math
import os
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import CatalogueError
from starpos.files import open_regular
from starpos.rotation import normalised
from starpos.table_cache import KeptTables, digest_of, rising
from starpos.units import MAS, MAS_DEG

# Zones of declination.
ZONES = 180
# Cells of right ascension in each zone.
CELLS = 360


def cell_starts(zone_start: np.ndarray, ra_deg: np.ndarray) -> np.ndarray:
    """First row of each cell, and the end (ZONES * CELLS + 1,); zone_start (181,) is the first row of each zone."""
    edges = np.arange(CELLS)
    starts = [first + np.searchsorted(ra_deg[first:last], edges) for first, last in pairwise(zone_start)]
    return np.append(np.concatenate(starts), zone_start[-1]).astype(np.int32)


def rows_near(cell_start: np.ndarray, centre: np.ndarray, radius_rad: float) -> np.ndarray:
    """Rows (M,) in all cells that a cone about the vector centre (3,), of any length, touches."""
    x, y, z = centre.tolist()
    flat = math.hypot(x, y)
    ra, dec = math.degrees(math.atan2(y, x)), math.atan2(z, flat)
    # half the cone's width in right ascension; if a pole is inside, it has all of it
    half = 180.0
    if abs(dec) + radius_rad < math.pi / 2 - 1e-9:
        half = math.degrees(math.asin(min(math.sin(radius_rad) / math.cos(dec), 1.0)))
    low = max(int(math.degrees(dec - radius_rad) + 90), 0)
    high = min(int(math.degrees(dec + radius_rad) + 90), ZONES - 1)
    first = math.floor(ra - half)
    width = min(math.floor(ra + half) - first + 1, CELLS)
    first %= CELLS
    # a run that passes 360 deg continues at 0
    runs = [(first, min(first + width, CELLS))] + (
        [(0, first + width - CELLS)] if first + width > CELLS else []
    )
    runs = [
        (zone * CELLS + begin, zone * CELLS + end) for zone in range(low, high + 1) for begin, end in runs
    ]
    return np.concatenate([np.arange(cell_start[begin], cell_start[end]) for begin, end in runs])


# Parallaxes of the near stars, which Tycho-2 does not have (columns tyc1, tyc2, tyc3, parallax_mas). These are stars of
# Hipparcos (ESA SP-1200, 1997) of at least this, and stars within 8 arcsec of one. tools/data/near_stars.py makes the
# table of Stellarium's list, which has later values for some. Hipparcos' own err by 1 to 3 mas, of some pairs more.
NEAR_MIN_MAS, PARALLAXES = 100.0, Path(__file__).with_name("data") / "near_stars.csv"


def parallaxes_mas(tyc: np.ndarray) -> np.ndarray:
    """Parallaxes (N,) of stars with these Tycho identifiers (N, 3), mas; 0 for those that are not near."""
    number, parallax = _near_stars()
    wanted = _tycho_numbers(tyc)
    row = np.minimum(np.searchsorted(number, wanted), len(number) - 1)
    return np.where(number[row] == wanted, parallax[row], 0.0)


@lru_cache(maxsize=1)
def _near_stars() -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,) of the near stars, rising, and their parallaxes (M,) in mas."""
    rows = np.loadtxt(PARALLAXES, delimiter=",", skiprows=1, ndmin=2)
    number = _tycho_numbers(rows[:, :3])
    order = np.argsort(number)
    return number[order], rows[order, 3]


def _tycho_numbers(tyc: np.ndarray) -> np.ndarray:
    """One number (N,) for each identifier (N, 3)."""
    region, within, component = np.asarray(tyc, np.int64).T
    return (region << 20) + (within << 4) + component


# Julian year of ra and dec.
EPOCH = 2000.0
FORMAT = 3
EPOCH_ZERO = 1900.0
# A stored error is the smallest times CODE_STEP ** code.
SMALLEST_MAS, SMALLEST_MAS_YEAR, CODE_STEP = 1.0, 0.1, 1.03
# Parts of a mas/yr and of a mas in the columns that are finer.
CENTI, TENTH = 0.01, 0.1
COMMITTED = Path(__file__).with_name("data") / "tycho2.npz"

# The columns of one number a star that the compact file holds as they are, and their types.
PLAIN: dict[str, type[np.integer]] = {
    "pm_ra": np.int16,
    "pm_dec": np.int16,
    "vmag_centi": np.int16,
    "sigma_code": np.uint8,
    "pm_sigma_code": np.uint8,
    "epoch_code": np.uint8,
    "pm_ra_centi": np.int8,
    "pm_dec_centi": np.int8,
    "parallax_tenths": np.uint16,
}
Rows = np.ndarray | slice


@dataclass(frozen=True, eq=False, kw_only=True)
class Catalogue:
    """N stars sorted by declination zone, then right ascension; integers as stored, so that loading is quick.

    Attributes
    ----------
    ra_mas, dec_mas : (N,) ICRS at J2000.0, mas
    pm_ra, pm_dec : (N,) mas/yr, pm_ra times cos(dec)
    vmag_centi : (N,) V in 0.01 mag
    sigma_code : (N,) code of the position's error at the mean epoch
    pm_sigma_code : (N,) code of the proper motion's error
    epoch_code : (N,) mean epoch, years after EPOCH_ZERO
    tyc : (N, 3) Tycho identifier
    hip : (N,) Hipparcos number, 0 for none
    zone_start : (181,) first row of each zone of 1 deg of declination, and the end
    pm_ra_centi, pm_dec_centi : (N,) what the motions are more than pm_ra and pm_dec, 0.01 mas/yr
    parallax_tenths : (N,) parallax, 0.1 mas, 0 if unknown

    Examples
    --------
    >>> stars = starpos.load_catalogue()
    >>> magnitudes = stars.vmag(np.arange(len(stars.hip)))
    >>> 40 < sum((magnitudes < 2.0).tolist()) < 60
    True
    """

    ra_mas: np.ndarray
    dec_mas: np.ndarray
    pm_ra: np.ndarray
    pm_dec: np.ndarray
    vmag_centi: np.ndarray
    sigma_code: np.ndarray
    pm_sigma_code: np.ndarray
    epoch_code: np.ndarray
    tyc: np.ndarray
    hip: np.ndarray
    zone_start: np.ndarray
    pm_ra_centi: np.ndarray
    pm_dec_centi: np.ndarray
    parallax_tenths: np.ndarray

    def __repr__(self) -> str:
        return f"<{len(self)} stars of a catalogue>"

    def __len__(self) -> int:
        return len(self.ra_mas)

    @cached_property
    def fingerprint(self) -> str:
        """A digest that is equal for equal stars; tables made from the catalogue are stored under it."""
        digest = hashlib.sha256()
        for column in (self.ra_mas, self.dec_mas, self.vmag_centi):
            digest.update(np.ascontiguousarray(column).data)
        return digest.hexdigest()[:16]

    def check(self) -> None:
        """Raise ValueError for columns of different length or impossible places: the compiled loops trust both."""
        n = len(self)
        columns = (self.dec_mas, self.hip, *(getattr(self, name) for name in PLAIN))
        if (
            any(column.shape != (n,) for column in columns)
            or self.tyc.shape != (n, 3)
            or self.zone_start.shape != (ZONES + 1,)
            or not rising(self.zone_start, n)
        ):
            raise ValueError("its columns do not fit together")
        if n and not (
            self.ra_mas.max() * MAS_DEG < 360 and np.abs(self.dec_mas.astype(float)).max() * MAS_DEG <= 90
        ):
            raise ValueError(
                "some of its places are beyond 360 deg of right ascension or 90 deg of declination"
            )

    @cached_property
    def cell_start(self) -> np.ndarray:
        """First row of each cell, as `cell_starts` returns it."""
        return cell_starts(self.zone_start, self.ra_mas * MAS_DEG)

    def vmag(self, index: Rows = slice(None)) -> np.ndarray:
        """Johnson V magnitudes (n,) of the rows `index`."""
        return self.vmag_centi[index] * 0.01

    def motions(self, index: Rows = slice(None)) -> np.ndarray:
        """Proper motions (2, n) of the rows `index`, mas/yr, that in right ascension times cos(dec)."""
        fine = np.stack([self.pm_ra_centi[index], self.pm_dec_centi[index]]) * CENTI
        return np.stack([self.pm_ra[index], self.pm_dec[index]]) + fine

    def parallax_mas(self, index: Rows = slice(None)) -> np.ndarray:
        """Parallaxes (n,) of the rows `index`, mas; 0 if unknown."""
        return self.parallax_tenths[index] * TENTH

    def directions(
        self, index: Rows, year: float = EPOCH, observer_au: np.ndarray | None = None
    ) -> np.ndarray:
        """ICRS unit vectors (n, 3) of the rows `index` at a Julian year, by linear motion.

        Barycentric ones, or as seen from a barycentric place (3,), au, along ICRS's axes.
        """
        ra, dec = self.ra_mas[index] * MAS, self.dec_mas[index] * MAS
        cr, sr, cd, sd = np.cos(ra), np.sin(ra), np.cos(dec), np.sin(dec)
        v = np.empty((*ra.shape, 3))
        v[..., 0], v[..., 1], v[..., 2] = cd * cr, cd * sr, sd
        if year == EPOCH and observer_au is None:
            return v
        moved = self.motions(index)[..., None] * (year - EPOCH) * MAS
        v += np.stack([-sr, cr, np.zeros_like(sr)], -1) * moved[0]
        v += np.stack([-sd * cr, -sd * sr, cd], -1) * moved[1]
        if observer_au is not None:
            v -= self.parallax_mas(index)[..., None] * MAS * observer_au
        return normalised(v)

    def sigma(self, index: Rows, year: float) -> np.ndarray:
        """Standard deviation (n,) of the places of the rows `index` along one axis at a Julian year, rad."""
        years = year - (EPOCH_ZERO + self.epoch_code[index])
        motion = SMALLEST_MAS_YEAR * CODE_STEP ** self.pm_sigma_code[index].astype(float) * years
        return np.hypot(SMALLEST_MAS * CODE_STEP ** self.sigma_code[index].astype(float), motion) * MAS

    def named(self, index: np.ndarray) -> "NamedStars":
        """The stars of the rows `index` (n,), whose names and V magnitudes are looked up when they are asked for."""
        return NamedStars(len(index), partial(self.labels, index))

    def labels(self, index: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Names ('HIP 1234', or 'TYC 1-2-3' without a Hipparcos number) and V magnitudes (n,) of rows `index` (n,)."""
        numbers = zip(self.hip[index].tolist(), self.tyc[index].tolist(), strict=True)
        names = (f"HIP {hip}" if hip else f"TYC {one}-{two}-{three}" for hip, (one, two, three) in numbers)
        return tuple(names), self.vmag(index)

    def cone(self, centre: np.ndarray, radius_rad: float, limit_mag: float = np.inf) -> np.ndarray:
        """Rows of the stars within radius_rad of the unit vector `centre` (3,) at J2000, brightest first."""
        index = rows_near(self.cell_start, np.asarray(centre), radius_rad)
        if np.isfinite(limit_mag):
            index = index[self.vmag_centi[index] < limit_mag * 100]
        index = index[self.directions(index) @ centre >= np.cos(radius_rad)]
        return index[np.argsort(self.vmag_centi[index], kind="stable")]


class NamedStars:
    """Names and V magnitudes of M stars, which are looked up when they are first asked for, compared or pickled."""

    def __init__(self, number: int, look_up: Callable[[], tuple[tuple[str, ...], np.ndarray]]) -> None:
        self._number, self._look_up = number, look_up

    def __len__(self) -> int:
        return self._number

    @cached_property
    def labels(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names, and V magnitudes (M,)."""
        return self._look_up()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, NamedStars):
            return NotImplemented
        (names, magnitudes), (others, theirs) = self.labels, other.labels
        return names == others and np.array_equal(magnitudes, theirs, equal_nan=True)

    def __hash__(self) -> int:
        return hash(self.labels[0])

    def __reduce__(self) -> tuple[object, ...]:
        return named_stars, self.labels


def named_stars(names: tuple[str, ...], magnitudes: np.ndarray) -> NamedStars:
    """Stars of which names and V magnitudes (M,) are known."""
    return NamedStars(len(names), lambda: (names, magnitudes))


def pack(
    tyc: ArrayLike,
    hip: ArrayLike,
    vmag: ArrayLike,
    ra_deg: ArrayLike,
    dec_deg: ArrayLike,
    pm_ra: ArrayLike,
    pm_dec: ArrayLike,
    sigma_mas: ArrayLike,
    sigma_pm: ArrayLike,
    epoch: ArrayLike,
    parallax_mas: ArrayLike = 0.0,
) -> Catalogue:
    """Make a Catalogue from columns (N,), tyc (N, 3), in deg, mas/yr (pm_ra times cos dec), mas and Julian years.

    Errors are rounded up.
    """
    whole = np.round([pm_ra, pm_dec])
    finer = (np.array([pm_ra, pm_dec]) - whole) / CENTI
    dec_mas = np.round(np.asarray(dec_deg) * 3.6e6).astype(np.int32)
    ra_mas = (np.round(np.asarray(ra_deg) * 3.6e6) % 1_296_000_000).astype(np.uint32)
    zone = np.clip(dec_mas // 3_600_000 + 90, 0, ZONES - 1)
    order = np.lexsort((ra_mas, zone))

    plain = {
        "pm_ra": whole[0],
        "pm_dec": whole[1],
        "pm_ra_centi": finer[0],
        "pm_dec_centi": finer[1],
        "parallax_tenths": np.broadcast_to(np.asarray(parallax_mas) / TENTH, order.shape),
        "vmag_centi": np.asarray(vmag) * 100,
        "sigma_code": _code(sigma_mas, SMALLEST_MAS),
        "pm_sigma_code": _code(sigma_pm, SMALLEST_MAS_YEAR),
        "epoch_code": np.asarray(epoch) - EPOCH_ZERO,
    }

    def column(values: ArrayLike, dtype: type[np.integer]) -> np.ndarray:
        limits = np.iinfo(dtype)
        return np.clip(np.round(np.asarray(values)), limits.min, limits.max).astype(dtype)[order]

    return Catalogue(
        ra_mas=ra_mas[order],
        dec_mas=dec_mas[order],
        **{name: column(values, PLAIN[name]) for name, values in plain.items()},
        tyc=np.asarray(tyc, np.int16)[order],
        hip=np.asarray(hip, np.int32)[order],
        zone_start=np.searchsorted(zone[order], np.arange(ZONES + 1)),
    )


def _code(sigma: ArrayLike, smallest: float) -> np.ndarray:
    """Codes of errors, rounded up."""
    return np.ceil(np.log(np.maximum(np.asarray(sigma, float), smallest) / smallest) / np.log(CODE_STEP))


def save(catalogue: Catalogue, path: Path | str) -> None:
    """Write the compact file. Differences along right ascension and split bytes compress well."""
    c = catalogue
    step = np.diff(c.ra_mas.astype(np.int64), prepend=0).astype(np.uint32)
    within = (c.dec_mas - (np.repeat(np.arange(ZONES), np.diff(c.zone_start)) - 90) * 3_600_000).astype(
        np.uint32
    )
    named = np.flatnonzero(c.hip)
    plain: dict[str, Any] = {name: _split(getattr(c, name)) for name in PLAIN}
    with open(path, "wb") as f:
        np.savez_compressed(
            f,
            format=FORMAT,
            zone_count=np.diff(c.zone_start).astype(np.int32),
            ra_step=_split(step),
            dec_within=_split(within),
            tyc1=_split(np.diff(c.tyc[:, 0], prepend=0).astype(np.int16)),
            tyc2=_split(c.tyc[:, 1]),
            tyc3=c.tyc[:, 2].astype(np.uint8),
            hip_step=_split(np.diff(named, prepend=0).astype(np.uint16)),
            hip=_split(c.hip[named]),
            **plain,
        )


def _split(column: np.ndarray) -> np.ndarray:
    """Byte planes (bytes, N) of a column (N,), whose high bytes repeat, so that they compress well; bytes as they are."""
    if column.itemsize == 1:
        return column
    return np.ascontiguousarray(
        np.ascontiguousarray(column).view(np.uint8).reshape(len(column), column.itemsize).T
    )


def _join(planes: np.ndarray, dtype: type[np.integer]) -> np.ndarray:
    """The column (N,) of byte planes; the inverse of `_split`."""
    return np.ascontiguousarray(np.atleast_2d(planes).T).view(dtype)[:, 0]


def _newer(tyc: np.ndarray) -> dict[str, np.ndarray]:
    """The columns that the committed file lacks, for stars of these identifiers (N, 3)."""
    zeros = np.zeros(len(tyc), np.int8)
    tenths = np.round(parallaxes_mas(tyc) / TENTH).astype(np.uint16)
    return {"pm_ra_centi": zeros, "pm_dec_centi": zeros, "parallax_tenths": tenths}


def read(path: Path | str) -> Catalogue:
    """Read the catalogue from a compact file; CatalogueError if it is missing, broken or of another format."""
    path = Path(path)
    try:
        # numpy leaves a file open that is not in its format
        with open_regular(path) as file, np.load(file, allow_pickle=False) as f:
            if int(f["format"]) != FORMAT:
                raise CatalogueError(
                    f"{path}: format {int(f['format'])}, this program reads {FORMAT}: build it again"
                )
            zone_start = np.concatenate([[0], np.cumsum(f["zone_count"], dtype=np.int64)])
            zone = np.repeat(np.arange(ZONES, dtype=np.int32), f["zone_count"])
            hip = np.zeros(len(zone), np.int32)
            hip[np.cumsum(_join(f["hip_step"], np.uint16), dtype=np.int64)] = _join(f["hip"], np.int32)
            tyc1 = np.cumsum(_join(f["tyc1"], np.int16), dtype=np.int16)
            tyc = np.stack([tyc1, _join(f["tyc2"], np.int16), f["tyc3"].astype(np.int16)], -1)
            plain = _newer(tyc) | {name: _join(f[name], dtype) for name, dtype in PLAIN.items() if name in f}
            found = Catalogue(
                ra_mas=np.cumsum(_join(f["ra_step"], np.uint32), dtype=np.uint32),
                dec_mas=_join(f["dec_within"], np.uint32).astype(np.int32) + (zone - 90) * 3_600_000,
                tyc=tyc,
                hip=hip,
                zone_start=zone_start,
                **plain,
            )
            found.check()
            return found
    except FileNotFoundError:
        raise CatalogueError(f"{path}: no catalogue there: run `starpos catalogue --help`") from None
    except CatalogueError:
        raise
    # a damaged zip file raises many kinds of exception
    except Exception as e:
        raise CatalogueError(
            f"{path}: not a readable catalogue ({e}): restore it or build it again"
        ) from None


def kept_catalogues(what: str = "") -> KeptTables[Catalogue]:
    """Catalogues that are unpacked in the cache; what: as of `KeptTables`."""
    return KeptTables(Catalogue, "stars-1-", "uiiiiuuuiiiiiu", what)


@lru_cache(maxsize=2)
def load_catalogue(path: str | None = None) -> Catalogue:
    """The catalogue at `path`, else the file named by STARPOS_CATALOGUE, else the committed one; each is read once.

    The committed one is kept unpacked in the cache, by its contents, and memory-mapped from there.

    Parameters
    ----------
    path : of a catalogue's file; None: as above

    Returns
    -------
    Catalogue
        shared by all callers

    Raises
    ------
    CatalogueError
        the file is missing or broken

    Examples
    --------
    >>> starpos.load_catalogue() is starpos.load_catalogue()
    True
    """
    if named := path or os.environ.get("STARPOS_CATALOGUE"):
        return read(named)
    try:
        with zipfile.ZipFile(COMMITTED) as packed:
            columns = [(column.filename, column.CRC) for column in packed.infolist()]
        key = (FORMAT, columns, zlib.crc32(PARALLAXES.read_bytes()))
    except (OSError, zipfile.BadZipFile):
        # raises the error of a broken file
        return read(COMMITTED)
    return kept_catalogues().built(digest_of(key), lambda: read(COMMITTED))
