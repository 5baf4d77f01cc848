# SPDX-License-Identifier: Apache-2.0
"""Read frames from FITS files, or from the bytes of one that a camera's driver has sent."""

import configparser
import gzip
import io
import itertools
import math
import re
import warnings
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from starpos import files
from starpos.errors import FrameError, one_line
from starpos.frames.frame import MAX_BYTES, PATTERNS, Frame, check_pixels, to_unsigned
from starpos.frames.header import KEYS, read_exposure

FITS_START, GZIP_START = b"SIMPLE", b"\x1f\x8b"
# Planes of a stack or of a camera of colours.
COLOURS = 3
# Number of the first parts (HDUs) of a file that are searched for an image.
MAX_PARTS = 100
# Columns of a .fz whose cells may be gzip.
TILES = ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA")
# What astropy unpacks safely: a damaged HCOMPRESS_1 ends the whole program, with astropy 6.0 to 8.0 at least.
PACKINGS = ("RICE_1", "RICE_ONE", "GZIP_1", "GZIP_2", "NOCOMPRESS")
STEP = 1 << 20
# zlib's name for data in the form of gzip
GZIP_BITS = 31


def read_fits(file: BinaryIO, place: str, part: str = "") -> tuple[Frame, dict[str, Any]]:
    """Read an open FITS file (also .fz and .gz) by the rules of `reading.read_frame`: the Frame, and its header's KEYS.

    place says where it is, for messages; part is the number or the name of the image to take; "": the first one.
    FrameError if it holds no whole frame.
    """
    from astropy.io import fits

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            plain = _plain(file, place)
            with fits.open(plain, memmap=False, lazy_load_hdus=True) as hdus:
                parts = _parts(hdus)
                primary = parts[0].header if parts else {}
                is_meteor_stack = all(key in primary for key in STACK_KEYS)
                number, others = _image(parts, place, part or (MEAN_OF_STACK if is_meteor_stack else ""))
                header, comments, values = _content(plain, parts, number, place)
                if is_meteor_stack:
                    header = _of_meteor_stack(header, primary, place)
    except FrameError:
        raise
    # damaged bytes make astropy, zlib and CFITSIO raise any kind of exception
    except Exception as e:
        raise FrameError(
            f"{place}: this is not a whole FITS image ({one_line(e)}); take or copy it again."
        ) from e
    if others:
        warnings.warn(
            f"{place}: its HDU {number} is taken, of {1 + len(others)} images; to take another name it, "
            f"like '{place}[{others[0]}]'",
            stacklevel=3,
        )
    pixels, pattern = to_unsigned(values, place), _pattern(header, place)
    return Frame(pixels, pattern=pattern, **read_exposure(header, place, comments).facts), header


def _plain(file: BinaryIO, place: str) -> BinaryIO:
    """The file itself, or unpacked if it is a .gz; ValueError if it is not a FITS file, FrameError if it is too large.

    astropy would unpack it too, and other formats, but to any size.
    """
    if file.read(len(GZIP_START)) == GZIP_START:
        file.seek(0)
        with gzip.GzipFile(fileobj=file) as packed:
            file = io.BytesIO()
            while part := packed.read(STEP):
                file.write(part)
                _check_unpacked(file.tell(), place)
    file.seek(0)
    if file.read(len(FITS_START)) != FITS_START:
        raise ValueError(f"it does not begin with {FITS_START.decode()}")
    file.seek(0)
    return file


def _check_unpacked(size: int, place: str) -> None:
    if size > MAX_BYTES:
        raise FrameError(f"{place}: it unpacks to over {MAX_BYTES // 10**6} MB, too many for a frame.")


# A stack of video frames as the Global Meteor Network's RMS writes it (FF files): maximum, its frame, mean and scatter of
# each pixel. Its mean shows the stars; the number of frames over their rate is the exposure. The rate is in its header,
# or in the station's configuration in the same folder.
STACK_KEYS, MEAN_OF_STACK, RATE = ("NFRAMES", "CAMNO"), "AVEPIXEL", "FPS"
CONFIG, MAX_CONFIG_BYTES = ".config", 1_000_000
# the start of the first frame, UTC, is in its header, or in its name
STACK_NAME = re.compile(
    r"FF_\w+?_(\d{4})(\d\d)(\d\d)_(\d\d)(\d\d)(\d\d)_(\d{3}|\d{6})_\d+\.fits?\b", re.ASCII
)


def _of_meteor_stack(header: Mapping, primary: Mapping, place: str) -> dict[str, Any]:
    """The header of a stack of video frames as the header of one exposure, as far as its times can be read."""
    made = {key: value for key, value in header.items() if key != "NFRAMES"}
    with suppress(OSError, TypeError, ValueError, LookupError, ZeroDivisionError, configparser.Error):
        rate = (
            primary[RATE]
            if RATE in primary
            else rms_config(files.read_regular(Path(place).with_name(CONFIG), MAX_CONFIG_BYTES).decode())[
                "Capture"
            ][RATE]
        )
        made.setdefault("EXPTIME", float(primary["NFRAMES"]) / float(rate))
    if "DATE-OBS" not in made and (named := STACK_NAME.search(place)):
        year, month, day, hour, minute, second, part = named.groups()
        made["DATE-OBS"] = f"{year}-{month}-{day}T{hour}:{minute}:{second}.{part}"
    return made


def rms_config(text: str) -> configparser.ConfigParser:
    """A `.config` of RMS; configparser.Error for another file."""
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), interpolation=None, strict=False)
    parser.read_string(text)
    return parser


