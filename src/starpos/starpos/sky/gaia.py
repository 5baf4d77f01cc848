# SPDX-License-Identifier: Apache-2.0
"""Puts the places of a Gaia extract onto the catalogue's stars.

The extract is a table as the Gaia archive writes it (docs/how-to/gaia.md).  Stars keep their names and V; those that
the extract does not have, or not without doubt, keep their places of Tycho-2, with the errors of these.
"""

import gzip
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.errors import CatalogueError
from starpos.files import open_regular
from starpos.rotation import unit_vector
from starpos.sky.catalogue import (
    CENTI,
    CODE_STEP,
    EPOCH,
    EPOCH_ZERO,
    SMALLEST_MAS,
    SMALLEST_MAS_YEAR,
    Catalogue,
    pack,
)
from starpos.units import MAS, MAS_DEG

if TYPE_CHECKING:
    from astropy.table import Table

# the columns and their units, as gaiadr3.gaia_source has them
UNITS = {
    "ra": "deg",
    "dec": "deg",
    "ra_error": "mas",
    "dec_error": "mas",
    "pmra": "mas / yr",
    "pmdec": "mas / yr",
    "pmra_error": "mas / yr",
    "pmdec_error": "mas / yr",
    "parallax": "mas",
    "parallax_error": "mas",
    "ref_epoch": "yr",
    "phot_g_mean_mag": "mag",
    "ruwe": "",
}
MAX_BYTES = 4_000_000_000
# A star of Tycho-2 is one of Gaia's within this number of sigma of its place, and this distance besides,
MATCH_SIGMA, MATCH_MAS = 5.0, 200.0
# whose G is V within this: V - G is 0 to 0.5 for most stars and up to 3 for the reddest (Riello et al. 2021, A&A 649, A3)
MATCH_MAG = (-1.0, 3.0)
# Another star of Gaia so near and so bright shifts the photocentre that Tycho-2 and a camera see: such a star stays.
NEIGHBOUR_MAS, NEIGHBOUR_MAG = 5000.0, 4.0
# the catalogue's places are mas, and its motions 0.01 mas/yr: 1 sigma of the rounding, in these units
ROUNDING = 1 / np.sqrt(12)
# an error of the parallax as an error of a coordinate, over a year
PARALLAX_SHARE = 1 / np.sqrt(2)


