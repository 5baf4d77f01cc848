# SPDX-License-Identifier: Apache-2.0
"""Programs of others that do the same work: which are here, and how each finds the stars of a frame.

They are looked for where Python looks, then in a folder of their own, `pip install --no-deps --target FOLDER`.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np

from starpos.table_cache import cache_folder

# By the name under which PyPI has it: the module that is imported.
MODULES = {
    "sep": "sep",
    "photutils": "photutils",
    "tetra3rs": "tetra3rs",
    "cedar-solve": "tetra3",
    "astrometry": "astrometry",
}


class Absent(Exception):
    """A peer cannot take part; the text says why."""


def folder() -> Path:
    """Where peers are looked for unless another folder is named."""
    return cache_folder() / "peers"


def look_in(where: Path) -> None:
    """Let peers be imported from a folder too; what the workspace has itself goes first."""
    sys.path.append(str(where))


def is_here(name: str) -> bool:
    """Whether a peer can be imported."""
    return importlib.util.find_spec(MODULES[name]) is not None


def how_to_get(where: Path) -> str:
    """One line: which peers are not installed and how to get them; '' if all are."""
    missing = [name for name in MODULES if not is_here(name)]
    if not missing:
        return ""
    return (
        f"not installed: {', '.join(missing)}. To have them beside: python -m pip install --no-deps --target {where} "
        + " ".join(missing)
    )


def require(name: str) -> None:
    """Raise Absent if a peer cannot be imported."""
    if not is_here(name):
        raise Absent(f"not installed (pip install {name})")


def with_sep(pixels: np.ndarray) -> np.ndarray:
    """Places (N, 2) px by sep, with windowed positions."""
    import sep

    plane = pixels.astype(np.float32)
    background = sep.Background(plane)
    plane -= background
    found = sep.extract(plane, 5, err=background.globalrms)
    x, y, _ = sep.winpos(plane, found["x"], found["y"], np.full(len(found), 2.0))
    return np.stack([x, y], 1)


def with_photutils(pixels: np.ndarray) -> np.ndarray:
    """Places (N, 2) px by photutils' DAOStarFinder, over a global background."""
    from photutils.detection import DAOStarFinder

    plane = pixels.astype(np.float32)
    level = np.median(plane)
    # the share of a normal distribution within one sigma
    noise = level - np.percentile(plane, 15.87)
    table = DAOStarFinder(threshold=5 * noise, fwhm=2.4)(plane - level)
    if table is None:
        return np.empty((0, 2))
    names = ("x_centroid", "y_centroid") if "x_centroid" in table.colnames else ("xcentroid", "ycentroid")
    return np.stack([np.asarray(table[name]) for name in names], 1)


def with_tetra3rs(pixels: np.ndarray) -> np.ndarray:
    """Places (N, 2) px by tetra3rs."""
    import tetra3rs

    found = tetra3rs.extract_centroids(pixels, threads=1).centroids
    height, width = pixels.shape
    middle = np.array([width - 1, height - 1]) / 2
    return np.array([(c.x, c.y) for c in found]).reshape(-1, 2) + middle


def with_cedar_solve(pixels: np.ndarray) -> np.ndarray:
    """Places (N, 2) px by cedar-solve, which counts from the corner of the first pixel."""
    from tetra3 import get_centroids_from_image

    return np.asarray(get_centroids_from_image(pixels, sigma=5))[:, ::-1].reshape(-1, 2) - 0.5


# How each finds the stars of a frame (rows, columns).
DETECTORS = {
    "sep": with_sep,
    "photutils": with_photutils,
    "tetra3rs": with_tetra3rs,
    "cedar-solve": with_cedar_solve,
}
