# SPDX-License-Identifier: Apache-2.0
"""Parallaxes of the near stars by Hipparcos, for starpos.sky.catalogue.

    python tools/data/near_stars.py FOLDER > src/starpos/starpos/sky/data/near_stars.csv

The folder is Stellarium's stars/default (Debian's package stellarium-data); its files stars_0 to stars_2 hold Hipparcos'
stars with their parallaxes.  KStars' list is no source: it has some near stars' parallaxes of Tycho-1, tens of mas off.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from starpos.sky.catalogue import NEAR_MIN_MAS, load_catalogue
from starpos.units import ARCSEC

# Stellarium's Star1: a header of 8 numbers, the fifth of which is the level of its grid; how many stars a zone has; stars
HEADER_BYTES = 32
STAR = np.dtype(
    {
        "names": ["hip_and_component", "parallax"],
        "formats": ["<u4", "<i4"],
        "offsets": [0, 24],
        "itemsize": 28,
    }
)
PARALLAX_MAS = 0.01
# a star this near goes with the star of Hipparcos
OBSERVED, TOGETHER_ARCSEC = 1991.4, 8.0


def hipparcos(folder: Path) -> np.ndarray:
    """Parallaxes in mas by HIP number; 0 for numbers without one."""
    parallax = np.zeros(1 << 24)
    for path in sorted(folder.glob("stars_[012]_*.cat")):
        level = np.fromfile(path, "<i4", 8)[4]
        stars = np.fromfile(path, STAR, offset=HEADER_BYTES + 4 * 20 * 4**level)
        hip = stars["hip_and_component"] & 0xFFFFFF
        parallax[hip] = stars["parallax"] * PARALLAX_MAS
    parallax[0] = 0.0
    return parallax


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    catalogue = load_catalogue()
    parallax = hipparcos(args.folder)[catalogue.hip]
    near = np.flatnonzero(parallax >= NEAR_MIN_MAS)
    there = catalogue.directions(slice(None), OBSERVED)
    apart, which = cKDTree(there[near]).query(there, distance_upper_bound=TOGETHER_ARCSEC * ARCSEC)
    # also the companions that Hipparcos does not have
    found = np.flatnonzero(np.isfinite(apart))
    print("tyc1,tyc2,tyc3,parallax_mas")
    for k in found[np.lexsort(catalogue.tyc[found].T[::-1])]:
        print(*catalogue.tyc[k], f"{parallax[near[which[k]]]:.1f}", sep=",")
    print(f"{len(near)} near stars, {len(found) - len(near)} more beside them", file=sys.stderr)


if __name__ == "__main__":
    main()
