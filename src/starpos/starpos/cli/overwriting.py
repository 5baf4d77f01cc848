# SPDX-License-Identifier: Apache-2.0
"""Files that options name to be written: refused, before the work, if they would replace files of another kind."""

import argparse
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from starpos import files
from starpos.cli import console
from starpos.errors import CatalogueError, InstrumentError, WriteError
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.sky import catalogue

# options that name files to be read
INPUTS = ("frames", "tilt", "pointings", "sights", "imu", "geoid", "gaia")
# the name in the camera's file, which the camera node uses
CAMERA_NAME = "camera"
# 'a.fits[2]' is an image in the file a.fits
HDU = re.compile(r"\[[^]]*\]$")


def check(args: argparse.Namespace, **kinds: Callable[[Path], None]) -> None:
    """Raise InstrumentError unless the files may be written that options name; an option that is not given names none.

    An existing file may be replaced if it is of the kind that the command writes. An input may not, and no two outputs
    may be one file. The file of --instrument may: it keeps everything that was not found anew.

    kinds: by option, what raises InstrumentError, without advice, unless an existing file may be replaced.
    """
    read, names = set(_inputs(args)), set()
    for option, check_kind in kinds.items():
        if (name := getattr(args, option)) is None:
            continue
        path, real = Path(name), os.path.realpath(name)
        instead = f"give another --{option}"
        if real in read:
            raise InstrumentError(f"{path}: --{option} would replace what is read: {instead}")
        if real in names:
            raise InstrumentError(f"{path}: two options would write it: {instead}")
        names.add(real)
        try:
            if path.exists():
                check_kind(path)
        except InstrumentError as e:
            raise InstrumentError(f"{e}: move it away, or {instead}") from None
        # ValueError: the name contains a NUL
        except (OSError, ValueError) as e:
            reason = getattr(e, "strerror", None) or e
            raise InstrumentError(f"{path}: the file cannot be written there ({reason}): {instead}") from None


def _inputs(args: argparse.Namespace) -> Iterator[str]:
    """Real paths of what a command reads."""
    for name in INPUTS:
        given = getattr(args, name, None) or ()
        for path in [given] if isinstance(given, str) else given:
            yield os.path.realpath(path)
            yield os.path.realpath(HDU.sub("", path))


def camera(path: Path) -> None:
    """The check of a camera's calibration file."""
    if not instrument_file.camera_as_written(path, CAMERA_NAME):
        raise _there(path, "starpos calibrate did not write it in this form")


def never(path: Path) -> None:
    """The check of a file that holds other programs' work too: it is never replaced."""
    raise InstrumentError(f"{path}: it is there already, and may hold more than starpos writes")


def ours(path: Path) -> None:
    """The check of a page, a picture or a file of places, which names the program that made it."""
    if not (path.is_file() and files.has_mark(path)):
        raise _there(path, "not of starpos")


def check_folder(folder: Path) -> None:
    """Raise WriteError, before a night is worked on, where its report could not be written; leaves nothing behind."""
    made: list[Path] = []
    try:
        made = [path for path in (folder, *folder.parents) if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    # ValueError: the name contains a NUL
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or e
        raise WriteError(
            f"{folder}: the report cannot be written there ({reason}): give another --out"
        ) from None
    finally:
        for path in made:
            with suppress(OSError):
                path.rmdir()


def picture(path: Path) -> None:
    """The check of a picture: a PNG names the program that made it."""
    if not (path.is_file() and path.suffix.lower() == ".png" and files.has_mark(path)):
        raise _there(path, "not a picture made by starpos")


def stars(path: Path) -> None:
    """The check of a catalogue."""
    try:
        catalogue.load_catalogue(str(path))
    except CatalogueError:
        raise _there(path, "not a catalogue made by starpos") from None


def save_instrument(name: str, found: Instrument, about: str, *, camera_found: bool = False) -> None:
    """Write A3 into an instrument file, new or there already; raises InstrumentError."""
    instrument_file.update(Path(name), found, about, camera_found=camera_found)
    if arcsec := instrument_file.read(name, needs_camera=False).calibration.remounted_arcsec:
        console.complain(
            f"{name} keeps remounted_arcsec: {arcsec:g}: A3 is new, so take it out unless you remount again"
        )


def _there(path: Path, why: str) -> InstrumentError:
    return InstrumentError(f"{path}: it is there already, and {why}")
