# SPDX-License-Identifier: Apache-2.0
"""Fetch Tycho-2's original files from a mirror of Debian: resumed where it broke off, checked before they are used."""

import hashlib
import http.client
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from starpos.errors import LETTERS, CatalogueError
from starpos.progress import Progress, quiet
from starpos.table_cache import cache_folder

# The archive of Debian's source package tycho2 (2-4), and where a mirror has it.
ARCHIVE = "tycho2_2.orig.tar.xz"
IN_MIRROR = f"pool/main/t/tycho2/{ARCHIVE}"
SHA256, BYTES = "b0d74bd4280e53f7cfc4b37ccb30a1cfbbc30131907dda81c706bbbab5632dfa", 121_142_216
# Debian's mirror network, and its archive of all former packages.
MIRRORS = "https://deb.debian.org/debian", "https://snapshot.debian.org/archive/debian/20250520T000000Z"
# Time after which a silent server is given up.
SILENCE_S = 30.0
CHUNK_BYTES = 1 << 18
CURE = (
    "check the network, or give another mirror of Debian or the address of the file "
    "(`starpos catalogue deepen --fetch URL`)"
)


def fetch(mirror: str | None = None, progress: Progress = quiet) -> Path:
    """Fetch the archive of the original files into the cache; the caller removes it once it is used.

    mirror: URL of a Debian mirror, or of the file itself (it ends in .xz); None: Debian's own.
    If the connection breaks off, the received part stays, and the next call goes on from there.  Proxies come from the
    environment (https_proxy).  Raises CatalogueError if no mirror has the file, or if its checksum is another one.
    """
    path = cache_folder() / f"{ARCHIVE}.part"
    addresses = [_address(m) for m in ((mirror,) if mirror else MIRRORS)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "ab") as file, _alone(file, path):
            _complete(file, addresses, progress)
    except OSError as e:
        raise CatalogueError(
            f"{path}: cannot be written ({e.strerror}): make room, or set XDG_CACHE_HOME"
        ) from None
    return path


def _address(mirror: str) -> str:
    """The address of the archive on a mirror, or the mirror itself where that is a file."""
    if "://" not in mirror:
        raise CatalogueError(
            f"{mirror}: no URL of a mirror: give one that begins with https://, or `starpos catalogue deepen FILE` "
            "for a file that is here"
        )
    return mirror if mirror.endswith(".xz") else f"{mirror.rstrip('/')}/{IN_MIRROR}"


@contextmanager
def _alone(file: BinaryIO, path: Path) -> Iterator[None]:
    """Let one process write the file, if files can be locked; a killed process holds no lock."""
    with suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CatalogueError(f"{path}: another process fetches it: wait for that one") from None
    yield


def _complete(file: BinaryIO, addresses: list[str], progress: Progress) -> None:
    """Append what a file lacks of the archive, from the first address that has it; CatalogueError if none has."""
    reasons = []
    for address in addresses:
        if reason := _append(file, address, progress):
            reasons.append(f"{address}: {reason}")
        elif _is_right(file):
            return
        else:
            _empty(file)
            reasons.append(f"{address}: the checksum is not that of Tycho-2's original files")
    raise CatalogueError(f"{'; '.join(reasons)}: {CURE}")


def _append(file: BinaryIO, address: str, progress: Progress) -> str:
    """Append what an address has beyond the end of a file; returns why the file is not whole yet, or ''."""
    have = file.tell()
    if have == BYTES:
        return ""
    request = urllib.request.Request(address, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        # urlopen's opener would keep the proxies of its first call
        with urllib.request.build_opener().open(request, timeout=SILENCE_S) as answer:
            # a server that knows no ranges sends all of it
            if have and answer.status != http.client.PARTIAL_CONTENT:
                _empty(file)
            while chunk := answer.read(CHUNK_BYTES):
                if file.tell() + len(chunk) > BYTES:
                    _empty(file)
                    return f"it has more than {BYTES} bytes"
                file.write(chunk)
                progress(f"fetching {ARCHIVE}", file.tell() / BYTES)
    except urllib.error.HTTPError as e:
        return f"the server answers {e.code} {e.reason}"
    except urllib.error.URLError as e:
        return str(getattr(e.reason, "strerror", None) or e.reason)[:LETTERS]
    except (http.client.HTTPException, ssl.SSLError, TimeoutError, ConnectionError) as e:
        return f"the connection broke off ({str(e)[:LETTERS] or type(e).__name__})"
    if file.tell() < BYTES:
        return f"it ended after {file.tell()} of {BYTES} bytes"
    return ""


def _empty(file: BinaryIO) -> None:
    """Remove the content of a file that is open for writing."""
    file.seek(0)
    file.truncate()


def _is_right(file: BinaryIO) -> bool:
    """Whether a file that is open for writing holds the archive."""
    file.flush()
    with open(file.name, "rb") as written:
        digest = hashlib.sha256()
        while chunk := written.read(CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest() == SHA256
