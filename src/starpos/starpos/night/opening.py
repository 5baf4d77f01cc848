# SPDX-License-Identifier: Apache-2.0
"""A night on disk for programs and notebooks: `starpos.open_night`."""

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

from starpos.earth.known_place import KnownPlace
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection, Vertical
from starpos.errors import FrameError
from starpos.frames.night_files import TILTS
from starpos.instrument import instrument_file, sensors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.night.folder import exposures, frames_in
from starpos.night.night import Night
from starpos.night.reading import First, Given, Reader
from starpos.night.solving import solved_night
from starpos.progress import Progress, quiet


@dataclass(frozen=True)
class NightOnDisk:
    """A folder of frames with tilt.csv, its instrument and air as far as known; `solve` solves it.

    instrument: None if the frames' headers have the focal length.  calibration: A3 in place of the instrument's.
    inclinometer: name of its model in place of the instrument's; '' for the instrument's.
    """

    folder: Path
    _: KW_ONLY
    count: int
    instrument: Instrument | None
    calibration: Calibration | None
    inclinometer: str
    atmosphere: Atmosphere
    vertical: Vertical
    place: KnownPlace | None = None

    def __repr__(self) -> str:
        return f"<{self.folder}: {self.count} frames and {TILTS}, to be solved>"

    def solve(
        self, self_calibrate: bool = False, turn_stddev_deg: float = 180.0, progress: Progress = quiet
    ) -> Night:
        """The place, and the fix of each frame; a frame's fault is its status.

        self_calibrate: find A3 too, from frames of one place at several headings; turn_stddev_deg: sigma of the given
        A3's turn about the plumb line.  Raises StarposError where the folder or the instrument cannot be used.
        """
        given = self.instrument
        if given is None:
            first = First(Reader())(tuple(map(str, frames_in(self.folder))))
            # each frame's own counts; without any, the frame says so
            given = None if first is None or first.focal_px is None else Instrument(first.focal_px)
        if given is not None and self.calibration is not None:
            given = replace(given, calibration=self.calibration)
        if given is not None and self.inclinometer:
            model, errors = sensors.find(self.inclinometer)
            given = replace(given, inclinometer=errors, inclinometer_model=model)
        instruments = Given(given, by_header=self.instrument is None)
        return solved_night(
            exposures(self.folder, instruments, self.atmosphere, self.vertical, self.place),
            turn_stddev_deg if self_calibrate else None,
            progress,
        )


def open_night(
    folder: str | Path,
    *,
    instrument: Instrument | str | Path | None = None,
    calibration: Calibration | None = None,
    inclinometer: str = "",
    atmosphere: Atmosphere | None = None,
    vertical: Vertical | None = None,
    place: KnownPlace | None = None,
) -> NightOnDisk:
    """A night: a folder of FITS frames, or else of CSV lists of stars, with tilt.csv; not read yet.

    instrument: or the path of its file (YAML); None if the frames' headers have the focal length.
    calibration: A3 in place of the instrument's; without a known A3 the position error exceeds 1000 km, unless the night
    is solved with self_calibrate=True. inclinometer: name of its model, in place of the instrument's; without a name or
    stated errors it counts as an SCA100T as sold, 7 km or more.  atmosphere: None: not measured.
    vertical: its deflection; None: not known.
    place: where the instrument is known to be: each frame's `Shot.at_place` is its heading there, and tilt.csv may lack.
    Raises StarposError if there is no frame, or the instrument's file cannot be used.
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
