# SPDX-License-Identifier: Apache-2.0
"""The file that a text names, as ROS writes URLs of calibrations."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from starpos.errors import InstrumentError


def path_of(url: str) -> Path:
    """file:///a/b.yaml, or a path, which may begin with ~; InstrumentError for anything else."""
    try:
        parts = urlsplit(url)
        if not parts.scheme:
            return Path(url).expanduser()
        if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
            return Path(unquote(parts.path))
    except (ValueError, RuntimeError):  # no URL; a home that nobody has
        pass
    raise InstrumentError(f"{url!r} names no file: give file:///path/to/file.yaml, or a path")
