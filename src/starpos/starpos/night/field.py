# SPDX-License-Identifier: Apache-2.0
"""A field report: a night in one small file, to be sent by those who have hardware.

It holds lists of stars, tilts, the instrument, the air, versions, and the truth where the night has one. It holds no
picture, no path, no name of a file, camera, computer or person, and no serial number: only what is named here is written.
"""

import io
import json
import platform
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import degrees, hypot
from pathlib import Path

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError
from starpos.files import save, unpacked
from starpos.frames.frame import Stars
from starpos.frames.tables import SIMULATED, TILTS, TRUTH, write_star_list
from starpos.instrument import instrument_file
from starpos.instrument.inclinometer import EITHER_WAY
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.night.night import Truth
from starpos.night.reading import TiltFile, stars_of
from starpos.night.solving import Exposures
from starpos.progress import Progress, quiet
from starpos.units import date_obs

ABOUT, INSTRUMENT = "field.json", "instrument.yaml"
FORMAT = 1
SUFFIX = ".zip"
# A night of 10,000 lists of 1000 stars; a file that unpacks to more is not ours.
MAX_BYTES, MAX_FILES = 400_000_000, 20_000
PACKAGES = ("starpos", "numpy", "scipy", "astropy", "astropy-iers-data", "pyerfa", "opencv-python-headless")


def write(path: Path, exposures: Exposures, progress: Progress = quiet) -> int:
    """Write the night of these exposures; returns how many frames it holds.

    Raises FrameError for a night without a usable frame or tilt, WriteError if the file cannot be written.
    """
    tilts = exposures.work.tilts
    log = tilts.log if isinstance(tilts, TiltFile) else tilts
    if isinstance(log, TiltLog) and log.either_way:
        raise FrameError(f"{exposures.name}: {EITHER_WAY}")
    if not isinstance(log, TiltLog):
        raise FrameError(f"{exposures.name}: no tilts: a field report needs the night's tilts")
    instrument, unreadable, packed = None, 0, io.BytesIO()
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base)
        for k, (_, stars) in enumerate(exposures.each(stars_of)):
            progress(exposures.name[:20], (k + 1) / exposures.count)
            if isinstance(stars, FrameError) or stars.mid_unix_s is None or not stars.exposure_s:
                unreadable += 1
                continue
            instrument = _with_clock(instrument or exposures.work.instruments.of(stars), stars)
            begin = date_obs(stars.mid_unix_s - stars.exposure_s / 2)
            write_star_list(folder / f"stars_{k:04d}.csv", stars, begin)
        if instrument is None:
            raise FrameError(f"{exposures.name}: no frame of it has stars, a time and a known focal length")
        instrument_file.write(folder / INSTRUMENT, instrument)
        (folder / TILTS).write_bytes(_tilt_table(log).encode())
        (folder / ABOUT).write_bytes(json.dumps(_about(exposures, unreadable), indent=1).encode())
        if exposures.truth is not None:
            (folder / TRUTH).write_bytes(json.dumps(_truth(exposures.truth)).encode())
        files = sorted(folder.iterdir())
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
            for each in files:
                # a date of its own would reveal the computer's clock and zone
                file.writestr(zipfile.ZipInfo(each.name), each.read_bytes(), zipfile.ZIP_DEFLATED)
    save(path, packed.getvalue(), "the field report")
    return sum(each.name.startswith("stars_") for each in files)


def check_name(path: str) -> None:
    """Raise FrameError unless the name of --field ends as a field report's does."""
    if not path.lower().endswith(SUFFIX):
        raise FrameError(f"--field {path}: give it a name that ends in {SUFFIX}")


def is_field(path: Path | str) -> bool:
    """Whether a path looks like a field report."""
    return str(path).lower().endswith(SUFFIX) and Path(path).is_file()


@contextmanager
def opened(path: Path | str) -> Iterator[tuple[Path, Atmosphere]]:
    """Unpack a field report as a night's folder, which lasts as long as the context, and give the air it states.

    Raises FrameError for another file.
    """
    with tempfile.TemporaryDirectory() as base:
        folder = Path(base) / Path(path).stem
        folder.mkdir()
        try:
            for name, content in unpacked(path, MAX_BYTES, MAX_FILES).items():
                if not _ours(name):
                    raise ValueError(f"it holds {name[:40]!r}")
                (folder / name).write_bytes(content)
            about = json.loads((folder / ABOUT).read_text("utf-8"))
            if about["starpos_field"] != FORMAT:
                raise ValueError(f"its format is {about['starpos_field']!r}, and this starpos reads {FORMAT}")
            air = Atmosphere(**about["air"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            why = getattr(error, "strerror", None) or error
            raise FrameError(f"{path}: not a field report of starpos ({why})") from None
        yield folder, air


def _ours(name: str) -> bool:
    stars = name.startswith("stars_") and name.endswith(".csv") and name[6:-4].isdecimal()
    return stars or name in (ABOUT, INSTRUMENT, TILTS, TRUTH)


def _with_clock(instrument: Instrument | None, stars: Stars) -> Instrument | None:
    """The instrument with a clock at least as bad as this frame's time: a list of stars states no error of its own."""
    if instrument is None:
        return None
    stddev_s = hypot(stars.stamp_stddev_s, stars.clock_stddev_s)
    return replace(instrument, clock_stddev_s=max(instrument.clock_stddev_s, stddev_s))


def _tilt_table(log: TiltLog) -> str:
    sigma_deg = np.degrees(np.sqrt(np.trace(log.covariance, axis1=1, axis2=2) / 2))
    columns = {
        "utc_unix_s": log.utc_unix_s,
        "theta_x_deg": np.degrees(log.theta_x),
        "theta_y_deg": np.degrees(log.theta_y),
    }
    if log.theta_z is not None and np.isfinite(log.theta_z).all():
        columns["theta_z_deg"] = np.degrees(log.theta_z)
    if np.isfinite(log.temperature_c).all():
        columns["temperature_c"] = log.temperature_c
    columns["sigma_deg"] = sigma_deg
    rows = zip(*columns.values(), strict=True)
    return ",".join(columns) + "\n" + "".join(",".join(f"{v:.9f}" for v in row) + "\n" for row in rows)


def _about(exposures: Exposures, unreadable: int) -> dict:
    return {
        "starpos_field": FORMAT,
        "versions": {"python": platform.python_version(), "machine": platform.machine()} | dict(_versions()),
        "air": vars(exposures.work.atmosphere),
        "frames_left_out": unreadable,
    }


def _versions() -> Iterator[tuple[str, str]]:
    # it takes long to load, and `starpos solve` has no use for it
    from importlib.metadata import PackageNotFoundError, version

    for package in PACKAGES:
        try:
            yield package, version(package)
        except PackageNotFoundError:
            continue


def _truth(truth: Truth) -> dict:
    frames = [{"mid_unix_s": at, "heading_deg": degrees(heading)} for at, heading in truth.headings]
    place = {"latitude_deg": degrees(truth.latitude), "longitude_deg": degrees(truth.longitude)}
    return place | {"frames": frames, SIMULATED: truth.simulated}
