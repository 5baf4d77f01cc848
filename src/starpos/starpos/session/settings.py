# SPDX-License-Identifier: Apache-2.0
"""The parameters of the solver, and the settings that follow from them and from the named files."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from starpos.earth import geoid
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import AtHeight, Deflection, Vertical
from starpos.errors import GeoidError, InstrumentError, PlaceError, StarposError
from starpos.files import path_of
from starpos.fix.solver import Solver
from starpos.gnss import states
from starpos.instrument import instrument_file, sensors
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.parameters.given import values_of
from starpos.satellites.elements import StoredOrbits
from starpos.sky.bodies import ERFA, JplKernel
from starpos.sky.catalogue import Catalogue

# Share by which the focal length of one camera may change.
SAME_FOCAL = 0.05
# A clock is trusted no further than this without an instrument file.
MIN_CLOCK_S = 0.01


ANY_CAMERA = Camera.from_focal(100, 100, 1000.0)


class NodeSettings:
    """The parameters of a node as `values` by name, and the objects made from them and from their files.

    A file is read once, when its parameter is checked, so the checked contents are used. A file that breaks or
    disappears later does not matter until the parameter is set again.
    files: the contents by parameter.  camera: the one in use, which an instrument file has to fit; None without one.
    """

    # a reader of files for a parameter that names one
    readers: ClassVar[Mapping[str, Callable[[str], Any]]] = {
        "calibration_url": lambda url: instrument_file.read(path_of(url)),
        "deflection.geoid": geoid.read,
    }

    def __init__(self, values: Mapping[str, Any], files: Mapping[str, Any] | None = None) -> None:
        self.values = values
        self.camera: Camera | None = None
        self._files = {**dict.fromkeys(self.readers), **(files or {})}
        # by the last check
        self._read = self._files

    def check(self, values: Mapping[str, Any], names: frozenset[str]) -> str | None:
        """Say in a sentence why values cannot be together, such as with a broken file; None if they can.

        names: of those that are set.
        """
        try:
            read = {
                name: reader(values[name]) if values[name] else None
                for name, reader in self.readers.items()
                if name in names
            }
            wanted = type(self)(values, self._files | read)
            wanted.refuse()
            if self.camera is not None and "calibration_url" in read:
                wanted.check_camera(self.camera)
        except StarposError as e:
            return str(e)
        self._read = wanted._files
        return None

    def refuse(self) -> None:
        """Raise a StarposError if values do not go together, or not with the contents of the files."""
        _ = self.atmosphere, self.vertical, self.site

    def adopt(self) -> None:
        """Use the files that the last check has read."""
        self._files = self._read

    @property
    def _known(self) -> Instrument | None:
        """The instrument of calibration_url."""
        return self._files["calibration_url"]

    def check_camera(self, camera: Camera) -> None:
        """Raise InstrumentError if the instrument file belongs to another camera or frame size."""
        known, url = self._known, self.values["calibration_url"]
        if known is None:
            return
        if abs(known.focal_px / camera.fx - 1) > SAME_FOCAL:
            raise InstrumentError(
                f"{url}: it is of another camera: its focal length is {known.focal_px:.0f} px, camera_info's "
                f"{camera.fx:.0f}"
            )
        if known.size not in (None, (camera.width, camera.height)):
            width, height = known.size
            raise InstrumentError(
                f"{url}: its A3 was found with frames of {width} x {height} px, camera_info has {camera.width} "
                f"x {camera.height}: calibrate with these"
            )

    @property
    def atmosphere(self) -> Atmosphere:
        """The air; what is not set keeps its default."""
        names = ("pressure", "temperature", "humidity", "wavelength")
        set_to = [self.values[f"refraction.{name}"] for name in names]
        return Atmosphere.measured(*(None if math.isnan(value) else value for value in set_to))

    @property
    def vertical(self) -> Vertical:
        """The geoid, or the deflection that the parameters give for the place.

        Plumb lines curve up to the altitude, if it is set, unless the parameters give the deflection at the instrument.
        """
        values, known = self.values, self._files["deflection.geoid"]
        stated = Deflection(values["deflection.xi"], values["deflection.eta"], values["deflection.stddev"])
        if known is not None and (stated.xi_arcsec or stated.eta_arcsec):
            raise GeoidError(
                "deflection.geoid gives the deflection: set deflection.xi and deflection.eta to 0, or "
                "deflection.geoid to ''"
            )
        if known is None and stated != Deflection():
            return stated
        return AtHeight(stated if known is None else known, values["altitude"], values["altitude_stddev"])

    @property
    def site(self) -> Place | None:
        """The place that is known; None where none is set; PlaceError if only a half of it is."""
        values = self.values
        latitude, longitude = values["site.latitude"], values["site.longitude"]
        if math.isnan(latitude) and math.isnan(longitude):
            return None
        if math.isnan(latitude) or math.isnan(longitude):
            raise PlaceError("site.latitude and site.longitude belong together: set both, or neither")
        make = Place.on_ellipsoid if values["site.geodetic"] else Place.by_gravity
        return make(latitude, longitude, self.vertical, np.eye(2) * values["site.stddev"] ** 2)


class Settings(NodeSettings):
    """The parameters of the solver."""

    readers: ClassVar[Mapping[str, Callable[[str], Any]]] = {
        **NodeSettings.readers,
        "gnss.learned": lambda name: states.read_learned(path_of(name)),
        "satellites.elements": lambda name: StoredOrbits(path_of(name)),
        "ephemeris": lambda name: JplKernel(str(path_of(name))),
    }

    @classmethod
    def of(
        cls, file: Path | None = None, given: Sequence[str] = (), namespace: str | None = None
    ) -> "Settings":
        """Read them from a parameter file and texts NAME:=VALUE, as the node does; errors as `values_of` raises them."""
        settings = cls(values_of("solver", file, given, namespace))
        if trouble := settings.check(settings.values, frozenset(settings.values)):
            raise InstrumentError(trouble)
        settings.adopt()
        return settings

    def refuse(self) -> None:
        """Raise a StarposError if values do not go together, or not with the contents of the files."""
        super().refuse()
        values, instrument = self.values, self.instrument(None)
        if values["gnss.use"] and values["self_calibration"]:
            raise InstrumentError("gnss.use and self_calibration both find A3: set one of the two")
        if values["gnss.use"] and instrument.vertical is not None:
            raise InstrumentError(
                "gnss.use teaches an inclinometer, and the camera of calibration_url is its own level: set it to false"
            )
        mark = (values["site.latitude"], values["site.longitude"], values["altitude"])
        marked = values["site.geodetic"] and not any(math.isnan(value) for value in mark)
        if not math.isnan(values["deflection.wanted"]) and not marked:
            raise PlaceError(
                "deflection.wanted is measured at a mark on WGS 84: set site.latitude, site.longitude, site.geodetic "
                "true and altitude too"
            )

    @property
    def learned(self) -> states.Learned | None:
        """What earlier sessions learned by GNSS; None without a file."""
        return self._files["gnss.learned"]

    @property
    def orbits(self) -> StoredOrbits | None:
        """The orbits of satellites; None without satellites.elements."""
        return self._files["satellites.elements"]

    def saved(self, instrument: Instrument) -> None:
        """Note that the file of calibration_url holds this instrument now."""
        self._files = self._files | {"calibration_url": instrument}

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

    def instrument(self, found: Calibration | None, camera: Camera = ANY_CAMERA) -> Instrument:
        """The instrument in use with a camera: the one of the file, or of the parameters.

        clock_stddev and tilt_stddev, if they are set, replace the values of the file. A calibration from frames (`found`)
        replaces the one from file and parameters; with self_calibration, and before there is a `found`, it counts as
        unknown.
        """
        values, known = self.values, self._known
        if known is None:
            model, errors = sensors.find(values["inclinometer.model"])
            # without its error a calibration is not known
            stddev = values["misalignment_stddev"]
            stated = () if math.isnan(stddev) else ((stddev,) * 3,)
            known = Instrument(
                camera.fx,
                calibration=Calibration.of(values["misalignment"], *stated),
                # each host states its own
                clock_stddev_s=MIN_CLOCK_S,
                inclinometer=errors,
                inclinometer_model=model,
            )
        calibration = found or known.calibration
        if values["self_calibration"] and found is None:
            calibration = Calibration.of(calibration.misalignment_deg)
        clock, tilt = values["clock_stddev"], values["tilt_stddev"]
        errors = known.inclinometer
        return replace(
            known,
            calibration=calibration,
            camera=camera,
            focal_px=camera.fx,
            clock_stddev_s=known.clock_stddev_s if math.isnan(clock) else clock,
            inclinometer=errors if math.isnan(tilt) else replace(errors, noise_rad=math.radians(tilt)),
        )

    def solver(self, camera: Camera, found: Calibration | None, catalogue: Catalogue) -> Solver:
        """Make a Solver for a camera, with the calibration from frames (`found`, or None).

        Raises InstrumentError if the instrument file belongs to another camera.
        """
        self.check_camera(camera)
        return Solver(
            self.instrument(found, camera),
            catalogue,
            self.atmosphere,
            min_stars=self.values["min_stars"],
            ephemeris=self._files["ephemeris"] or ERFA,
        )
