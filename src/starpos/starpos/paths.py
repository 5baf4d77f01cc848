# SPDX-License-Identifier: Apache-2.0
"""Path of a file from a URL, as ROS writes the URL of a calibration."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from starpos.errors import InstrumentError

# Linux opens no longer path.
LONGEST_PATH = 4096


def path_of(url: str) -> Path:
    """Convert file:///a/b.yaml, or a path that may begin with ~, to a Path; InstrumentError for anything else."""
    if len(url) > LONGEST_PATH:
        raise InstrumentError(
            f"a text of {len(url)} characters names no file: give file:///path/to/file.yaml, or a path"
        )
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
