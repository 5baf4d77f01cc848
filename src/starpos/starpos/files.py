# SPDX-License-Identifier: Apache-2.0
"""Files of others, read so that none of them can hang the program; files written whole or not at all; their URLs."""

import errno
import lzma
import os
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote, urlsplit

from starpos.errors import InstrumentError, StarposError, WriteError

# Linux opens no longer path.
LONGEST_PATH = 4096
# no wait for the other end of a pipe, and no terminal becomes ours; Windows has neither among its files
AT_ONCE = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
# every page and picture that starpos makes has this mark in its first HEAD bytes
MARK, HEAD = b"starpos", 400


@cache
def rows_of(file: Path) -> dict[str, Any]:
    """The rows of a YAML file of a package."""
    import yaml

    # PyYAML's parser in C takes a tenth of the time; a build without it is rare
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    rows: dict[str, Any] = yaml.load(file.read_bytes(), loader)
    return rows


def open_regular(path: Path | str) -> BinaryIO:
    """Open a regular file to read its bytes; OSError, whose `strerror` says why, if that is impossible.

    Opening a pipe would wait for a writer, and opening a device may have side effects.
    """
    try:
        _check_regular(os.stat(path))
        # the caller closes it
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | AT_ONCE))  # noqa: SIM115
    # the name contains a NUL
    except ValueError:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from None
    try:
        # a pipe may have taken its place since
        _check_regular(os.fstat(file.fileno()))
    except OSError:
        file.close()
        raise
    return file


def bytes_of(file: BinaryIO, most: int) -> bytes:
    """The content of an open file from its start; OSError if it has more than `most` bytes."""
    size = os.fstat(file.fileno()).st_size
    if size > most:
        raise OSError(errno.EFBIG, f"it has {size} bytes, and may have {most}")
    file.seek(0)
    # not to the end: the file may grow meanwhile
    return file.read(size)


def read_regular(path: Path | str, most: int) -> bytes:
    """The content of a regular file; OSError as by `open_regular`, and if it has more than `most` bytes."""
    with open_regular(path) as file:
        return bytes_of(file, most)


def unpacked(
    path: Path | str, most_bytes: int, most_files: int, wanted: Callable[[str], bool] = lambda _: True
) -> dict[str, bytes]:
    """The files of a zip by their names there, those that are wanted by name; most_bytes bounds what they unpack to.

    OSError as by `open_regular`; ValueError if it is no zip, or holds more.
    """
    with open_regular(path) as packed:
        try:
            with zipfile.ZipFile(packed) as file:
                entries = [e for e in file.infolist() if not e.is_dir() and wanted(e.filename)]
                if len(entries) > most_files or sum(e.file_size for e in entries) > most_bytes:
                    raise ValueError("it unpacks to more than a night")
                # an entry may be longer than it says: read no more than that
                return {e.filename: _opened(file, e) for e in entries}
        # encrypted, or of an unknown compression
        except (RuntimeError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as e:
            raise ValueError(str(e) or "it is cut off") from None


def _opened(file: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    with file.open(entry) as content:
        return content.read(entry.file_size)


def write_whole(path: Path | str, content: bytes) -> None:
    """Write a file so that at any moment, even after a power cut, either the old or the new one is there, whole.

    Where path is a symbolic link, the file is written that it leads to, and the link stays. Folders that are missing are
    made. OSError if the file cannot be written; ValueError if its name contains a NUL.
    """
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    with suppress(FileNotFoundError):
        _check_regular(os.stat(target))
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes a file that only its owner may read
        os.chmod(temporary, 0o644)
        os.replace(temporary, target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    # Windows opens no folder, and keeps names by itself
    with suppress(PermissionError):
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def save(
    path: Path | str, content: bytes, what: str = "the file", error: type[StarposError] = WriteError
) -> None:
    """Write a file as `write_whole` does; an error of one sentence, with the reason, if that is impossible."""
    try:
        write_whole(path, content)
    # ValueError: the name contains a NUL
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or e
        raise error(f"{path}: {what} cannot be written there ({reason})") from None


def has_mark(path: Path | str) -> bool:
    """Whether a file is a page or a picture that starpos has made.  Raises OSError as `open_regular` does."""
    with open_regular(path) as file:
        return MARK in file.read(HEAD)


def path_of(url: str) -> Path:
    """The file that file:///a/b.yaml, package://a/b.yaml, or a path that may begin with ~, names.

    InstrumentError for anything else, and for a package that is not installed.
    """
    if len(url) > LONGEST_PATH:
        raise InstrumentError(
            f"a text of {len(url)} characters names no file: give file:///path/to/file.yaml, or a path"
        )
    try:
        parts = urlsplit(url)
        # one letter is a drive of Windows
        if len(parts.scheme) < 2:
            return Path(url).expanduser()
        if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
            # brings HTTP and TLS along, for which no command should wait that names a file by its path
            from urllib.request import url2pathname

            return Path(url2pathname(parts.path))
        if parts.scheme == "package" and parts.netloc and parts.path:
            return _share_of(parts.netloc) / unquote(parts.path).lstrip("/")
    except (ValueError, RuntimeError):
        # It is no URL, or ~ names a user who does not exist.
        pass
    raise InstrumentError(f"{url!r} names no file: give file:///path/to/file.yaml, or a path")


def _share_of(package: str) -> Path:
    """The share folder of a package of ROS, as ament finds it; InstrumentError where it is not installed."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        if (Path(prefix) / "share/ament_index/resource_index/packages" / package).is_file():
            return Path(prefix) / "share" / package
    raise InstrumentError(
        f"package://{package}: no such package is installed: enter the workspace that has it"
    )


def _check_regular(status: os.stat_result) -> None:
    """Raise OSError unless a status describes a regular file."""
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is a pipe, a socket or a device, no regular file")
