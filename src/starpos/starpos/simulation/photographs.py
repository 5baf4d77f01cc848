# SPDX-License-Identifier: Apache-2.0
"""Photographs as a telephone with Apple's maker's note writes them, of a simulated sky."""

import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from starpos.errors import FrameError
from starpos.progress import Progress, quiet
from starpos.rotation import from_vector
from starpos.simulation.scene import Optics, Scene, expose, render, scene_of
from starpos.sky.catalogue import Catalogue
from starpos.units import date_obs, unix_of

WIDTH, HEIGHT, FOCAL_MM, PIXEL_UM, FILM_MM = 4032, 3024, 4.25, 1.4, 26
# a lens of 2.4 mm under the sky of a village
OPTICS = Optics(
    fwhm_px=2.2,
    zero_point_e_s=4.0e4,
    sky_mag_arcsec2=19.0,
    read_noise_e=3.0,
    bias_dn=100.0,
    full_well_dn=60000.0,
    seeing_arcsec=3.0,
    limit_mag=6.8,
)
EXPOSURE_TENTHS_S, CADENCE_S = 11, 20.0
# azimuth from the first, altitude and roll, deg: three directions, upright and on its side
POSES_DEG = ((0.0, 60.0, 90.0), (-40.0, 55.0, 0.0), (40.0, 65.0, 180.0), (10.0, 70.0, 270.0))
# 1 sigma of the accelerometer about each axis: of the telephone (zero and axes), and from photograph to photograph
LEVEL_DEG, READING_DEG = 0.35, 0.05
# of eight bits: the sky's level, and steps an electron
BLACK, STEPS_PER_ELECTRON, QUALITY = 12.0, 1.5, 93
# types of TIFF's values
ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 2, 3, 4, 5, 7, 10
Tags = Mapping[int, tuple[int, int, bytes]]


def telephone_at(latitude_deg: float, longitude_deg: float, azimuth_deg: float) -> Scene:
    """A telephone's main camera at a place, deg, that looks to an azimuth with its first photograph."""
    azimuth, altitude, roll = POSES_DEG[0]
    scene = scene_of(
        (WIDTH, HEIGHT),
        FOCAL_MM * 1000 / PIXEL_UM,
        latitude_deg,
        longitude_deg,
        pointing_deg=(azimuth_deg + azimuth, altitude, roll),
    )
    return replace(scene, optics=OPTICS)


def write_photographs(
    folder: Path | str,
    scene: Scene,
    catalogue: Catalogue,
    start_utc: str,
    rng: np.random.Generator,
    progress: Progress = quiet,
) -> list[Path]:
    """Write IMG_0001.JPG ... of a telephone (`telephone_at`), a photograph for each of POSES_DEG; returns their paths.

    The errors of its accelerometer are drawn, LEVEL_DEG for all and READING_DEG for each.  FrameError if a file cannot be
    written.
    """
    folder, begin = Path(folder), unix_of(start_utc)
    level = rng.normal(0, np.radians(LEVEL_DEG), 3)
    written = []
    for k, (azimuth_deg, altitude_deg, roll_deg) in enumerate(POSES_DEG):
        now = replace(
            scene, azimuth_deg=scene.azimuth_deg + azimuth_deg, altitude_deg=altitude_deg, roll_deg=roll_deg
        )
        start, exposure_s = begin + k * CADENCE_S, EXPOSURE_TENTHS_S / 10
        frame = render(now, expose(now, catalogue, start, exposure_s, rng), start, exposure_s, rng)
        light = frame.pixels.astype(np.float32) - np.median(frame.pixels[::16, ::16])
        grey = np.clip(BLACK + STEPS_PER_ELECTRON * light, 0, 255).astype(np.uint8)
        felt = from_vector(level + rng.normal(0, np.radians(READING_DEG), 3)) @ now.attitude[2]
        path = folder / f"IMG_{k + 1:04d}.JPG"
        _, jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_with_exif(jpeg.tobytes(), date_obs(start), felt))
        except OSError as e:
            raise FrameError(f"{path}: it cannot be written ({e.strerror})") from None
        written.append(path)
        progress("photographs", (k + 1) / len(POSES_DEG))
    return written


def _with_exif(jpeg: bytes, start_utc: str, up: np.ndarray) -> bytes:
    """A JPEG with the EXIF of a telephone; up (3,): unit vector in C that its accelerometer felt."""
    day, _, rest = start_utc.partition("T")
    seconds, _, fraction = rest.partition(".")
    note = _apples_note(up)
    exif: Tags = {
        0x829A: (RATIONAL, 1, struct.pack(">II", EXPOSURE_TENTHS_S, 10)),
        0x9003: _text(f"{day.replace('-', ':')} {seconds}"),
        0x9011: _text("+00:00"),
        0x920A: (RATIONAL, 1, struct.pack(">II", round(100 * FOCAL_MM), 100)),
        0x927C: (UNDEFINED, len(note), note),
        0x9291: _text(fraction[:3]),
        0xA405: (SHORT, 1, struct.pack(">H", FILM_MM)),
    }
    first: dict[int, tuple[int, int, bytes]] = {
        0x010F: _text("Apple"),
        0x0110: _text("starpos demo: no telephone took this"),
        0x8769: (LONG, 1, bytes(4)),
    }
    below_at = 8 + len(_directory(first, 8))
    first[0x8769] = LONG, 1, struct.pack(">I", below_at)
    block = b"Exif\0\0MM\0*" + struct.pack(">I", 8) + _directory(first, 8) + _directory(exif, below_at)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:]


def _apples_note(up: np.ndarray) -> bytes:
    """The maker's note with gravity in the telephone's axes: the picture's columns run along -y, its rows along -x."""
    head, (x, y, z) = b"Apple iOS\0\0\1MM", up
    numbers = b"".join(struct.pack(">ii", round(g * 1e6), 10**6) for g in (y, x, z))
    return head + _directory({8: (SRATIONAL, 3, numbers)}, len(head))


def _directory(tags: Tags, at: int) -> bytes:
    """A directory of TIFF 6.0 that begins at byte `at`, and after it the values of more than four bytes."""
    entries, beyond = b"", b""
    after = at + 2 + 12 * len(tags) + 4
    for tag, (kind, count, value) in sorted(tags.items()):
        held = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(">I", after + len(beyond))
        beyond += value if len(value) > 4 else b""
        entries += struct.pack(">HHI", tag, kind, count) + held
    return struct.pack(">H", len(tags)) + entries + bytes(4) + beyond


def _text(words: str) -> tuple[int, int, bytes]:
    return ASCII, len(words) + 1, words.encode("ascii") + b"\0"
