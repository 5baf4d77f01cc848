# SPDX-License-Identifier: Apache-2.0
"""A night in a folder: frames or lists of stars, tilt.csv, maybe truth.json; `starpos.open_night` opens one."""

import json
import os
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection, Vertical
from starpos.errors import FrameError, TiltError
from starpos.files import open_regular, read_regular
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Stars
from starpos.frames.gravity import PHONE
from starpos.frames.reading import FITS, HEIF, JPEG, PICTURE, RAW, are_photographs
from starpos.frames.tables import GNSS, SIMULATED, TILTS, TRUTH
from starpos.instrument import instrument_file, sensors
from starpos.instrument.instrument import ByGravity, Calibration, Instrument
from starpos.instrument.phone_log import is_phone_log
from starpos.instrument.tilt_log import Tilts, TiltsByTime
from starpos.night.night import Night, Truth
from starpos.night.reading import Instruments, Reader, TiltFile
from starpos.night.remarks import of_gravity, of_tilts
from starpos.night.solving import Exposures, How, solved_night
from starpos.night.work import Solving
from starpos.progress import Progress, quiet

if TYPE_CHECKING:
    from starpos.gnss.receiver import GnssTrack

TRUTH_LIMIT = 1 << 26


def exposures(
    folder: Path,
    given: Instruments,
    atmosphere: Atmosphere,
    vertical: Vertical,
    place: Place | None = None,
    read: Reader | None = None,
    frames: Sequence[Path] = (),
) -> Exposures:
    """The frames of a folder in the order of their names, to be solved.

    frames: these of it; without any, all. Photographs without tilt.csv have their own gravity.

    read: with a camera's clock, for the times of pictures; None for files that state their time.

    place: a known place, where each frame has a heading. If tilt.csv is missing, only headings are computed there;
    without a known place each frame reports that it is missing.

    Raises FrameError if there are no frames, or truth.json cannot be used.
    """
    frames, read = frames or frames_in(folder), read or Reader()
    tilts: Path | ByGravity | None = folder / TILTS
    if not (folder / TILTS).exists() and (place is not None or are_photographs(frames)):
        tilts = None if place is not None else ByGravity()
    if by_gravity := isinstance(tilts, ByGravity):
        # a new reader, which has not kept a frame without its time
        read = Reader(read.clock or CameraClock(), read.delay_s)
    first = read.first(list(map(str, frames)), by_gravity)
    work, remarks = Solving(given, atmosphere=atmosphere, places=place), tuple[str, ...]()
    if first is not None:
        try:
            work, remarks = work_of(given, first, tilts, atmosphere, place)
        except TiltError as error:
            work, remarks = work_of(given, first, None, atmosphere, place)
            work = replace(work, tilts=TiltsByTime(why=str(error)))

    kind = "lists of stars" if frames[0].suffix == ".csv" else "frames"
    return Exposures(
        name=frames[0].name if len(frames) == 1 else folder.resolve().name or str(folder),
        origin=f"solved from {len(frames)} {kind} and {'the gravity in their files' if by_gravity else TILTS}",
        count=len(frames),
        each=lambda work: ((Path(path).name, a) for path, a in read.each([*map(str, frames)])(work)),
        work=work,
        vertical=vertical,
        truth=truth_in(folder),
        remarks=remarks,
    )


