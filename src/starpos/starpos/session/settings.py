# SPDX-License-Identifier: Apache-2.0
"""The parameters of a session, with the contents of the files that they name."""

import math
from collections.abc import Mapping
from typing import Any

from starpos.earth.geoid import Geoid
from starpos.earth.known_place import KnownPlace
from starpos.earth.vertical import Vertical
from starpos.errors import StarposError
from starpos.files import path_of
from starpos.fix.solver import Solver
from starpos.gnss import learned_file
from starpos.gnss.states import Learned
from starpos.instrument import sensors
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.session import parameters
from starpos.sky.catalogue import Catalogue

ANY_CAMERA = Camera.from_focal(100, 100, 1000.0)


class Settings:
    """The parameters as `values` by name (parameters.py), and the objects made from them and from their files.

    A file is read once, when its parameter is checked, so the checked contents are used. A file that breaks or
    disappears later does not matter until the parameter is set again.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = values
        self._known: Instrument | None = None
        self._geoid: Geoid | None = None
        # by the last check
        self._read: tuple[Instrument | None, Geoid | None] = None, None
        # what earlier sessions learned by GNSS; None without a file
        self.learned: Learned | None = None

    def check(self, values: Mapping, names: frozenset[str], camera: Camera | None) -> str | None:
        """Say in a sentence why values make no instrument together, such as with a broken file; None if they do.

        names: of those that are set.  camera: the one in use, None before there is one.
        """
        known, grid = self._known, self._geoid
        try:
            if "calibration_url" in names:
                known = parameters.known_instrument(values["calibration_url"])
                if camera is not None:
                    parameters.check_camera(known, values["calibration_url"], camera)
            if "deflection.geoid" in names:
                grid = parameters.geoid_file(values["deflection.geoid"])
            if "gnss.learned" in names and values["gnss.learned"]:
                self.learned = learned_file.read_if_there(path_of(values["gnss.learned"]))
            parameters.check_gnss(values, parameters.instrument_of(values, ANY_CAMERA, known))
            parameters.atmosphere_of(values)
            parameters.check_deflection(values)
            parameters.site_of(values, parameters.vertical_of(values, grid))
        except StarposError as e:
            return str(e)
        self._read = known, grid
        return None

    def adopt(self) -> None:
        """Use the files that the last check has read."""
        self._known, self._geoid = self._read

    def saved(self, instrument: Instrument) -> None:
        """Note that the file of calibration_url holds this instrument now."""
        self._known = instrument

    @property
    def vertical(self) -> Vertical:
        """The deflection of the vertical, or the geoid that gives it."""
        return parameters.vertical_of(self.values, self._geoid)

    @property
    def site(self) -> KnownPlace | None:
        """The place that is known; None where none is set."""
        return parameters.site_of(self.values, self.vertical)

    @property
    def tilt_stddev_rad(self) -> float:
        """Standard deviation of a tilt sample that states none."""
        stated = math.radians(self.values["tilt_stddev"])
        if not math.isnan(stated):
            return stated
        errors = (
            self._known.inclinometer if self._known else sensors.find(self.values["inclinometer.model"])[1]
        )
        return errors.noise_rad

    def instrument(self, found: Calibration | None) -> Instrument:
        """The instrument in use, but for its camera; `found` is the calibration from frames, or None."""
        return parameters.instrument_of(self.values, ANY_CAMERA, self._known, found)

    def solver(self, camera: Camera, found: Calibration | None, catalogue: Catalogue) -> Solver:
        """Make a Solver for a camera, with the calibration from frames (`found`, or None).

        Raises InstrumentError if the instrument file belongs to another camera.
        """
        parameters.check_camera(self._known, self.values["calibration_url"], camera)
        return Solver(
            parameters.instrument_of(self.values, camera, self._known, found),
            catalogue,
            parameters.atmosphere_of(self.values),
            self.values["min_stars"],
        )
