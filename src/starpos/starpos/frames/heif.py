# SPDX-License-Identifier: Apache-2.0
"""Read frames from the bytes of HEIF files (HEIC, HIF), as phones and newer cameras write them, through pillow-heif."""

import io

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.frames import exif
from starpos.frames.files import check_pixels
from starpos.frames.frame import Frame
from starpos.frames.pictures import frame_pixels


def heif_frame(data: bytes, place: str, clock: exif.CameraClock | None = None) -> Frame:
    """Read the first picture of a HEIF file by the rules of `reading.read_frame`; FrameError if it is not one.

    A picture taken in portrait format is turned upright.
    place says where the bytes came from, for messages; clock: of the camera, if it may be trusted.
    """
    try:
        import pillow_heif
    except ImportError:
        raise FrameError(
            f"{place}: reading HEIF needs pillow-heif; run `pip install pillow-heif`, or save it as JPEG."
        ) from None
    try:
        picture = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, bgr_mode=True)
        # it is unpacked only after this
        width, height = picture.size
        check_pixels(width, height, 8.0 if ";16" in picture.mode else 4.0, place)
        pixels = np.array(picture)
        # a TIFF, behind its name
        told = (picture.info.get("exif") or b"").removeprefix(b"Exif\0\0")
    except FrameError:
        raise
    # damaged bytes make libheif raise any kind of exception
    except Exception as e:
        raise FrameError(f"{place}: this is not a whole HEIF picture ({one_line(e)}); copy it again.") from e
    pixels = frame_pixels(pixels, place)
    return Frame(pixels, source=place, **exif.told(told, place, clock, pixels.shape))
