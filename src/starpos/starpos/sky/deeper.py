# SPDX-License-Identifier: Apache-2.0
"""A deeper catalogue for small fields: all stars of Tycho-2's original files, built once and kept in the user's cache."""

import os
import threading
from pathlib import Path

from starpos.instrument.camera import Camera
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import PREFIX, Catalogue, stored
from starpos.sky.depth import Depth
from starpos.table_cache import cache_folder, load_or_build

# The variable of the environment that names the original files: a folder, or Debian's archive of them.
ORIGINALS = "STARPOS_TYCHO2"
# A magnitude fainter than all stars of Tycho-2, and their number.
ALL_MAG, TYCHO2_STARS = 20.0, 2_550_000
# How to get the deeper catalogue.
GET_IT = "type `starpos catalogue deepen --fetch` (121 MB, once)"

_lock = threading.Lock()
_in_use: dict[Path, Catalogue] = {}


def for_field(catalogue: Catalogue, camera: Camera, progress: Progress = quiet) -> Catalogue:
    """The catalogue, or the deeper one if a camera's field holds too few of its stars.

    The deeper one comes from the cache; if STARPOS_TYCHO2 names the original files, it is built now.  Raises
    CatalogueError if these cannot be used.
    """
    if Depth.of(camera, catalogue).enough:
        return catalogue
    deeper = kept()
    if deeper is None and (originals := os.environ.get(ORIGINALS)):
        deeper = build(originals, progress)
    return catalogue if deeper is None or len(deeper) <= len(catalogue) else deeper


def too_thin(catalogue: Catalogue, camera: Camera) -> str:
    """Sentence on how few catalogue stars a camera's field holds, what it needs and how to get it; '' if enough."""
    depth = Depth.of(camera, catalogue)
    if depth.enough:
        return ""
    holds = (
        f"a field of {depth.width_deg:.2g} x {depth.height_deg:.2g} deg holds only {depth.mean:.1f} stars of the "
        f"catalogue (V < {depth.limit_mag:.1f}) on average and needs one to V = {depth.needed_mag:.1f}"
    )
    if len(catalogue) >= TYCHO2_STARS or kept() is not None:
        return f"{holds}, deeper than Tycho-2: name one in STARPOS_CATALOGUE, or take a wider field"
    more = depth.mean * TYCHO2_STARS / max(len(catalogue), 1)
    return f"{holds}; all of Tycho-2 would be {more:.0f}: {GET_IT}"


def kept() -> Catalogue | None:
    """The deeper catalogue, memory-mapped from the cache; None if it was not built."""
    folder = _folder()
    with _lock:
        if folder not in _in_use:
            if (found := stored(folder)) is None:
                return None
            _in_use.clear()
            _in_use[folder] = found
        return _in_use[folder]


def build(originals: Path | str, progress: Progress = quiet, *, anew: bool = False) -> Catalogue:
    """Build the deeper catalogue from a folder or an archive of the original files, and keep it in the cache.

    A catalogue built meanwhile is used, unless a new one is wanted.  Raises CatalogueError as `tycho2.build` does.
    """
    from starpos.sky import tycho2

    folder = _folder()
    with _lock:
        _in_use.clear()
        _in_use[folder] = load_or_build(
            folder,
            PREFIX,
            lambda: None if anew else stored(folder),
            lambda: tycho2.build(originals, ALL_MAG, progress),
            "stars of the deeper catalogue",
        )
        return _in_use[folder]


def fetched(mirror: str | None = None, progress: Progress = quiet) -> Catalogue:
    """Build the deeper catalogue from the original files that a mirror of Debian has (`fetching.fetch`), and keep it.

    Raises CatalogueError if they cannot be fetched; what has come stays for the next call.
    """
    from starpos.sky.fetching import fetch

    archive = fetch(mirror, progress)
    made = build(archive, progress, anew=True)
    archive.unlink(missing_ok=True)
    return made


def _folder() -> Path:
    return cache_folder() / f"{PREFIX}tycho2"
