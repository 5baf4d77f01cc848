# SPDX-License-Identifier: Apache-2.0
"""Files of a report on disk: each whole or not at all, and nothing overwritten that is not a report's."""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

from starpos.errors import StarposError

MARK = b"starpos"  # in the head of every file that a report writes
HEAD = 400


class WriteError(StarposError):
    """A report cannot be written."""


def write(folder: Path, files: Mapping[str, bytes]) -> None:
    """The files of these names; WriteError where one cannot be written, or one of that name is somebody else's."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in files:
            _check_ours(folder / name)
        for name, content in files.items():
            _write_whole(folder / name, content)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise WriteError(
            f"{folder}: the report cannot be written there ({reason}): give another --out"
        ) from None


def _check_ours(path: Path) -> None:
    if not path.exists():
        return
    if path.is_file():
        with path.open("rb") as file:
            if MARK in file.read(HEAD):
                return
    raise WriteError(f"{path}: it is there already and no report of starpos: move it, or give another --out")


def _write_whole(path: Path, content: bytes) -> None:
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
        os.chmod(temporary, 0o644)  # mkstemp's is for its owner alone
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
