# SPDX-License-Identifier: Apache-2.0
"""Stars without a motion in Tycho-2: how fast they are by Hipparcos, and the fast ones for tycho2.py.

    python tools/data/fast_stars.py tycho2_2.orig.tar.xz stars.dat

The second file is KStars' list of the stars of Hipparcos to V = 9 (Debian's package kstars-data).
"""

import argparse
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from tycho2 import MIN_MAS_YEAR, johnson_v, originals, table_of

from starpos.rotation import unit_vector
from starpos.units import ARCSEC

# hhmmss.ss, +-ddmmss.s at J2000, motions in mas/yr
ROW = re.compile(r"(\d\d)(\d\d)(\d\d\.\d\d) ([+-])(\d\d)(\d\d)(\d\d\.\d) ([+-]\d{6}\.\d)([+-]\d{6}\.\d)")
OBSERVED = 1991.4
# a star this near is Hipparcos's; one a little further goes with it
SAME_ARCSEC, TOGETHER_ARCSEC = 3.0, 8.0
BRIGHTER = 11.0
EDGES = (-2, 3, 4, 5, 6, 7, 8, 9)


def hipparcos(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) at the mean epoch of Tycho's observations, and motions (N, 2) in mas/yr."""
    rows = [m.groups() for line in path.read_text(errors="replace").splitlines() if (m := ROW.match(line))]
    h, m, s, _, d, am, ars, pm_ra, pm_dec = np.array(rows).T
    sign = np.array([-1 if r[3] == "-" else 1 for r in rows])
    ra = 15 * (h.astype(float) + m.astype(float) / 60 + s.astype(float) / 3600)
    dec = sign * (d.astype(float) + am.astype(float) / 60 + ars.astype(float) / 3600)
    motion = np.stack([pm_ra, pm_dec], -1).astype(float)
    back = (OBSERVED - 2000) * motion / 3.6e6
    return unit_vector(*np.radians([ra + back[:, 0] / np.cos(np.radians(dec)), dec + back[:, 1]])), motion


def unmeasured(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Identifiers (N, 3), V (N,) and directions (N, 3) of Tycho-2's stars without a motion."""
    parts = []
    for name, text in originals(path):
        t = table_of(name, text)
        v = johnson_v(t["bt"], t["vt"])
        keep = ~np.isfinite(t["pm_ra"]) & (v < BRIGHTER)
        tyc = np.stack([t["tyc1"], t["tyc2"], t["tyc3"]], -1)
        parts.append((tyc[keep].astype(int), v[keep], unit_vector(*np.radians([t["ra"], t["dec"]]))[keep]))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("originals", type=Path)
    parser.add_argument("stars", type=Path)
    args = parser.parse_args()
    tyc, v, there = unmeasured(args.originals)
    directions, motion = hipparcos(args.stars)
    apart, row = cKDTree(directions).query(there)
    motion, apart = motion[row], apart / ARCSEC
    fast = (np.hypot(*motion.T) >= MIN_MAS_YEAR) & (apart < TOGETHER_ARCSEC)
    for k in np.flatnonzero(fast)[np.lexsort(tyc[fast].T[::-1])]:
        print("{},{},{},{},{}".format(*tyc[k], *motion[k]))
    known = (apart < SAME_ARCSEC) & motion.any(1)
    print(f"{len(v)} stars without a motion, {known.sum()} in Hipparcos' list, {fast.sum()} fast")
    print("      V      stars   rms of one axis of the others' motions, mas/yr")
    for low, high in pairwise(EDGES):
        slow = known & ~fast & (low <= v) & (v < high)
        print(f"{low:4d} to {high} {slow.sum():6d} {np.sqrt(np.mean(motion[slow] ** 2)):8.1f}")


if __name__ == "__main__":
    main()
