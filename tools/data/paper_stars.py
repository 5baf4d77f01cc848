# SPDX-License-Identifier: Apache-2.0
"""Differences of the paper's star list from the plain cut V < 7 with a HIP number in the committed catalogue.

`paper_stars.py ORIGINALS > src/starpos/test/identification/paper_stars.csv` (a folder with tyc2.dat.00 .. 19).
The paper's list is rows of Tycho-2's main table: without supplement 1, both components of a pair, V not rounded to
0.01 mag.
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from tycho2 import johnson_v

from starpos.sky import catalogue

LIMIT_MAG = 7.0


def paper_rows(folder: Path):
    """Read TYC, RA and Dec (deg) of the rows of the main table with V < LIMIT_MAG and a HIP number."""
    for path in sorted(folder.glob("tyc2.dat.??")):
        for line in path.open("rb"):
            if not line[142:148].strip():
                continue
            bt, vt = (np.float64(text.strip() or b"nan") for text in (line[110:116], line[123:129]))
            if johnson_v(bt, vt) < LIMIT_MAG:
                place = line[15:27], line[28:40]
                # Without a mean position take the observed one.
                if not place[0].strip():
                    place = line[152:164], line[165:177]
                yield tuple(int(t) for t in line[:12].split()), *map(float, place)


stars = catalogue.read(catalogue.COMMITTED)
bright = np.flatnonzero(stars.vmag_centi < 100 * LIMIT_MAG + 100)
tree = cKDTree(stars.directions(bright))
rows = list(paper_rows(Path(sys.argv[1])))
ra, dec = np.radians([r[1:] for r in rows]).T
_, nearest = tree.query(np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1))
plain_cut = (stars.vmag_centi < 100 * LIMIT_MAG) & (stars.hip > 0)
wanted, plain = Counter(bright[nearest].tolist()), set(np.flatnonzero(plain_cut).tolist())
print(
    f"# {Path(__file__).name}: how often the paper's {len(rows)} stars hold these, where that is not the plain cut"
)
print("tyc1,tyc2,tyc3,rows")
for k in sorted(wanted.keys() | plain):
    if wanted[k] != (k in plain):
        print(*stars.tyc[k], wanted[k], sep=",")
