# SPDX-License-Identifier: Apache-2.0
"""A file with all that GNSS has taught of an instrument: JSON, written whole or not at all."""

import json
import math
from pathlib import Path

import numpy as np

from starpos import files
from starpos.errors import GnssError
from starpos.gnss.states import Learned, layout_of

VERSION, KEY = 1, "starpos_learned"
MAX_BYTES = 200_000
# a covariance may miss being positive by this share of its trace of correlations, by rounding
ROUNDING = 1e-9
CURE = "delete it to learn anew, or give another file"


def save(path: Path, learned: Learned) -> None:
    """Write what was learned; GnssError if the file cannot be written."""
    unknown = math.isnan(learned.temperature_c)
    content = {
        KEY: VERSION,
        "axes": learned.axes,
        "utc_unix_s": learned.utc_unix_s,
        "since_unix_s": None if math.isnan(learned.since_unix_s) else learned.since_unix_s,
        "frames": learned.frames,
        "poses": learned.poses,
        "place_rad": learned.place,
        "temperature_c": None if unknown else learned.temperature_c,
        "calibrated_up": learned.calibrated_up.tolist(),
        "a3": learned.a3.tolist(),
        "state": learned.state.tolist(),
        "covariance": learned.covariance.tolist(),
    }
    try:
        files.write_whole(path, (json.dumps(content) + "\n").encode())
    # ValueError: the name contains a NUL
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise GnssError(f"{path}: what was learned cannot be written there ({reason})") from None


def read_if_there(path: Path) -> Learned | None:
    """Read what was learned; None without a file.  GnssError if it cannot be that."""
    try:
        text = files.read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise GnssError(
            f"{path}: not a readable file of what GNSS taught ({error.strerror}): {CURE}"
        ) from None
    try:
        return _learned(json.loads(text))
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise GnssError(f"{path}: not a file of what GNSS taught ({reason}): {CURE}") from None


def _learned(content: dict) -> Learned:
    if content.get(KEY) != VERSION:
        raise ValueError(f"{KEY} is not {VERSION}")
    axes = content["axes"]
    if axes not in (2, 3):
        raise ValueError("axes is neither 2 nor 3")
    n = layout_of(axes).size
    arrays = {name: np.array(content[name], float) for name in ("a3", "calibrated_up", "state", "covariance")}
    shapes = {"a3": (3, 3), "calibrated_up": (3,), "state": (n,), "covariance": (n, n)}
    for name, array in arrays.items():
        if array.shape != shapes[name] or not np.isfinite(array).all():
            raise ValueError(f"{name} is not {shapes[name]} finite numbers")
    covariance, a3 = arrays["covariance"], arrays["a3"]
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-40))
    correlation = covariance / np.outer(scale, scale)
    if (
        not np.allclose(correlation, correlation.T, atol=1e-6)
        or np.linalg.eigvalsh(correlation)[0] < -ROUNDING * n
    ):
        raise ValueError("its covariance is not symmetric and positive")
    if not np.allclose(a3 @ a3.T, np.eye(3), atol=1e-9) or np.linalg.det(a3) < 0:
        raise ValueError("a3 is no rotation")
    place, since, celsius = content["place_rad"], content["since_unix_s"], content["temperature_c"]
    return Learned(
        axes=axes,
        temperature_c=math.nan if celsius is None else float(celsius),
        utc_unix_s=float(content["utc_unix_s"]),
        place=None if place is None else (float(place[0]), float(place[1])),
        frames=int(content["frames"]),
        poses=int(content["poses"]),
        since_unix_s=math.nan if since is None else float(since),
        **arrays,
    )
