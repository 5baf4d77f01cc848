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

NAN = math.nan
# Share by which the focal length of one camera may change.
SAME_FOCAL = 0.05
# A clock is trusted no further than this without an instrument file.
MIN_CLOCK_S = 0.01


def _stated(values: Mapping) -> Calibration:
    """The calibration of the parameters; without its error it is not known."""
    stddev = values["misalignment_stddev"]
    return Calibration.of(values["misalignment"], *(() if math.isnan(stddev) else ((stddev,) * 3,)))


def instrument_of(
    values: Mapping, camera: Camera, known: Instrument | None, found: Calibration | None = None
) -> Instrument:
    """Make the Instrument from an instrument file (`known`, or None) or from the parameters, with camera_info's camera.

    clock_stddev and tilt_stddev, if they are set, replace the values of the file. A calibration from frames (`found`)
    replaces the one from file and parameters; with self_calibration, and before there is a `found`, it counts as unknown.
    """
    if known is None:
        model, errors = sensors.find(values["inclinometer.model"])
        known = Instrument(
            camera.fx,
            calibration=_stated(values),
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


def check_gnss(values: Mapping, instrument: Instrument) -> None:
    """Raise InstrumentError if gnss.use does not go with the others."""
    if not values["gnss.use"]:
        return
    if values["self_calibration"]:
        raise InstrumentError("gnss.use and self_calibration both find A3: set one of the two")
    if instrument.vertical is not None:
        raise InstrumentError(
            "gnss.use teaches an inclinometer, and the camera of calibration_url is its own level: set it to false"
        )


def known_instrument(url: str) -> Instrument | None:
    """Read the Instrument that calibration_url names, None for ''; InstrumentError with the reason if it is broken."""
    return instrument_file.read(path_of(url)) if url else None


def check_camera(known: Instrument | None, url: str, camera: Camera) -> None:
    """Raise InstrumentError if the instrument file (`known`, from `url`) belongs to another camera or frame size."""
    if known is None:
        return
    if abs(known.focal_px / camera.fx - 1) <= SAME_FOCAL:
        if known.size in (None, (camera.width, camera.height)):
            return
        width, height = known.size
        raise InstrumentError(
            f"{url}: its A3 was found with frames of {width} x {height} px, camera_info has {camera.width} "
            f"x {camera.height}: calibrate with these"
        )
    raise InstrumentError(
        f"{url}: it is of another camera: its focal length is {known.focal_px:.0f} px, camera_info's {camera.fx:.0f}"
    )


def atmosphere_of(values: Mapping) -> Atmosphere:
    """Make the Atmosphere from the parameters; what is not set keeps its default."""
    names = ("pressure", "temperature", "humidity", "wavelength")
    set_to = [values[f"refraction.{name}"] for name in names]
    return Atmosphere.measured(*(None if math.isnan(value) else value for value in set_to))


def site_of(values: Mapping, vertical: Vertical) -> Place | None:
    """Make the place of site.latitude and site.longitude, None where they are unset; PlaceError if only one is."""
    latitude, longitude = values["site.latitude"], values["site.longitude"]
    if math.isnan(latitude) and math.isnan(longitude):
        return None
    if math.isnan(latitude) or math.isnan(longitude):
        raise PlaceError("site.latitude and site.longitude belong together: set both, or neither")
    make = Place.on_ellipsoid if values["site.geodetic"] else Place.by_gravity
    return make(latitude, longitude, vertical, np.eye(2) * values["site.stddev"] ** 2)


def check_deflection(values: Mapping) -> None:
    """Raise PlaceError if deflection.wanted lacks the mark."""
    if math.isnan(values["deflection.wanted"]):
        return
    mark = (values["site.latitude"], values["site.longitude"], values["altitude"])
    if not values["site.geodetic"] or any(math.isnan(value) for value in mark):
        raise PlaceError(
            "deflection.wanted is measured at a mark on WGS 84: set site.latitude, site.longitude, site.geodetic true "
            "and altitude too"
        )


def vertical_of(values: Mapping, known: geoid.Geoid | None) -> Vertical:
    """Return the Geoid (`known`, or None), or the deflection that the parameters give for the place.

    Plumb lines curve up to the altitude, if it is set, unless the parameters give the deflection at the instrument.
    """
    xi, eta = values["deflection.xi"], values["deflection.eta"]
    if known is None:
        stated = Deflection(xi, eta, values["deflection.stddev"])
        return (
            stated
            if stated != Deflection()
            else AtHeight(stated, values["altitude"], values["altitude_stddev"])
        )
    if xi or eta:
        raise GeoidError(
            "deflection.geoid gives the deflection: set deflection.xi and deflection.eta to 0, or "
            "deflection.geoid to ''"
        )
    return AtHeight(known, values["altitude"], values["altitude_stddev"])


ANY_CAMERA = Camera.from_focal(100, 100, 1000.0)


class NodeSettings:
    """The parameters of a node as `values` by name (settings.py), and the objects made from them and from their files.

    A file is read once, when its parameter is checked, so the checked contents are used. A file that breaks or
    disappears later does not matter until the parameter is set again.
    """

    # a reader of files for a parameter that names one
    readers: ClassVar[Mapping[str, Callable[[str], Any]]] = {
        "calibration_url": known_instrument,
        "deflection.geoid": geoid.read,
    }

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = values
        # contents by parameter: in use, and by the last check
        self._files: dict[str, Any] = dict.fromkeys(self.readers)
        self._read = self._files

    def check(
        self, values: Mapping[str, Any], names: frozenset[str], camera: Camera | None = None
    ) -> str | None:
        """Say in a sentence why values cannot be together, such as with a broken file; None if they can.

        names: of those that are set.  camera: the one in use, None before there is one.
        """
        try:
            read = {
                name: reader(values[name]) if values[name] else None
                for name, reader in self.readers.items()
                if name in names
            }
            files = self._files | read
            self._refuse(values, files)
            if camera is not None and "calibration_url" in read:
                check_camera(read["calibration_url"], values["calibration_url"], camera)
            atmosphere_of(values)
            site_of(values, vertical_of(values, files["deflection.geoid"]))
        except StarposError as e:
            return str(e)
        self._read = files
        return None

    def _refuse(self, values: Mapping[str, Any], files: Mapping[str, Any]) -> None:
        """Raise a StarposError if values do not go together, or not with the contents of the files."""

    def adopt(self) -> None:
        """Use the files that the last check has read."""
        self._files = self._read

    @property
    def _known(self) -> Instrument | None:
        """The instrument of calibration_url."""
        return self._files["calibration_url"]

    @property
    def vertical(self) -> Vertical:
        """The deflection of the vertical, or the geoid that gives it."""
        return vertical_of(self.values, self._files["deflection.geoid"])

    @property
    def site(self) -> Place | None:
        """The place that is known; None where none is set."""
        return site_of(self.values, self.vertical)


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

    def _refuse(self, values: Mapping[str, Any], files: Mapping[str, Any]) -> None:
        check_gnss(values, instrument_of(values, ANY_CAMERA, files["calibration_url"]))
        check_deflection(values)

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

    def instrument(self, found: Calibration | None) -> Instrument:
        """The instrument in use, but for its camera; `found` is the calibration from frames, or None."""
        return instrument_of(self.values, ANY_CAMERA, self._known, found)

    def solver(self, camera: Camera, found: Calibration | None, catalogue: Catalogue) -> Solver:
        """Make a Solver for a camera, with the calibration from frames (`found`, or None).

        Raises InstrumentError if the instrument file belongs to another camera.
        """
        check_camera(self._known, self.values["calibration_url"], camera)
        return Solver(
            instrument_of(self.values, camera, self._known, found),
            catalogue,
            atmosphere_of(self.values),
            min_stars=self.values["min_stars"],
            ephemeris=self._files["ephemeris"] or ERFA,
        )
