# SPDX-License-Identifier: Apache-2.0
"""`starpos catalogue`: shows the star catalogue, puts Gaia's places in, keeps a deeper one."""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from starpos.cli import overwriting
from starpos.errors import CatalogueError
from starpos.sky import catalogue, deeper
from starpos.table_cache import cache_folder


def run_info(args: argparse.Namespace) -> int:
    """Print the stars, magnitudes and errors of a catalogue."""
    c = catalogue.load_catalogue(args.path)
    v = c.vmag()
    sigma_mas = c.sigma(slice(None), args.year) / catalogue.MAS
    print(
        f"{len(c)} stars of Tycho-2, V {v.min():.2f} to {v.max():.2f}, {np.count_nonzero(c.hip)} with a HIP number"
    )
    print("   V up to     stars   median error of a place in", args.year)
    for limit in (2, 4, 6, 7, 8, 9, 9.5, 10, 10.5, 11, 12, 13):
        if limit > v.max() + 1:
            break
        inside = v < limit
        print(f"   {limit:7.1f} {inside.sum():9d}   {np.median(sigma_mas[inside]):6.0f} mas")
    if args.path is None:
        more = deeper.kept()
        print(
            "no deeper catalogue in the cache: small fields need one (`starpos catalogue deepen FILE`)"
            if more is None
            else f"{len(more)} stars of the deeper catalogue are in the cache, for small fields"
        )
    print("Tycho-2: Hog et al. 2000, A&A 355, L27; distributed by Debian under the 2-clause BSD licence")
    return 0


def run_build(args: argparse.Namespace) -> int:
    """Put the places of a Gaia extract into the catalogue in use; raises CatalogueError."""
    from starpos.sky import gaia

    overwriting.check(args, out=overwriting.stars)
    year = float(time.gmtime().tm_year) if args.year is None else args.year
    made, number = gaia.with_gaia(catalogue.load_catalogue(), gaia.read(Path(args.gaia)), year)
    try:
        catalogue.save(made, args.out)
    except OSError as e:
        raise CatalogueError(f"{args.out}: cannot be written ({e.strerror}): give another --out") from None
    size = Path(args.out).stat().st_size / 1e6
    print(
        f"{args.out}: {len(made)} stars to V = {made.vmag().max():.2f}, {number} of them with Gaia's places about "
        f"{year:g}, {size:.1f} MB",
        file=sys.stderr,
    )
    return 0


def run_deepen(args: argparse.Namespace) -> int:
    """Keep a deeper catalogue in the cache; raises CatalogueError."""
    made = deeper.keep(catalogue.read(args.path))
    print(
        f"{len(made)} stars are kept in {cache_folder()}: small fields take them from now on", file=sys.stderr
    )
    return 0
