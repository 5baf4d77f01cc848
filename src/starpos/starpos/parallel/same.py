# SPDX-License-Identifier: Apache-2.0
"""The versions that must be equal on all machines, so that they give the same answers."""

import hashlib
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import starpos
from starpos.sky import catalogue, deeper

# Versions by name.
Same = dict[str, str]


@lru_cache(maxsize=1)
def same_here() -> Same:
    """Versions of starpos, its catalogues and the Earth orientation tables in this process."""
    root = Path(starpos.__file__).parent
    digest = hashlib.sha256()
    for source in sorted(root.rglob("*.py")):
        digest.update(str(source.relative_to(root)).encode() + b"\0" + source.read_bytes())
    return {
        "starpos": f"{starpos.__version__} ({digest.hexdigest()[:8]})",
        "star catalogue": catalogue.load_catalogue().fingerprint,
        "deeper catalogue": "none" if (more := deeper.kept()) is None else more.fingerprint,
        "astropy-iers-data": metadata.version("astropy-iers-data"),
    }


def differing(there: Same, here: Same) -> str:
    """Part of a sentence: the first version that differs, and what to do."""
    what = next(name for name in here if there.get(name) != here[name])
    return f"the {what} of this worker is {there.get(what)}, here it is {here[what]}: install the same there"
