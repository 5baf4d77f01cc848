# SPDX-License-Identifier: Apache-2.0
"""`starpos catalogue`: what the star catalogue holds, and building it, or a deeper one, from the original files."""

import argparse
import sys
from pathlib import Path

import numpy as np

from starpos import catalogue
from starpos.cli import common
from starpos.errors import CatalogueError

ORIGINALS = """The original Tycho-2 files are in Debian's and Ubuntu's source package tycho2:
    apt-get source --download-only tycho2        (with a deb-src line in the apt sources)
which brings tycho2_2.orig.tar.xz; give that archive, or a folder with tyc2.dat.00 .. 19 and suppl_1.dat."""


def define(parser) -> None:
    kinds = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    info = kinds.add_parser("info", help="stars, magnitudes and errors of the catalogue in use")
    info.add_argument("path", nargs="?", metavar="FILE", help="another file than the one in use")
    info.add_argument(
        "--year", type=common.number(1900, 2200), default=2026.0, help="for the errors of places (2026)"
    )
    info.set_defaults(run=show)
    build = kinds.add_parser(
        "build", help="make the compact file from Tycho-2's original files", epilog=ORIGINALS
    )
    build.formatter_class = argparse.RawDescriptionHelpFormatter
    build.add_argument("originals", metavar="ORIGINALS", help="folder or archive of the original files")
    build.add_argument(
        "--limit-mag", type=common.number(0, 20), default=11.0, metavar="V", help="faintest V kept (11.0)"
    )
    build.add_argument(
        "--out", default="tycho2.npz", metavar="FILE", help="STARPOS_CATALOGUE=FILE then uses it"
    )
    build.set_defaults(run=build_file)


def show(args) -> int:
    c = catalogue.load(args.path)
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
    print("Tycho-2: Hog et al. 2000, A&A 355, L27; distributed by Debian under the 2-clause BSD licence")
    return 0


def build_file(args) -> int:
    from starpos import tycho2

    made = tycho2.build(args.originals, args.limit_mag, common.ProgressBar())
    try:
        catalogue.save(made, args.out)
    except OSError as e:
        raise CatalogueError(f"{args.out}: cannot be written ({e.strerror}): give another --out") from None
    size = Path(args.out).stat().st_size / 1e6
    print(f"{args.out}: {len(made)} stars with V < {args.limit_mag:g}, {size:.1f} MB", file=sys.stderr)
    return 0