def work_of(
    given: Instruments,
    first: Stars,
    tilts: Path | ByGravity | None,
    atmosphere: Atmosphere,
    place: Place | None = None,
) -> tuple[Solving, tuple[str, ...]]:
    """The work on the frames of a night whose first one is known, and what looks wrong.

    tilts: their table, or that photographs have their own; None where none is needed.  Raises TiltError if the table
    cannot be read.
    """
    known, said = given.instrument, list[str]()
    by_log = isinstance(tilts, Path) and is_phone_log(tilts) and first.upper_edge is not None
    # a telephone's log has its camera's axes, unless another A3 is stated
    by_log = by_log and (known is None or known.calibration.unknown)
    if by_log or isinstance(tilts, ByGravity):
        model = PHONE if by_log or first.gravity is None else first.gravity.model
        known = None if known is None else known.levelled_by(model)
        if known is not None and (by_log or first.gravity is not None):
            said.append(of_gravity(known, by_log))
    instruments, doubt = replace(given, instrument=known).framed(first)
    level: Tilts | None = None if isinstance(tilts, Path) else tilts
    if isinstance(tilts, ByGravity) and first.gravity is not None:
        level = replace(tilts, camera=first.gravity.camera)
    if isinstance(tilts, Path):
        known = instruments.instrument
        errors = sensors.unnamed() if known is None else known.inclinometer
        table = TiltFile(os.path.abspath(tilts), errors.noise_rad)
        said.append(of_tilts(table.log, str(tilts), errors))
        level = ByGravity(table) if by_log else table
    work = Solving(instruments, atmosphere=atmosphere, tilts=level, places=place)
    return work, tuple(filter(None, (*said, doubt)))


def frames_in(folder: Path) -> list[Path]:
    """Paths of the frames in a folder by name, at least one; raises FrameError without any.

    FITS, or else lists of stars, or else pictures and raw files; a JPEG with the name of another file is its copy.
    """
    try:
        files = sorted(p for p in folder.iterdir() if p.is_file())
    except OSError as e:
        raise FrameError(f"{folder}: the folder cannot be read ({e.strerror})") from None
    frames = [p for p in files if p.suffix.lower() in FITS]
    tables = [p for p in files if p.suffix.lower() == ".csv" and p.name not in (TILTS, GNSS)]
    frames = frames or (tables if any(map(_is_star_list, tables)) else [])
    # without a list of stars, tables among pictures are no frames
    frames = frames or _pictures_among(files) or tables
    if not frames:
        raise FrameError(
            f"{folder}: no frames in it: a night is a folder of frames (FITS, raw, HEIC, TIFF, PNG, JPEG, or CSV lists "
            f"of stars) and {TILTS}"
        )
    return frames


def _is_star_list(path: Path) -> bool:
    """Whether a CSV begins as a list of stars does."""
    try:
        with open_regular(path) as file:
            return file.read(16).lstrip(b"# ").startswith(b"{")
    # its reader reports why
    except OSError:
        return True


def _pictures_among(files: Sequence[Path]) -> list[Path]:
    """Pictures and raw files by name, each name once: a JPEG with the name of another one is its copy."""
    best: dict[str, Path] = {}
    for suffixes in (RAW, PICTURE, HEIF, JPEG):
        for path in files:
            if path.suffix.lower() in suffixes:
                best.setdefault(path.stem, path)
    return sorted(best.values())


def truth_in(folder: Path) -> Truth | None:
    """The truth from truth.json (latitude_deg, longitude_deg, mid_unix_s and heading_deg of frames); None without it.

    Raises FrameError if the file cannot be read or holds something else.
    """
    path = folder / TRUTH
    if not path.is_file():
        return None
    try:
        content = json.loads(read_regular(path, TRUTH_LIMIT))
        place = [float(content[k]) for k in ("latitude_deg", "longitude_deg")]
        simulated = bool(content.get(SIMULATED))
        frames = content.get("frames", [])
        headings = tuple((float(f["mid_unix_s"]), float(np.radians(f["heading_deg"]))) for f in frames)
        if not (np.isfinite(place).all() and np.isfinite(headings).all() and abs(place[0]) <= 90):
            raise ValueError
    except OSError as e:
        raise FrameError(f"{path}: it cannot be read ({e.strerror})") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise FrameError(
            f"{path}: not what is true of a night: give latitude_deg and longitude_deg, or take the file away"
        ) from None
    latitude, longitude = np.radians(place).tolist()
    return Truth(latitude, longitude, headings, simulated)


