# SPDX-License-Identifier: Apache-2.0
"""Elements of satellites that do not exist, as public lists have them."""

import numpy as np


def drawn(count: int, seed: int, epoch_unix_s: float, names: str = "OBJECT"):
    """Records of sgp4 in low circular orbits with elements of that epoch, and their text of three lines each."""
    from sgp4.api import WGS72, Satrec
    from sgp4.exporter import export_tle

    rng = np.random.default_rng(seed)
    records, text = [], []
    for k in range(count):
        s = Satrec()
        epoch = epoch_unix_s / 86400 + 2440587.5 - 2433281.5
        inclination, perigee, anomaly, node = np.radians([rng.uniform(50, 98), *rng.uniform(0, 360, 3)])
        rate = rng.uniform(14, 15.2) * 2 * np.pi / 1440
        number = 40001 + k
        s.sgp4init(WGS72, "i", number, epoch, 1e-5, 0.0, 0.0, 1e-3, perigee, inclination, anomaly, rate, node)
        s.classification, s.intldesg, s.ephtype, s.elnum, s.revnum = "U", "10001A", 0, 1, 1
        lines = export_tle(s)
        text.append(f"{names} {number}\n{lines[0]}\n{lines[1]}\n")
        records.append(Satrec.twoline2rv(*lines))
    return records, "".join(text)
