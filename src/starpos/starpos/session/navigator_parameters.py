# SPDX-License-Identifier: Apache-2.0
"""Parameters of the navigator, and the vehicle that they and their files describe."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from starpos.earth.geoid import Geoid
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.errors import StarposError
from starpos.files import path_of
from starpos.instrument.instrument import Instrument
from starpos.navigation.records import ImuModel, read_imu_model
from starpos.navigation.vessel import LAWS, Vessel, check_drift
from starpos.session import settings
from starpos.session.parameter import FRAME_NAME, Parameter

SHARED = (
    "refraction.pressure",
    "refraction.temperature",
    "refraction.humidity",
    "refraction.wavelength",
    "altitude",
    "altitude_stddev",
    "clock_stddev",
    "deflection.xi",
    "deflection.eta",
    "deflection.stddev",
    "deflection.geoid",
    "site.latitude",
    "site.longitude",
    "site.geodetic",
    "site.stddev",
)
PARAMETERS = (
    Parameter(
        "frame_id",
        "starpos_link",
        "Frame of the IMU's axes, x forward, y left, z up, whose position and attitude are published.",
        form=FRAME_NAME,
    ),
    Parameter(
        "odometry_frame_id",
        "map",
        "Frame of navigator/odometry: east, north, up at the first fix.",
        form=FRAME_NAME,
    ),
    Parameter(
        "publish_tf",
        False,
        "Publish the pose of frame_id in odometry_frame_id on /tf. Set false if a filter publishes "
        "it, or if frame_id has base_link as its parent: a frame with two parents breaks the tree.",
    ),
    Parameter(
        "calibration_url",
        "",
        "Instrument file (YAML) whose link_to_camera says how the camera sits on the IMU; '' means "
        "the optical axis along z and the top of the frame forward.",
    ),
    Parameter(
        "mount_stddev",
        1.0,
        "Error of link_to_camera on each axis, 1 sigma. If too small, the position errs by up to "
        "111 km a degree until the vehicle has turned.",
        unit="deg",
        minimum=1e-4,
        maximum=20.0,
    ),
    Parameter(
        "imu_model",
        "",
        "File of the IMU's errors, kalibr's imu.yaml with the sigma of the biases; '' for a cheap IMU. "
        "A bias far beyond its sigma moves the position: 1 mg by up to 6 km until the vehicle has turned.",
    ),
    Parameter(
        "vehicle",
        "",
        "What moves. parked: it stands still. Others name the law by which the speed changes where "
        "no velocity comes. '' is anything that moves, with a large position error. If the vehicle "
        "does not keep to the law, the fix claims an error that is too small.",
        choices=("", *LAWS),
    ),
    Parameter(
        "velocity_stddev",
        0.05,
        "Error on each axis of a velocity whose message states none; 0.05 m/s over 20 minutes is 27 m.",
        unit="m/s",
        minimum=1e-4,
        maximum=100.0,
    ),
    Parameter(
        "drift_stddev",
        0.0,
        "Speed of current or wind on each axis, 1 sigma, if the velocity is through water or air "
        "and not over ground; half of it may change in an hour. A drift that is not stated is an "
        "error of the position.",
        unit="m/s",
        minimum=0.0,
        maximum=50.0,
    ),
    Parameter(
        "drift_change",
        float("nan"),
        "Change of wind or current in ten minutes, 1 sigma on each axis. Unset takes a fifth of "
        "drift_stddev or, where no velocity comes, 0.07 for a ship and 0.3 for a drone. If too "
        "small, fixes claim errors that are too small: 0.1 m/s is 108 m.",
        unit="m/s",
        minimum=0.01,
        maximum=50.0,
    ),
    Parameter("rate", 10.0, "Outputs per second.", unit="Hz", minimum=0.1, maximum=100.0),
    Parameter(
        "window",
        1200.0,
        "Length of time that is adjusted at once; older measurements are dropped. A short one "
        "determines the position less well.",
        unit="s",
        minimum=30.0,
        maximum=7200.0,
    ),
    Parameter(
        "adjust_period",
        10.0,
        "Time between adjustments, longer if the window holds many measurements. In between, the "
        "IMU continues the position.",
        unit="s",
        minimum=1.0,
        maximum=600.0,
    ),
    Parameter(
        "stars_timeout",
        120.0,
        "Longest time that the IMU continues the position without stars; after that there is no fix.",
        unit="s",
        minimum=1.0,
        maximum=3600.0,
    ),
    Parameter(
        "gnss.use",
        False,
        "Use the position in gnss/fix for navigator/heading until there is a fix; navigator/fix "
        "remains the stars' own. A GNSS error of 10 km turns the heading by up to 0.1 deg, more "
        "near a pole.",
    ),
    *(p for p in settings.PARAMETERS if p.name in SHARED),
)
# of a stated altitude: the vehicle goes up and down by more than its file says
MIN_HEIGHT_STDDEV_M = 10.0
ANY_INSTRUMENT = Instrument(1000.0, clock_stddev_s=settings.MIN_CLOCK_S)


class NavigatorSettings:
    """The parameters as `values` by name, and what is made from them and from their files.

    A file is read once, when its parameter is checked.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = values
        # the files in use, and the files of the last check
        self._files: tuple[Instrument, ImuModel, Geoid | None] = ANY_INSTRUMENT, ImuModel(), None
        self._read: tuple[Instrument, ImuModel, Geoid | None] = self._files

    def check(self, values: Mapping[str, Any], names: frozenset[str]) -> str | None:
        """Say in a sentence why values cannot be, such as with a broken file; None if they can.

        names: of those that are set.
        """
        known, model, grid = self._files
        try:
            if "calibration_url" in names:
                known = settings.known_instrument(values["calibration_url"]) or ANY_INSTRUMENT
            if "imu_model" in names:
                name = values["imu_model"]
                model = read_imu_model(path_of(name)) if name else ImuModel()
            if "deflection.geoid" in names:
                grid = settings.geoid_file(values["deflection.geoid"])
            settings.atmosphere_of(values)
            settings.site_of(values, settings.vertical_of(values, grid))
            check_drift(values["vehicle"], values["drift_stddev"], values["drift_change"])
        except StarposError as e:
            return str(e)
        self._read = known, model, grid
        return None

    def adopt(self) -> None:
        """Use the files that the last check has read."""
        self._files = self._read

    @property
    def vertical(self) -> Vertical:
        """The deflection of the vertical, or the geoid that gives it."""
        return settings.vertical_of(self.values, self._files[2])

    @property
    def site(self) -> Place | None:
        """The place that is known; None where none is set."""
        return settings.site_of(self.values, self.vertical)

    def vessel(self, clock_stddev_s: float) -> Vessel:
        """Instrument and vehicle, of which the frames' clock states its error."""
        values, (known, model, _) = self.values, self._files
        clock = values["clock_stddev"]
        height = values["altitude"]
        stated = (
            {}
            if np.isnan(height)
            else {
                "height_m": height,
                "height_stddev_m": max(values["altitude_stddev"], MIN_HEIGHT_STDDEV_M),
            }
        )
        return Vessel(
            vehicle=values["vehicle"] or None,
            model=model,
            camera_to_body=np.asarray(known.link_to_camera, float).T,
            mount_stddev=float(np.radians(values["mount_stddev"])),
            atmosphere=settings.atmosphere_of(values),
            clock_stddev_s=max(known.clock_stddev_s, clock_stddev_s) if np.isnan(clock) else clock,
            drift_stddev=values["drift_stddev"],
            drift_change=values["drift_change"],
            **stated,
        )
