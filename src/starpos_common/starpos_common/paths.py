# SPDX-License-Identifier: Apache-2.0
"""Path of a file from a URL, as ROS writes the URL of a calibration."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from starpos.errors import InstrumentError


def path_of(url: str) -> Path:
    """Convert file:///a/b.yaml, or a path that may begin with ~, to a Path; InstrumentError for anything else."""
    try:
        parts = urlsplit(url)
        if not parts.scheme:
            return Path(url).expanduser()
        if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
            return Path(unquote(parts.path))
    except (ValueError, RuntimeError):
        # It is no URL, or ~ names a user who does not exist.
        pass
    raise InstrumentError(f"{url!r} names no file: give file:///path/to/file.yaml, or a path")
