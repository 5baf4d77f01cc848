# SPDX-License-Identifier: Apache-2.0
"""A voyage from its frames and an IMU: frames are read and identified, then placed under way."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, FrameError, InstrumentError, TimeError, VoyageError
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame, Stars
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument, framed
from starpos.navigation.records import ImuModel, read_imu, read_imu_model, read_velocity
from starpos.navigation.sightings import PlacelessFrame, sighting_of
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import Voyage, adjust_voyage
from starpos.night.reading import Each, Instruments, Reader
from starpos.night.work import Solving, prepare
from starpos.progress import Progress, Say, quiet
from starpos.sky import catalogue

MOUNT, MOUNT_STDDEV_DEG, MAX_MOUNT_DEG = "the mount", 1.0, 20.0
# of a given height: the geoid, and hills on the way
GIVEN_HEIGHT_STDDEV_M = 100.0


@dataclass(frozen=True)
class VoyageFrame:
    """A frame's time, its attitude by stars, or why it has none, or a remark."""

    utc_unix_s: float | None
    sighting: PlacelessFrame | None
    message: str = ""


def voyage_frame(given: Instruments, item: Frame | Stars) -> VoyageFrame:
    """A frame, identified by every way there is."""
    sight = Solving(given)(item)
    instrument = sight.instrument or given.of(item)
    assert instrument is not None
    eye, time_s = Solver(instrument, catalogue.load_catalogue()), item.mid_unix_s
    try:
        return VoyageFrame(time_s, sighting_of(sight.stars, eye, sight.solution), sight.solution.remark)
    except (FrameError, FixError, TimeError) as error:
        return VoyageFrame(time_s, None, str(error))


def vessel_of(
    instrument: Instrument,
    atmosphere: Atmosphere,
    doubt: str = "",
    *,
    mount_stddev_deg: float = MOUNT_STDDEV_DEG,
    height_m: float | None = None,
    imu_model: str | Path | None = None,
    vehicle: str | None = None,
    drift_stddev: float = 0.0,
) -> Vessel:
    """The vessel, whose mount's error includes the instrument's unknown axis; InstrumentError if it is too large.

    doubt: of that axis, as `framed` has it.
    mount_stddev_deg: error of the camera's stated orientation on the vehicle.  height_m: of it; None: not known.
    imu_model: kalibr's YAML; None: a cheap one.  vehicle, drift_stddev: as of `Vessel`.
    """
    stddev = math.hypot(math.radians(mount_stddev_deg), instrument.axis_stddev_rad)
    if doubt and math.degrees(stddev) > MAX_MOUNT_DEG:
        raise InstrumentError(f"{doubt}; with a mount known no better, there is no position under way")
    vessel = Vessel(
        model=ImuModel() if imu_model is None else read_imu_model(Path(imu_model)),
        camera_to_body=np.asarray(instrument.link_to_camera, float).T,
        mount_stddev=stddev,
        atmosphere=atmosphere,
        clock_stddev_s=instrument.clock_stddev_s,
        vehicle=vehicle,
        drift_stddev=drift_stddev,
    )
    if height_m is not None:
        vessel = replace(vessel, height_m=height_m, height_stddev_m=GIVEN_HEIGHT_STDDEV_M)
    return vessel


def first_of(read: Reader, paths: Sequence[str]) -> Stars:
    """The first frame of a voyage; VoyageError if none can be read."""
    about = read.first(paths)
    if about is None:
        raise VoyageError(f"none of the {len(paths)} frames can be read: give star lists or frames")
    return about


def voyage_of(
    about: Stars,
    each: Each,
    given: Instruments,
    imu: str | Path,
    velocity: str | Path | None,
    atmosphere: Atmosphere,
    say: Say = quiet,
    progress: Progress = quiet,
    **assumed: Any,
) -> tuple[list[VoyageFrame], Voyage]:
    """The frames, and their places by tables of an IMU and of velocities along the body's axes, if there are any.

    about: the first of the frames, through which `each` goes.  say: takes what looks wrong.  assumed: for `vessel_of`.

    VoyageError for broken records, FixError where the stars do not support a place.
    """
    assert given.instrument is not None
    whole, doubt = framed(given.instrument, about, MOUNT)
    vessel = vessel_of(whole, atmosphere, doubt, **assumed)
    given = replace(given, instrument=whole)
    say(doubt, prepare(given, about, progress))
    # a frame that cannot be read has only its sentence
    frames = [
        VoyageFrame(None, None, str(answer)) if isinstance(answer, FrameError) else answer
        for _, answer in each(partial(voyage_frame, given))
    ]
    say(*(frame.message for frame in frames))
    measured = None if velocity is None else read_velocity(velocity)
    times = np.array([np.nan if f.utc_unix_s is None else f.utc_unix_s for f in frames])
    sightings = [f.sighting for f in frames if f.sighting is not None]
    return frames, adjust_voyage(sightings, read_imu(imu), measured, vessel, times, progress)


def navigate(
    frames: Sequence[str | Path],
    imu: str | Path,
    instrument: Instrument | str | Path,
    *,
    atmosphere: Atmosphere | None = None,
    velocity: str | Path | None = None,
    progress: Progress = quiet,
    **assumed: Any,
) -> Voyage:
    """Place, heading and velocity of a moving vehicle at each of its frames.

    Parameters
    ----------
    frames : paths of frames or of lists of stars, in the order of their times
    imu : path of the IMU's CSV: utc_unix_s, gx, gy, gz (rad/s), ax, ay, az (m/s2)
    instrument : an Instrument, or the path of its file (YAML); its camera is mounted as link_to_camera says
    atmosphere : of refraction; None: not measured
    velocity : path of the CSV of measured velocities along the body's axes, m/s; None: none
    progress : is called with the share of the work that is done
    **assumed : what else is known, as `vessel_of` takes it: imu_model, vehicle, mount_stddev_deg, drift_stddev, height_m

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
    about, air = first_of(read, paths), atmosphere or Atmosphere.measured(None, None)
    _, voyage = voyage_of(
        about, read.each(paths), Instruments(known), imu, velocity, air, progress=progress, **assumed
    )
    return voyage
