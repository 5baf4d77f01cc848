# SPDX-License-Identifier: Apache-2.0
"""A night on the disk for programs and notebooks: `starpos.open_night`."""

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection, Vertical
from starpos.errors import FrameError, InstrumentError
from starpos.frames.night_files import TILTS
from starpos.frames.stars import Stars
from starpos.instrument import instrument_file, sensors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.progress import Progress, quiet
from starpos.report.folder import exposures, frames_in
from starpos.report.night import Night
from starpos.report.working import Workshop, worked
from starpos.sky.catalogue import load_catalogue


@dataclass(frozen=True)
class NightOnDisk:
    """A folder of frames with tilt.csv, and what is known of its instrument and the air; `solve` works on it.

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

    def __repr__(self) -> str:
        return f"<{self.folder}: {self.count} frames and {TILTS}, to be solved>"

    def solve(
        self, self_calibrate: bool = False, turn_stddev_deg: float = 180.0, progress: Progress = quiet
    ) -> Night:
        """The place, and the fix of each frame; a frame's fault is its status.

        self_calibrate: find A3 too, from frames of one place at several headings; turn_stddev_deg: how well the given A3
        has its turn about the plumb line.  Raises StarposError where the folder or the instrument cannot be used.
        """
        noise = self._with_inclinometer(self.instrument or Instrument(1.0)).inclinometer.noise_rad
        shop = Workshop(
            instrument_for=self._instrument_for,
            catalogue=load_catalogue(),
            atmosphere=self.atmosphere,
            vertical=self.vertical,
            turn_stddev_deg=turn_stddev_deg if self_calibrate else None,
            progress=progress,
        )
        return worked(exposures(self.folder, noise), shop)

    def _instrument_for(self, stars: Stars) -> Instrument:
        known = self.instrument
        if known is None:
            if stars.focal_px is None:
                raise InstrumentError(
                    f"{stars.place}: its header has no focal length: give instrument=Instrument(focal_px)"
                )
            known = Instrument(stars.focal_px)
        known = self._with_inclinometer(known)
        return known if self.calibration is None else replace(known, calibration=self.calibration)

    def _with_inclinometer(self, instrument: Instrument) -> Instrument:
        if not self.inclinometer:
            return instrument
        model, errors = sensors.find(self.inclinometer)
        return replace(instrument, inclinometer=errors, inclinometer_model=model)


def open_night(
    folder: str | Path,
    *,
    instrument: Instrument | str | Path | None = None,
    calibration: Calibration | None = None,
    inclinometer: str = "",
    atmosphere: Atmosphere | None = None,
    vertical: Vertical | None = None,
) -> NightOnDisk:
    """A night: a folder of FITS frames, or else of CSV lists of stars, with tilt.csv; not read yet.

    instrument: or the path of its file (YAML); None if the frames' headers have the focal length.
    calibration: A3 in place of the instrument's; while nobody knows A3 the place is over 1000 km wide, unless the night
    is solved with self_calibrate=True.  inclinometer: name of its model, in place of the instrument's; where nobody names
    it or states its errors they are those of an SCA100T as sold, 7 km.  atmosphere: None: not measured.  vertical: its deflection; None: not known.
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
    )
