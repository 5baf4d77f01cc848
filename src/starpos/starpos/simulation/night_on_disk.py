# SPDX-License-Identifier: Apache-2.0
"""Writes a simulated night: frames (FITS) or star lists (CSV), tilt.csv, and truth.json to compare a solution with."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from starpos.errors import FrameError
from starpos.files import read_regular
from starpos.frames.frame import Frame
from starpos.frames.header import focal_mm
from starpos.frames.night_files import SIMULATED, TILTS, TRUTH
from starpos.frames.reading import FITS
from starpos.frames.star_list import write_star_list
from starpos.progress import Progress, quiet
from starpos.simulation.scene import Scene, detected, expose, read_tilt, render
from starpos.sky.catalogue import Catalogue
from starpos.utc import date_obs, unix_of

TILT_RATE_HZ = 10.0
MAX_BYTES = 1 << 31


def write_night(
    folder: Path | str,
    scene: Scene,
    catalogue: Catalogue,
    start_utc: str,
    frames: int,
    cadence_s: float,
    exposure_s: float,
    turn_deg: float,
    stars_only: bool,
    rng: np.random.Generator,
    progress: Progress = quiet,
    pixel_um: float = 1.0,
) -> None:
    """Write `frames` exposures of a scene that turns by turn_deg of azimuth from one to the next.

    pixel_um: with the focal length in px it makes the headers' focal length in mm.
    A simulated night that is in the folder is replaced. Raises FrameError if the folder holds frames or tilts that were
    not simulated, or cannot be written.
    """
    begin = unix_of(start_utc)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _take_away_simulated(folder)
        truth, tilts, names = [], [], []
        for k in range(frames):
            now = replace(scene, azimuth_deg=scene.azimuth_deg + k * turn_deg)
            start = begin + k * cadence_s
            stars = expose(now, catalogue, start, exposure_s, rng)
            names.append(f"stars_{k:04d}.csv" if stars_only else f"frame_{k:04d}.fits")
            if stars_only:
                listed = detected(now, stars, start + exposure_s / 2, exposure_s, rng)
                write_star_list(folder / names[-1], listed, date_obs(start), pixel_um)
            else:
                frame = render(now, stars, start, exposure_s, rng)
                write_fits(folder / names[-1], frame, date_obs(start), pixel_um)
            samples = max(1, round(exposure_s * TILT_RATE_HZ))
            for j in range(samples):
                moment = start + (j + 0.5) * exposure_s / samples
                tilts.append((moment, *np.degrees(read_tilt(now, (moment - begin) / 3600, rng)), 15.0))
            truth.append({"start_utc": date_obs(start), "mid_unix_s": start + exposure_s / 2,
                          "heading_deg": float(np.degrees(now.heading)), "stars": len(stars.electrons)})  # fmt: skip
            progress("frames", (k + 1) / frames)
        rows = "".join("{:.6f},{:.7f},{:.7f},{:.2f}\n".format(*row) for row in tilts)
        (folder / TILTS).write_text("utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n" + rows)
        place = {"latitude_deg": scene.site.latitude_deg, "longitude_deg": scene.site.longitude_deg}
        made = {SIMULATED: {name: _digest(folder / name) for name in (*names, TILTS)}}
        (folder / TRUTH).write_text(json.dumps(place | {"frames": truth} | made, indent=1))
    except OSError as e:
        raise FrameError(f"{folder}: the night cannot be written there ({e.strerror})") from None


def _made(folder: Path) -> dict:
    """The files that were simulated, each with its digest; none without a record.  Raises OSError."""
    try:
        said = json.loads(read_regular(folder / TRUTH, MAX_BYTES))
        return {Path(name).name: digest for name, digest in said[SIMULATED].items()}
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, FileNotFoundError):
        return {}


def _take_away_simulated(folder: Path) -> None:
    """Remove the simulated night that a folder holds; FrameError for other or changed files.

    Raises OSError.
    """
    made = _made(folder)
    there = {p.name for p in folder.iterdir() if p.suffix.lower() in (*FITS, ".csv") or p.name == TRUTH}
    strange = [name for name in there - {TRUTH} if made.get(name) != _digest(folder / name)]
    if not made and TRUTH in there:
        strange.append(TRUTH)
    if strange:
        raise FrameError(
            f"{folder / min(strange)}: it is there already, and starpos simulate did not write it in this "
            f"form: "
            "give another folder, or move it away"
        )
    for name in there:
        (folder / name).unlink()


def _digest(path: Path) -> str:
    return hashlib.sha256(read_regular(path, MAX_BYTES)).hexdigest()


def write_fits(path: Path | str, frame: Frame, start_utc: str, pixel_um: float = 1.0) -> None:
    """Write a frame as FITS with DATE-OBS (start of exposure, UTC), EXPTIME and, if known, focal length and shutter."""
    from astropy.io import fits

    header = fits.Header()
    header["DATE-OBS"] = (start_utc, "start of exposure, UTC")
    header["EXPTIME"] = (frame.exposure_s, "s")
    header["ORIGIN"] = ("starpos simulate", "no camera took this frame")
    if frame.focal_px is not None:
        header["FOCALLEN"] = (focal_mm(frame.focal_px, pixel_um), "mm")
        header["XPIXSZ"] = (pixel_um, "um")
    if frame.shutter is not None:
        header["ROLLSHUT"] = (frame.shutter.readout_s, "s from the row read first to the last")
    fits.PrimaryHDU(frame.pixels, header).writeto(path, overwrite=True)
