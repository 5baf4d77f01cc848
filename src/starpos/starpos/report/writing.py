# SPDX-License-Identifier: Apache-2.0
"""Writes the files of a report: each whole or not at all, and never over a file that is no report's."""

from collections.abc import Mapping
from pathlib import Path

from starpos.errors import StarposError
from starpos.files import open_regular, write_whole

# every file of a report has this mark in its first HEAD bytes
MARK = b"starpos"
HEAD = 400


class WriteError(StarposError):
    """A report cannot be written."""


def write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files by name; raises WriteError if one cannot be written, or would replace a file that is no report's."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            _check_ours(folder / name)
        for name, content in files.items():
            write_whole(folder / name, content)
    # ValueError comes from a NUL in the name
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise WriteError(
            f"{folder}: the report cannot be written there ({reason}): give another --out"
        ) from None


def _check_ours(path: Path) -> None:
    if not path.exists():
        return
    if path.is_file():
        with open_regular(path) as file:
            if MARK in file.read(HEAD):
                return
    raise WriteError(f"{path}: it is there already and no report of starpos: move it, or give another --out")