@dataclass(frozen=True, eq=False, kw_only=True)
class Extract:
    """N stars of Gaia: directions (N, 3) at ref_epoch, and columns (N,) in mas, mas/yr and Julian years."""

    ra_deg: np.ndarray
    dec_deg: np.ndarray
    sigma_mas: np.ndarray
    pm_ra: np.ndarray
    pm_dec: np.ndarray
    sigma_pm: np.ndarray
    parallax_mas: np.ndarray
    sigma_parallax: np.ndarray
    epoch: np.ndarray
    gmag: np.ndarray

    def at(self, year: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Right ascension and declination (N,), deg, at Julian years."""
        years = year - self.epoch
        east = self.pm_ra * years * MAS_DEG / np.cos(np.radians(self.dec_deg))
        return self.ra_deg + east, self.dec_deg + self.pm_dec * years * MAS_DEG


def read(path: Path) -> Extract:
    """Read an extract in CSV, ECSV (each also .gz), FITS or VOTable; CatalogueError says what it lacks.

    Stars without a motion (Gaia's solutions of two parameters) are left out.
    """
    table = _table(path)
    names = {name.lower(): name for name in table.colnames}
    if missing := [name for name in UNITS if name not in names]:
        raise CatalogueError(
            f"{path}: no column {', '.join(missing)}: ask the Gaia archive for it (docs/how-to/gaia.md has the query)"
        )
    column = {name: _column(path, table[names[name]], name, unit) for name, unit in UNITS.items()}
    known = np.all([np.isfinite(c) for c in column.values()], axis=0)
    if not known.any():
        raise CatalogueError(f"{path}: none of its {len(table)} stars has a place, a motion and a parallax")
    c = {name: values[known] for name, values in column.items()}
    # Lindegren et al. 2021, A&A 649, A2
    worse = np.maximum(c["ruwe"], 1.0)
    return Extract(
        ra_deg=c["ra"],
        dec_deg=c["dec"],
        sigma_mas=worse * np.hypot(c["ra_error"], c["dec_error"]) / np.sqrt(2),
        pm_ra=c["pmra"],
        pm_dec=c["pmdec"],
        sigma_pm=worse * np.hypot(c["pmra_error"], c["pmdec_error"]) / np.sqrt(2),
        parallax_mas=np.maximum(c["parallax"], 0.0),
        sigma_parallax=worse * c["parallax_error"],
        epoch=c["ref_epoch"],
        gmag=c["phot_g_mean_mag"],
    )


def _table(path: Path) -> "Table":
    # slow to import
    from astropy.table import Table

    try:
        with open_regular(path) as file:
            start = file.read(16)
            if start[:2] == b"\x1f\x8b":
                file.seek(0)
                with gzip.open(file) as unpacked:
                    start = unpacked.read(16)
            file.seek(0, 2)
            if file.tell() > MAX_BYTES:
                raise CatalogueError(f"{path}: more than {MAX_BYTES / 1e9:g} GB: give an extract")
        kinds = {b"# %ECSV": "ascii.ecsv", b"SIMPLE": "fits", b"<": "votable"}
        kind = next((kind for mark, kind in kinds.items() if start.startswith(mark)), "ascii.csv")
        return Table.read(path, format=kind)
    except CatalogueError:
        raise
    # each of the readers raises kinds of its own
    except Exception as e:
        first = str(e).splitlines()[0] if str(e) else type(e).__name__
        raise CatalogueError(
            f"{path}: no table of the Gaia archive that can be read ({first[:120]}): give CSV, ECSV, FITS or VOTable"
        ) from None


def _column(path: Path, column: "Table.Column", name: str, unit: str) -> np.ndarray:
    """The numbers (N,) of a column in a unit, NaN for empty cells."""
    # slow to import
    from astropy.units import Unit, UnitsError

    try:
        values = np.ma.filled(np.ma.asarray(column).astype(float), np.nan)
        own = getattr(column, "unit", None)
        return values if own is None or not unit else values * Unit(own).to(Unit(unit))
    except (ValueError, TypeError, UnitsError) as e:
        raise CatalogueError(f"{path}: column {name} is no column of numbers in {unit} ({e})") from None


def with_gaia(base: Catalogue, extract: Extract, year: float) -> tuple[Catalogue, int]:
    """Return the catalogue with the extract's places and parallaxes, and how many stars have them.

    Places are exact to 1 mas at a Julian year and for some decades about it: motions are stored to 0.01 mas/yr.
    """
    row, star = _matched(base, extract)
    ra, dec = base.ra_mas * MAS_DEG, base.dec_mas * MAS_DEG
    pm_ra, pm_dec = base.motions()
    parallax = base.parallax_mas()
    sigma, sigma_pm = _errors(base)
    epoch = EPOCH_ZERO + base.epoch_code.astype(float)
    gaia = replace(extract, **{name: column[star] for name, column in vars(extract).items()})
    there_ra, there_dec = gaia.at(year)
    pm_ra[row], pm_dec[row], parallax[row] = gaia.pm_ra, gaia.pm_dec, gaia.parallax_mas
    back = (EPOCH - year) * MAS_DEG
    dec[row] = there_dec + pm_dec[row] * back
    ra[row] = (there_ra + pm_ra[row] * back / np.cos(np.radians(there_dec))) % 360
    moved = gaia.sigma_pm * (year - gaia.epoch)
    sigma[row] = np.sqrt(
        gaia.sigma_mas**2 + moved**2 + ROUNDING**2 + (PARALLAX_SHARE * gaia.sigma_parallax) ** 2
    )
    sigma_pm[row] = np.hypot(gaia.sigma_pm, CENTI * ROUNDING)
    epoch[row] = round(year)
    made = pack(base.tyc, base.hip, base.vmag(), ra, dec, pm_ra, pm_dec, sigma, sigma_pm, epoch, parallax)
    return made, len(row)


def _errors(base: Catalogue) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N,) of the places at their epoch, mas, and of the motions, mas/yr, a little rounded off.

    `pack` rounds up to a code, and these have codes already.
    """
    step = CODE_STEP ** np.array([base.sigma_code, base.pm_sigma_code], float) * (1 - 1e-6)
    return SMALLEST_MAS * step[0], SMALLEST_MAS_YEAR * step[1]


def _matched(base: Catalogue, extract: Extract) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the catalogue, and rows of the extract that are these stars without doubt."""
    # slow to import
    from scipy.spatial import cKDTree

    year = float(np.median(extract.epoch))
    ra, dec = (np.radians(a) for a in extract.at(year))
    tree = cKDTree(unit_vector(ra, dec))
    seen = base.directions(slice(None), year)
    apart, nearest = tree.query(seen, k=2, distance_upper_bound=NEIGHBOUR_MAS * MAS)
    within = apart[:, 0] < base.sigma(slice(None), year) * MATCH_SIGMA + MATCH_MAS * MAS
    row = np.flatnonzero(within)
    gmag = np.append(extract.gmag, np.inf)
    first, second = gmag[nearest[row, 0]], gmag[nearest[row, 1]]
    fainter = base.vmag(row) - first
    sure = (fainter > MATCH_MAG[0]) & (fainter < MATCH_MAG[1]) & (second - first > NEIGHBOUR_MAG)
    row, star = row[sure], nearest[row[sure], 0]
    # two stars of the catalogue are never one of Gaia's
    _, back, number = np.unique(star, return_inverse=True, return_counts=True)
    alone = number[back.ravel()] == 1
    return row[alone], star[alone]
