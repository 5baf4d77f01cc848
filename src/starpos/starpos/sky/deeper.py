# SPDX-License-Identifier: Apache-2.0
"""How deep a catalogue a field needs, and a deeper one for small fields: all of Tycho-2, kept in the cache."""

import math
from functools import lru_cache

import numpy as np

from starpos.instrument.camera import Camera
from starpos.sky.catalogue import CELLS, ZONES, Catalogue, kept_catalogues

# Number of the catalogue's stars that should be on a frame, in all but this share of the sky.
ENOUGH_ON_FRAME, SPARSE = 12, 0.1
# Size of the blocks in which stars are counted, deg.
BLOCK_DEG = 10
# Stars per deg2 to V = 11 in that share of the sky, and factor for each magnitude.
SPARSE_TO_V11, TIMES_A_MAG = 10.0, 2.2
# Share of a catalogue's faintest stars that is ignored in its depth.
FAINTEST_SHARE = 0.01


@lru_cache(maxsize=16)
def stars_on_frame(camera: Camera, catalogue: Catalogue) -> tuple[float, float]:
    """Stars of a catalogue on a camera's frame: on average, and in the tenth of the sky with the fewest."""
    _, mean, sparse = _densities(catalogue)
    area_deg2 = _solid_angle_deg2(camera)
    return mean * area_deg2, sparse * area_deg2


@lru_cache(maxsize=4)
def _densities(catalogue: Catalogue) -> tuple[float, float, float]:
    """V to which a catalogue goes, its stars per deg2 on average, and in the sparsest share of the sky."""
    if not len(catalogue):
        return 0.0, 0.0, 0.0
    cells = np.diff(catalogue.cell_start).reshape(
        ZONES // BLOCK_DEG, BLOCK_DEG, CELLS // BLOCK_DEG, BLOCK_DEG
    )
    edges = np.sin(np.radians(np.arange(-90, 91, BLOCK_DEG)))
    area = np.repeat(np.diff(edges) * np.radians(BLOCK_DEG) * np.degrees(1) ** 2, CELLS // BLOCK_DEG)
    density = cells.sum((1, 3)).ravel() / area
    order = np.argsort(density)
    sparse = density[order[np.searchsorted(area[order].cumsum(), SPARSE * area.sum())]]
    last = int((1 - FAINTEST_SHARE) * len(catalogue))
    faint = np.partition(catalogue.vmag_centi, last)[last] / 100
    return float(faint), float(len(catalogue) / area.sum()), float(sparse)


def _solid_angle_deg2(camera: Camera) -> float:
    """Solid angle of a pinhole's frame."""
    width, height = camera.width / camera.fx, camera.height / camera.fy
    u, v = (np.arange(-20, 21) / 20 * n / 2 for n in (width, height))
    # a pixel's solid angle falls with the cube of the cosine
    share = np.mean((1 + u[:, None] ** 2 + v**2) ** -1.5)
    return float(width * height * share * np.degrees(1) ** 2)


# The number of Tycho-2's stars.
TYCHO2_STARS = 2_550_000
NAME = "tycho2"
KEPT = kept_catalogues("stars of the deeper catalogue")


def for_field(catalogue: Catalogue, camera: Camera) -> Catalogue:
    """The catalogue, or the deeper one in the cache if a camera's field holds too few of its stars."""
    if stars_on_frame(camera, catalogue)[1] >= ENOUGH_ON_FRAME:
        return catalogue
    deeper = kept()
    return catalogue if deeper is None or len(deeper) <= len(catalogue) else deeper


def too_thin(catalogue: Catalogue, camera: Camera) -> str:
    """Sentence on how few catalogue stars a camera's field holds, what it needs and how to get it; '' if enough."""
    mean, sparse = stars_on_frame(camera, catalogue)
    if sparse >= ENOUGH_ON_FRAME:
        return ""
    sides = camera.width / camera.fx, camera.height / camera.fy
    width_deg, height_deg = (math.degrees(2 * math.atan(side / 2)) for side in sides)
    more = math.log(ENOUGH_ON_FRAME / (SPARSE_TO_V11 * _solid_angle_deg2(camera))) / math.log(TIMES_A_MAG)
    # to half a magnitude
    needed_mag = math.ceil(2 * (11 + more)) / 2
    holds = (
        f"a field of {width_deg:.2g} x {height_deg:.2g} deg holds only {mean:.1f} stars of the catalogue "
        f"(V < {_densities(catalogue)[0]:.1f}) on average and needs one to V = {needed_mag:.1f}"
    )
    if len(catalogue) >= TYCHO2_STARS or kept() is not None:
        return f"{holds}, deeper than Tycho-2: name one in STARPOS_CATALOGUE, or take a wider field"
    more = mean * TYCHO2_STARS / max(len(catalogue), 1)
    return (
        f"{holds}; all of Tycho-2 would be {more:.0f}: "
        "build it (docs/how-to/small_fields.md) and type `starpos catalogue deepen FILE`"
    )


def kept() -> Catalogue | None:
    """The deeper catalogue, memory-mapped from the cache; None if none is kept."""
    return KEPT.stored(NAME)


def keep(catalogue: Catalogue) -> Catalogue:
    """Keep a catalogue in the cache as the deeper one, for small fields."""
    return KEPT.built(NAME, lambda: catalogue, anew=True)
