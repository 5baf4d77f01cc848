#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Deflection of the vertical from a geoid grid, and its error against finer grids.

python tools/data/geoid_sigma.py egm96_15.gtx [--against ch_swisstopo_chgeo2004_ETRS89_LHN95.tif ...]
"""

import argparse

import numpy as np

from starpos.earth import geoid
from starpos.earth.vertical import Deflection

PLACES = {
    "Netherlands": (52.2, 5.5),
    "Switzerland": (46.5, 8.0),
    "Hawaii": (19.6, -155.5),
    "Tehran": (35.70, 51.41),
    "Himalaya": (27.99, 86.93),
    "Andes": (-32.65, -70.0),
    "Kansas": (38.5, -98.0),
    "Western Australia": (-26.0, 125.0),
    "Canary Islands": (28.3, -16.6),
    "Pacific": (0.0, -140.0),
    "North Pole": (90.0, 0.0),
    "South Pole": (-90.0, 0.0),
}


def compare(coarse: geoid.Geoid, fine: geoid.Geoid, places: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors of xi and eta (places, 2) and their stated errors (places,), arcsec, at random places of the finer grid."""
    grid, rng = fine.grid, np.random.default_rng(1)
    missed, stated = [], []
    for row, column in rng.uniform(0, grid.values.shape, (places, 2)):
        place = np.radians([grid.south + row * grid.step_latitude, grid.west + column * grid.step_longitude])
        here, true = coarse.at(*place), fine.at(*place)
        if Deflection() not in (here, true):
            missed.append((here.xi_arcsec - true.xi_arcsec, here.eta_arcsec - true.eta_arcsec))
            stated.append(here.stddev_arcsec)
    return np.array(missed), np.array(stated)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("grid")
    parser.add_argument("--against", nargs="+", default=[], metavar="FINER", help="grids that know better")
    parser.add_argument("--places", type=int, default=1000, help="of each of them (1000)")
    args = parser.parse_args()
    coarse = geoid.read(args.grid)
    print(f"{'arcsec':<20}{'xi':>8}{'eta':>8}{'sigma':>8}")
    for name, place in PLACES.items():
        d = coarse.at(*np.radians(place))
        print(f"{name:<20}{d.xi_arcsec:8.1f}{d.eta_arcsec:8.1f}{d.stddev_arcsec:8.1f}")
    for path in args.against:
        missed, stated = compare(coarse, geoid.read(path), args.places)
        rms = [np.sqrt(np.mean(np.square(v))) for v in (missed, stated, missed / stated[:, None])]
        worst = np.abs(missed / stated[:, None]).max()
        print(
            f"{path}: misses {rms[0]:.1f} where {rms[1]:.1f} is said; rms ratio {rms[2]:.2f}, largest {worst:.1f}"
        )


if __name__ == "__main__":
    main()
