# SPDX-License-Identifier: Apache-2.0
"""Checks of a file before it is read as a frame."""

import stat
from pathlib import Path

from starpos.errors import FrameError, one_line

MAX_BYTES = 2_000_000_000


def check_file(path: Path) -> None:
    """Raise FrameError or OSError unless the path is a file that is not empty and can be opened."""
    try:
        status = path.stat()
    # ValueError: the name contains a NUL
    except (FileNotFoundError, NotADirectoryError, ValueError):
        raise FrameError(f"{one_line(path)}: there is no such file; check the path.") from None
    if stat.S_ISDIR(status.st_mode):
        raise FrameError(f"{path}: this is a folder; give the frames in it, like {path / '*.fits'}.")
    if not stat.S_ISREG(status.st_mode):
        raise FrameError(f"{path}: this is no regular file but a device or a pipe; give a frame's file.")
    if status.st_size == 0:
        raise FrameError(f"{path}: the file is empty; take the frame again.")
    # a file without permission to read would otherwise be reported as a damaged image
    path.open("rb").close()


def bytes_of(path: Path) -> bytes:
    """The content of a file; FrameError if it is larger than MAX_BYTES."""
    check_size(path, MAX_BYTES)
    return path.read_bytes()


def check_size(path: Path, most: int) -> None:
    """Raise FrameError if a file has more than `most` bytes."""
    if path.stat().st_size > most:
        raise FrameError(f"{path}: it is larger than {most // 10**6} MB, too large for a frame.")
