# SPDX-License-Identifier: Apache-2.0
"""A voyage from its frames and an IMU: frames are read and identified, then placed under way."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, FrameError, InstrumentError, TimeError, VoyageError
from starpos.fix.solver import Solver
from starpos.instrument import instrument_file
from starpos.instrument.instrument import AxisDoubt, Instrument, framed
from starpos.navigation.records import ImuModel, read_imu, read_imu_model, read_velocity
from starpos.navigation.sightings import PlacelessFrame, sighting_of
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import Voyage, adjust_voyage
from starpos.night.reading import First, Instruments, Reader
from starpos.night.work import Solving
from starpos.progress import Progress, quiet
from starpos.sky import catalogue

MOUNT_STDDEV_DEG, MAX_MOUNT_DEG = 1.0, 20.0
# of a given height: the geoid, and hills on the way
GIVEN_HEIGHT_STDDEV_M = 100.0


@dataclass(frozen=True)
class VoyageFrame:
    """A frame's time, its attitude by stars, or why it has none, or a remark."""

    utc_unix_s: float | None
    sighting: PlacelessFrame | None
    message: str = ""


@dataclass(frozen=True)
class IdentifyingVoyage:
    """Work on the file of a frame, for any process: a VoyageFrame."""

    read: Reader
    given: Instruments

    def __call__(self, path: str) -> VoyageFrame:
        item = self.read(path)
        sight = Solving(self.given)(item)
        instrument = sight.instrument or self.given.of(item)
        assert instrument is not None
        eye, time_s = Solver(instrument, catalogue.load_catalogue()), item.mid_unix_s
        try:
            return VoyageFrame(time_s, sighting_of(sight.stars, eye, sight.solution), sight.solution.remark)
        except (FrameError, FixError, TimeError) as error:
            return VoyageFrame(time_s, None, str(error))


@dataclass(frozen=True, kw_only=True)
class Records:
    """What a vehicle recorded besides frames: files, and the law by which its speed changes.

    imu: CSV of angular rates and accelerations.  imu_model: kalibr's YAML; None: a cheap one.
    velocity: CSV of velocities over ground, along the body's axes; None without one.
    vehicle: a key of `vessel.LAWS`, or 'parked'; None: anything that moves.
    mount_stddev_deg: error of the camera's stated orientation on the vehicle.
    drift_stddev: of current or wind, m/s, where velocities are through water or air.
    height_m: of the vehicle; None: not known.
    """

    imu: str | Path
    imu_model: str | Path | None = None
    velocity: str | Path | None = None
    vehicle: str | None = None
    mount_stddev_deg: float = MOUNT_STDDEV_DEG
    drift_stddev: float = 0.0
    height_m: float | None = None

    def vessel(
        self, instrument: Instrument, atmosphere: Atmosphere, axis: AxisDoubt | None = None
    ) -> tuple[Vessel, str]:
        """The vessel, and a remark if the mount's error includes an unknown axis; InstrumentError if it is too large."""
        stddev, remark = math.radians(self.mount_stddev_deg), ""
        if axis is not None:
            remark, stddev = axis.counted_as("the mount"), math.hypot(stddev, axis.error_rad)
            if math.degrees(stddev) > MAX_MOUNT_DEG:
                raise InstrumentError(
                    f"{remark}; with a mount known no better, there is no position under way"
                )
        vessel = Vessel(
            vehicle=self.vehicle,
            model=ImuModel() if self.imu_model is None else read_imu_model(Path(self.imu_model)),
            camera_to_body=np.asarray(instrument.link_to_camera, float).T,
            mount_stddev=stddev,
            atmosphere=atmosphere,
            clock_stddev_s=instrument.clock_stddev_s,
            drift_stddev=self.drift_stddev,
        )
        if self.height_m is not None:
            vessel = replace(vessel, height_m=self.height_m, height_stddev_m=GIVEN_HEIGHT_STDDEV_M)
        return vessel, remark

    def voyage(self, frames: Sequence[VoyageFrame], vessel: Vessel, progress: Progress = quiet) -> Voyage:
        """The places of the frames; VoyageError for broken records, FixError where the stars do not support one."""
        imu = read_imu(str(self.imu))
        velocity = None if self.velocity is None else read_velocity(str(self.velocity))
        times = np.array([np.nan if f.utc_unix_s is None else f.utc_unix_s for f in frames])
        sightings = [f.sighting for f in frames if f.sighting is not None]
        return adjust_voyage(sightings, imu, velocity, vessel, times, progress)


def voyage_frames(answers: Iterable[VoyageFrame | FrameError]) -> list[VoyageFrame]:
    """The answers of `IdentifyingVoyage`; a frame that cannot be read has only its sentence."""
    return [VoyageFrame(None, None, str(a)) if isinstance(a, FrameError) else a for a in answers]


def navigate(
    frames: Sequence[str | Path],
    imu: str | Path,
    instrument: Instrument | str | Path,
    *,
    atmosphere: Atmosphere | None = None,
    progress: Progress = quiet,
    **records: float | str | Path | None,
) -> Voyage:
    """Place, heading and velocity of a moving vehicle at each of its frames.

    Parameters
    ----------
    frames : paths of frames or of lists of stars, in the order of their times
    imu : path of the IMU's CSV: utc_unix_s, gx, gy, gz (rad/s), ax, ay, az (m/s2)
    instrument : an Instrument, or the path of its file (YAML); its camera is mounted as link_to_camera says
    atmosphere : of refraction; None: not measured
    progress : is called with the share of the work that is done
    **records : the other fields of `Records`: imu_model, velocity, vehicle, mount_stddev_deg, drift_stddev,
        height_m

    Returns
    -------
    Voyage
        `fixes` has a VoyageFix, or None, for each frame: astronomic latitude, longitude and heading in rad, with the
        covariance (3, 3) of east m, north m, heading rad; velocity (3,) of east, north, up in m/s

    Raises
    ------
    VoyageError
        no frame can be read, or the IMU's record is missing, broken or contradicts the stars
    FixError
        the stars do not support a place

    Examples
    --------
    >>> lists, camera = sorted(Path("drive").glob("stars_*.csv")), starpos.Instrument(4635.9375)
    >>> voyage = starpos.navigate(lists, "drive/imu.csv", camera, vehicle="rover", imu_model="drive/imu.yaml")
    >>> voyage.fixes[-1].covariance.shape  # east m, north m, heading rad
    (3, 3)
    """
    paths, read = tuple(map(str, frames)), Reader()
    known = instrument_file.read(instrument) if isinstance(instrument, (str, Path)) else instrument
    about = First(read)(paths)
    if about is None:
        raise VoyageError(f"none of the {len(paths)} frames can be read: give star lists or frames")
    whole, axis = framed(known, about)
    kept = Records(imu=imu, **records)  # type: ignore[arg-type]
    vessel, _ = kept.vessel(
        whole, Atmosphere.measured(None, None) if atmosphere is None else atmosphere, axis
    )
    work: Callable[[str], VoyageFrame] = IdentifyingVoyage(read, Instruments(whole))
    answers: list[VoyageFrame | FrameError] = []
    for path in paths:
        try:
            answers.append(work(path))
        except FrameError as error:
            answers.append(error)
    return kept.voyage(voyage_frames(answers), vessel, progress)
