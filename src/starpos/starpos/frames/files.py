# SPDX-License-Identifier: Apache-2.0
"""Open the file of a frame, and limit what it may unpack to."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from starpos import files
from starpos.errors import FrameError, one_line

# Maximum bytes of a file, and of the pixels it unpacks to: both fit into a small robot's memory.
MAX_BYTES = 800_000_000


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a frame's file, as a context manager; FrameError if it is missing, empty or too large.

    OSError if the file may not be read.
    """
    try:
        file = files.open_regular(path)
    except (FileNotFoundError, NotADirectoryError):
        raise FrameError(f"{one_line(path)}: there is no such file; check the path.") from None
    except IsADirectoryError:
        raise FrameError(
            f"{path}: this is a folder; give the frames in it, like {path / '*.fits'}."
        ) from None
    with file:
        size = file.seek(0, 2)
        file.seek(0)
        if size == 0:
            raise FrameError(f"{path}: the file is empty; take the frame again.")
        if size > MAX_BYTES:
            raise FrameError(f"{path}: it has over {MAX_BYTES // 10**6} MB, too many for a frame.")
        yield file


def check_pixels(width: int, height: int, bytes_each: float, place: str) -> None:
    """Raise FrameError unless width x height pixels, of bytes_each as a header claims, fit into MAX_BYTES."""
    if min(width, height) < 1 or width * height * bytes_each > MAX_BYTES:
        raise FrameError(
            f"{place}: its header claims {width} x {height} pixels of {bytes_each:g} bytes; a frame has at least one and "
            f"at most {MAX_BYTES // 10**6} MB."
        )
