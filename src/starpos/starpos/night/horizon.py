# SPDX-License-Identifier: Apache-2.0
"""The horizon of a camera that stands still, learned from where bright stars never are: trees, houses, hills."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starpos.earth.orientation import earth_state
from starpos.errors import FrameError
from starpos.files import save
from starpos.fix.searching import Sight
from starpos.instrument.camera import Camera
from starpos.night.watching import air_mass
from starpos.sky.catalogue import Catalogue
from starpos.tables import TableForm

# stars that are brighter by this than the faintest identified ones are missed behind clouds, trees and houses alone
SURELY_SEEN_MAG = 1.5
# mag per air mass
HAZE = 0.5
# how often such a star is identified above the horizon, and, by a wrong match, below it
SEEN, WRONGLY = 0.85, 0.03
# number of parts of the azimuths, and the fewest stars around one that show the horizon there
PARTS, FEWEST = 36, 8
HIGHEST_DEG = 80
# logarithm of the chance by which an altitude may be worse than the best
AS_LIKELY = 2.0
TABLE = TableForm(what="table of a horizon", error=FrameError, needed=("azimuth_deg", "altitude_deg"))


def expected(sight: Sight, camera: Camera, catalogue: Catalogue) -> np.ndarray:
    """The bright stars (4, N) above the level horizon on a frame whose attitude at a known place is known.

    Azimuth and altitude in deg, whether they were identified, and by how much each would be brighter at the zenith than
    the faintest identified ones, mag.
    """
    at, found = sight.solution.at_place, sight.found
    assert at is not None and found is not None
    state, to_local = earth_state(at.utc_unix_s), at.place.plumb_axes
    limit = float(np.percentile(catalogue.vmag(found.catalogue), 95))
    rows = catalogue.cone(to_local[2] @ state.gcrs_to_itrs, np.radians(89.5), limit - SURELY_SEEN_MAG)
    v = state.to_itrs(catalogue.directions(rows, state.year)) @ to_local.T
    xy = camera.project(v @ at.optics.rotation)
    with np.errstate(invalid="ignore"):
        on = ((xy > 0) & (xy < np.array([camera.width, camera.height]) - 1)).all(1)
    v, rows = v[on], rows[on]
    azimuth, altitude = np.arctan2(v[:, 0], v[:, 1]), np.arcsin(v[:, 2])
    seen, margin = np.isin(rows, found.catalogue), limit - catalogue.vmag(rows)
    return np.array([np.degrees(azimuth) % 360, np.degrees(altitude), seen, margin])


def horizon(stars: Sequence[np.ndarray], extinction: float = np.nan) -> np.ndarray:
    """Azimuths and altitudes (PARTS, 2) of the horizon, deg; NaN where too few stars have passed.

    stars: of each frame, as `expected` has them.
    extinction: in mag per air mass, by which low stars are fainter; NaN: unknown, then haze is assumed.
    In each part of the azimuths it is the lowest altitude that divides stars that are seen from those that are not nearly
    as well as the best.
    """
    azimuth, altitude, seen, margin = np.concatenate(stars, axis=1)
    dimmed = (HAZE if np.isnan(extinction) else extinction) * (air_mass(altitude) - 1)
    bright = margin - dimmed > SURELY_SEEN_MAG
    azimuth, altitude, seen = azimuth[bright], altitude[bright], seen[bright] > 0
    width = 360 / PARTS
    middles = (np.arange(PARTS) + 0.5) * width
    found = np.full(PARTS, np.nan)
    for k, middle in enumerate(middles):
        near = np.abs((azimuth - middle + 180) % 360 - 180) < 0.75 * width
        if near.sum() < FEWEST:
            continue
        above = altitude[near][None] > np.arange(0, HIGHEST_DEG + 0.5, 0.5)[:, None]
        chance = np.where(above, SEEN, WRONGLY)
        likely = np.log(np.where(seen[near], chance, 1 - chance)).sum(1)
        # the lowest of the likely ones: what is called ground is never sky
        found[k] = np.flatnonzero(likely > likely.max() - AS_LIKELY)[0] / 2
    return np.column_stack([middles, found])


def write(path: Path, line: np.ndarray) -> None:
    """Write a horizon (N, 2) as a table; WriteError."""
    rows = "".join(f"{azimuth:g},{altitude:.1f}\n" for azimuth, altitude in line[np.isfinite(line[:, 1])])
    save(path, f"azimuth_deg,altitude_deg\n{rows}".encode(), "the horizon")


def read(path: str) -> np.ndarray:
    """Azimuths and altitudes (N, 2) in deg of a table, by azimuth; FrameError."""
    columns = TABLE.read(path).columns
    line = np.stack([columns[name] for name in TABLE.needed], -1)
    if not (np.isfinite(line).all() and len(line)):
        raise FrameError(f"{path}: a horizon needs rows of two numbers, azimuth_deg and altitude_deg")
    return line[np.argsort(line[:, 0] % 360)]