def _image(parts: Sequence, place: str, part: str) -> tuple[int, list[int]]:
    """The number of the HDU that is the part, a number or a name, and of other frames if that is empty."""
    if part:
        for number, hdu in enumerate(parts):
            if part.upper() in (str(number), str(hdu.name).upper(), f"{hdu.name},{hdu.ver}".upper()):
                _check_frame(hdu, place)
                return number, []
        names = ", ".join(f"{n} {hdu.name}".strip() for n, hdu in enumerate(parts) if _axes(hdu))
        raise FrameError(f"{place}: there is no such HDU; its images are {one_line(names) or 'none'}.")
    images = [number for number, hdu in enumerate(parts) if _axes(hdu)]
    if not images:
        raise FrameError(f"{place}: there is no image in this FITS file; give one that holds a frame.")
    frames = [number for number in images if _is_frame(_axes(parts[number]))]
    if not frames:
        _check_frame(parts[images[0]], place)
    return frames[0], frames[1:]


def _parts(hdus: Iterable) -> list[Any]:
    """The first HDUs of a file, up to MAX_PARTS; damage behind an image is passed over."""
    parts: list[Any] = []
    try:
        parts.extend(itertools.islice(hdus, MAX_PARTS))
    # damaged bytes make astropy raise any kind of exception
    except Exception:
        if not any(_axes(hdu) for hdu in parts):
            raise
    return parts


def _axes(hdu: Any) -> list[int]:
    """The axes of an HDU's image, the rows before the columns; empty if it is not an image."""
    return [int(n) for n in hdu.shape] if hdu.is_image else []


def _is_frame(axes: list[int]) -> bool:
    """Whether these are the axes of one plane, or of three colours."""
    return len(axes) > 1 and [n for n in axes[:-2] if n != 1] in ([], [COLOURS])


def _check_frame(hdu: Any, place: str) -> None:
    """Raise FrameError unless an HDU is an image of one plane, or of three colours."""
    axes = _axes(hdu)
    if not axes:
        raise FrameError(f"{place}: this HDU is no image; give one that is.")
    if not _is_frame(axes):
        size = " x ".join(map(str, reversed(axes)))
        raise FrameError(
            f"{place}: the image has {len(axes)} axes ({size}); give one plane a file, or three colours."
        )


def _content(
    file: BinaryIO, parts: Sequence, number: int, place: str
) -> tuple[dict[str, Any], dict[str, str], np.ndarray]:
    """Header (a dict of KEYS), comments and data (h, w) of an HDU; what its header lacks comes from the primary one.

    Colours become their mean.
    """
    from astropy.io import fits

    hdu = parts[number]
    shape = _axes(hdu)
    planes = math.prod(shape[:-2])
    check_pixels(shape[-1], shape[-2], planes * abs(int(hdu.header["BITPIX"])) / 8, place)
    if isinstance(hdu, fits.CompImageHDU):
        _check_tiles(file, number, place)
    headers: tuple[Any, ...] = (
        (hdu.header,) if hdu.header.get("INHERIT") is False else (parts[0].header, hdu.header)
    )
    known = {key: header[key] for header in headers for key in KEYS if key in header}
    comments = {key: str(header.comments[key]) for header in headers for key in KEYS if key in header}
    values = np.asarray(hdu.data)
    if planes == 1:
        return known, comments, values.reshape(shape[-2:])
    # its colours are made from the mosaic that the header may still name
    known.pop("BAYERPAT", None)
    return known, comments, values.reshape(planes, *shape[-2:]).mean(0, dtype=np.float32)


def _check_tiles(file: BinaryIO, number: int, place: str) -> None:
    """Raise FrameError if a .fz image, the HDU of this number, is packed otherwise than PACKINGS, or too tightly.

    astropy would unpack gzip cells to any size; more than MAX_BYTES is refused.
    """
    from astropy.io import fits

    file.seek(0)
    # not closed, because that would close the file
    hdu = fits.open(file, memmap=False, lazy_load_hdus=True, disable_image_compression=True)[number]
    packing = str(hdu.header.get("ZCMPTYPE", "")).strip()
    if packing not in PACKINGS:
        raise FrameError(
            f"{place}: it is packed by {packing[:20] or 'no method'}, and a damaged one would end the program; unpack it "
            "with funpack, or pack it with fpack -r."
        )
    table, size = hdu.data, 0
    for cell in itertools.chain.from_iterable(table[name] for name in TILES if name in table.names):
        data = cell.tobytes()
        # other algorithms' cells may begin like gzip, too
        with suppress(zlib.error):
            while data.startswith(GZIP_START):
                packed = zlib.decompressobj(GZIP_BITS)
                while data and not packed.eof:
                    size += len(packed.decompress(data, STEP))
                    _check_unpacked(size, place)
                    data = packed.unconsumed_tail
                data = packed.unused_data


def _pattern(header: Mapping, place: str) -> str:
    """The colour mosaic, in reading order from the first pixel."""
    pattern = str(header.get("BAYERPAT", "")).strip().lower()
    if pattern not in PATTERNS:
        raise FrameError(f"{place}: BAYERPAT is {pattern!r}; it must be RGGB, BGGR, GRBG or GBRG.")
    try:
        right, down = (int(header.get(key, 0)) % 2 for key in ("XBAYROFF", "YBAYROFF"))
    except (TypeError, ValueError, OverflowError):
        raise FrameError(f"{place}: XBAYROFF or YBAYROFF is no whole number; correct the header.") from None
    if right and pattern:
        pattern = pattern[1::-1] + pattern[:1:-1]
    return pattern[2:] + pattern[:2] if down else pattern
