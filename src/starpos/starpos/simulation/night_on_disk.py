# SPDX-License-Identifier: Apache-2.0
"""Writes a simulated night: frames (FITS) or star lists (CSV), tilt.csv, and truth.json to compare a solution with."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from starpos.errors import FrameError
from starpos.frames.frame import Frame
from starpos.frames.star_list import write_star_list
from starpos.progress import Progress, quiet
from starpos.simulation.scene import Scene, detected, expose, read_tilt, render
from starpos.sky.catalogue import Catalogue
from starpos.utc import unix_of

TILT_RATE_HZ = 10.0


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
) -> None:
    """Write `frames` exposures of a scene that turns by turn_deg of azimuth from one to the next.

    Raises FrameError if the folder cannot be written.
    """
    begin = unix_of(start_utc)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        truth, tilts = [], []
        for k in range(frames):
            now = replace(scene, azimuth_deg=scene.azimuth_deg + k * turn_deg)
            start = begin + k * cadence_s
            stars = expose(now, catalogue, start, exposure_s, rng)
            if stars_only:
                listed = detected(now, stars, start + exposure_s / 2, exposure_s, rng)
                write_star_list(folder / f"stars_{k:04d}.csv", listed, _text(start))
            else:
                write_fits(
                    folder / f"frame_{k:04d}.fits", render(now, stars, start, exposure_s, rng), _text(start)
                )
            samples = max(1, round(exposure_s * TILT_RATE_HZ))
            for j in range(samples):
                moment = start + (j + 0.5) * exposure_s / samples
                tilts.append((moment, *np.degrees(read_tilt(now, (moment - begin) / 3600, rng)), 15.0))
            truth.append({"start_utc": _text(start), "mid_unix_s": start + exposure_s / 2,
                          "heading_deg": float(np.degrees(now.heading)), "stars": len(stars.electrons)})  # fmt: skip
            progress("frames", (k + 1) / frames)
        rows = "".join("{:.6f},{:.7f},{:.7f},{:.2f}\n".format(*row) for row in tilts)
        (folder / "tilt.csv").write_text("utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n" + rows)
        place = {"latitude_deg": scene.site.latitude_deg, "longitude_deg": scene.site.longitude_deg}
        (folder / "truth.json").write_text(json.dumps(place | {"frames": truth}, indent=1))
    except OSError as e:
        raise FrameError(f"{folder}: the night cannot be written there ({e.strerror})") from None


def _text(unix_s: float) -> str:
    """UTC in the form of FITS' DATE-OBS, to the microsecond."""
    import datetime

    moment = datetime.datetime.fromtimestamp(round(unix_s, 6), datetime.timezone.utc)
    return moment.strftime("%Y-%m-%dT%H:%M:%S.%f")


def write_fits(path: Path | str, frame: Frame, start_utc: str) -> None:
    """Write a frame as FITS with DATE-OBS (start of exposure, UTC), EXPTIME and, if known, focal length and shutter."""
    from astropy.io import fits

    header = fits.Header()
    header["DATE-OBS"] = (start_utc, "start of exposure, UTC")
    header["EXPTIME"] = (frame.exposure_s, "s")
    if frame.focal_px is not None:
        header["FOCALLEN"] = (frame.focal_px / 1000, "mm, at 1 um pixels")
        header["XPIXSZ"] = (1.0, "um")
    if frame.shutter is not None:
        header["ROLLSHUT"] = (frame.shutter.readout_s, "s from the row read first to the last")
    fits.PrimaryHDU(frame.pixels, header).writeto(path, overwrite=True)
