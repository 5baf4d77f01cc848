# SPDX-License-Identifier: Apache-2.0
"""Writes the files of a report: each whole or not at all, and never over a file that is no report's."""

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from starpos.errors import StarposError
from starpos.files import has_mark, write_whole

PAGE = "index.html"


class WriteError(StarposError):
    """A report cannot be written."""


def check(folder: Path) -> None:
    """Raise WriteError, before a night is worked on, where its report could not be written; leaves nothing behind."""
    made: list[Path] = []
    try:
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        _check_ours(folder / PAGE)
    except (OSError, ValueError) as error:
        raise _refused(folder, error) from None
    finally:
        for path in made:
            with suppress(OSError):
                path.rmdir()


def write(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files by name; raises WriteError if one cannot be written, or would replace a file that is no report's."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            _check_ours(folder / name)
        for name, content in files.items():
            write_whole(folder / name, content)
    except (OSError, ValueError) as error:
        raise _refused(folder, error) from None


def _refused(folder: Path, error: Exception) -> WriteError:
    """The error for a folder; a ValueError comes from a NUL in its name."""
    reason = getattr(error, "strerror", None) or error
    return WriteError(f"{folder}: the report cannot be written there ({reason}): give another --out")


def _check_ours(path: Path) -> None:
    if not path.exists() or (path.is_file() and has_mark(path)):
        return
    raise WriteError(f"{path}: it is there already and no report of starpos: move it, or give another --out")
