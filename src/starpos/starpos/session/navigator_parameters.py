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
from starpos.navigation.vessel import Vessel, check_drift
from starpos.session import settings

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