@dataclass(frozen=True)
class NightOnDisk:
    """A folder of frames with tilt.csv, its instrument and air as far as `open_night` got them; `solve` solves it.

    Attributes
    ----------
    folder, count : where the frames are, and how many
    instrument : as given, or of the folder's file; None: by each frame's header
    calibration, inclinometer : as given in place of the instrument's; None, '': the instrument's
    atmosphere, vertical : of refraction, and the deflection of the vertical
    place : where the frames were taken, for headings alone; None: it is sought

    Examples
    --------
    >>> night = starpos.open_night("night", instrument="instrument.yaml")
    >>> night.count, len(night.solve().shots)
    (5, 5)
    """

    folder: Path
    _: KW_ONLY
    count: int
    instrument: Instrument | None
    calibration: Calibration | None
    inclinometer: str
    atmosphere: Atmosphere
    vertical: Vertical
    place: Place | None = None

    def __repr__(self) -> str:
        return f"<{self.folder}: {self.count} frames and {TILTS}, to be solved>"

    def solve(
        self,
        self_calibrate: bool = False,
        turn_stddev_deg: float = 180.0,
        progress: Progress = quiet,
        *,
        gnss: "str | Path | GnssTrack | None" = None,
    ) -> Night:
        """The place, and the fix of each frame; a frame's fault is its status.

        self_calibrate: find A3 too, from frames of one place at several headings; turn_stddev_deg: sigma of the given
        A3's turn about the plumb line.  gnss: a receiver's places, or the path of their table: they teach the
        instrument, and `Night.watched` compares them with the stars.

        Raises StarposError where the folder or the instrument cannot be used.
        """
        given, sought = self.instrument, False
        if given is None:
            first = Reader().first(list(map(str, frames_in(self.folder))))
            # each frame's own counts; without any, the frame says so
            given = None if first is None or first.focal_px is None else Instrument(first.focal_px)
            if sought := first is not None and first.focal_px is None and first.gravity is not None:
                given = Instrument(float(max(first.width, first.height)))
        if given is not None and self.calibration is not None:
            given = replace(given, calibration=self.calibration)
        if given is not None and self.inclinometer:
            model, errors = sensors.find(self.inclinometer)
            given = replace(given, inclinometer=errors, inclinometer_model=model)
        instruments = Instruments(given, by_header=self.instrument is None, sought=sought)
        night = exposures(self.folder, instruments, self.atmosphere, self.vertical, self.place)
        if isinstance(gnss, (str, Path)):
            from starpos.gnss.receiver import read_gnss_csv

            gnss, left_out = read_gnss_csv(gnss)
            night = replace(night, remarks=(*night.remarks, *left_out))
        return solved_night(night, How(turn_stddev_deg if self_calibrate else None, gnss), progress)


def open_night(
    folder: str | Path,
    *,
    instrument: Instrument | str | Path | None = None,
    calibration: Calibration | None = None,
    inclinometer: str = "",
    atmosphere: Atmosphere | None = None,
    vertical: Vertical | None = None,
    place: Place | None = None,
) -> NightOnDisk:
    """A night: a folder of frames (FITS, or else CSV lists of stars, or else pictures), with tilt.csv; not read yet.

    Parameters
    ----------
    folder : of the night
    instrument : or the path of its file (YAML); None if the frames' headers have the focal length
    calibration : A3 in place of the instrument's; without a known A3 the position error exceeds 1000 km, unless the night
        is solved with self_calibrate=True
    inclinometer : name of its model, in place of the instrument's; without a name or stated errors it counts as an
        SCA100T as sold, 7 km or more
    atmosphere : None: not measured
    vertical : its deflection; None: not known
    place : where the instrument is known to be: each frame's `Shot.at_place` is its heading there, and tilt.csv may lack

    Returns
    -------
    NightOnDisk
        its `solve` gives a Night

    Raises
    ------
    StarposError
        there is no frame, or the instrument's file cannot be used

    Examples
    --------
    >>> starpos.open_night("night", instrument="instrument.yaml")
    <night: 5 frames and tilt.csv, to be solved>
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FrameError(f"{folder}: there is no such folder: give one of frames and {TILTS}")
    if isinstance(instrument, (str, Path)):
        instrument = instrument_file.read(instrument)
    return NightOnDisk(
        folder,
        count=len(frames_in(folder)),
        instrument=instrument,
        calibration=calibration,
        inclinometer=inclinometer,
        atmosphere=Atmosphere.measured(None, None) if atmosphere is None else atmosphere,
        vertical=Deflection() if vertical is None else vertical,
        place=place,
    )
