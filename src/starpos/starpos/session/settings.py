# SPDX-License-Identifier: Apache-2.0
"""The parameters of the solver, and the settings that follow from them and from the named files."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from starpos.earth import geoid
from starpos.earth.geoid import Geoid
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, AtHeight, Deflection, Vertical
from starpos.errors import GeoidError, InstrumentError, PlaceError, StarposError
from starpos.files import path_of
from starpos.fix.solver import Solver
from starpos.gnss import states
from starpos.gnss.states import Learned
from starpos.instrument import instrument_file, sensors
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.session.pace import MAX_RATE
from starpos.session.parameter import FRAME_NAME, Parameter
from starpos.sky.catalogue import Catalogue

NAN = math.nan
# Share by which the focal length of one camera may change.
SAME_FOCAL = 0.05
# A clock is trusted no further than this without an instrument file.
MIN_CLOCK_S = 0.01

PARAMETERS = (
    Parameter(
        "frame_id", "starpos_link", "Frame of fix and heading: x forward, y left, z up.", form=FRAME_NAME
    ),
    Parameter(
        "publish_tf",
        True,
        "Publish the rotations of camera and inclinometer relative to frame_id on /tf_static. Set "
        "false if robot_state_publisher does, or if the inclinometer is an IMU that is in the "
        "robot's tree: a frame with two parents breaks the tree.",
    ),
    Parameter(
        "calibration_url",
        "",
        "Instrument file (YAML): misalignment and its error, mount, inclinometer, clock, shutter; "
        "'' uses the next three parameters. 1 deg of wrong misalignment moves the fix by 111 km, "
        "the largest error of all. A file whose focal length differs from camera_info's by 5 % is "
        "refused.",
    ),
    Parameter(
        "misalignment",
        (0.0, 0.0, 0.0),
        "A3 = R3(rz) R2(ry) R1(rx), camera into inclinometer; used without calibration_url.",
        unit="deg",
        minimum=-360.0,
        maximum=360.0,
    ),
    Parameter(
        "misalignment_stddev",
        NAN,
        "Error of the misalignment and of the inclinometer's zero together, each axis; 1 arcsec is "
        "31 m. If too small, fixes claim errors that are too small. If unset, the misalignment is "
        "unknown and the position error is over 1000 km.",
        unit="arcsec",
        minimum=0.0,
        maximum=36000.0,
    ),
    Parameter(
        "inclinometer.model",
        "",
        f"Inclinometer by its name, with the errors of its data sheet: {', '.join(sensors.PRESETS)}. Used without "
        "calibration_url, whose file names its own inclinometer. '' means an SCA100T as sold (7 km or more).",
    ),
    Parameter(
        "calibration_frames",
        100,
        "Number of newest frames kept for solver/calibrate. With few, the tilts' noise stays in A3; "
        "many take seconds to solve.",
        unit="",
        minimum=1,
        maximum=1000,
    ),
    Parameter(
        "calibration_turn_stddev",
        180.0,
        "When a calibration begins: error of the misalignment's rotation about the plumb line, that "
        "is of the direction the inclinometer faces. Frames at one lean, or turned about one "
        "leaning axis, do not determine it. 180 means unknown: fixes at another lean then claim "
        "large errors. If too small, those fixes are wrong.",
        unit="deg",
        minimum=0.000001,
        maximum=180.0,
    ),
    Parameter(
        "self_calibration",
        False,
        "Treat the misalignment as unknown and find it whenever the instrument has been turned on "
        "the spot to four headings or more. Until then fixes claim an error of 10 deg, and "
        "solver/reset must be called after driving on.",
    ),
    Parameter(
        "self_calibration_limit",
        60.0,
        "A calibration by turning is used if the plumb line in the camera errs by at most this; 1 "
        "arcsec is 31 m.",
        unit="arcsec",
        minimum=0.0,
        maximum=36000.0,
    ),
    Parameter(
        "refraction.pressure",
        NAN,
        "Air pressure at the instrument, not reduced to sea level, 30000 Pa or more, or 0 for a vacuum; unset widens "
        "the fix.",
        unit="Pa",
        minimum=0.0,
        maximum=120000.0,
    ),
    Parameter(
        "refraction.temperature",
        NAN,
        "Air temperature; unset widens the fix.",
        unit="deg C",
        minimum=-100.0,
        maximum=80.0,
    ),
    Parameter(
        "refraction.humidity",
        NAN,
        "Relative humidity; it hardly matters in visible light. Unset takes 0.3 +- 0.25.",
        unit="",
        minimum=0.0,
        maximum=1.0,
    ),
    Parameter(
        "refraction.wavelength",
        NAN,
        "Mean wavelength of the light that the camera sees. Unset takes 0.55 +- 0.08.",
        unit="um",
        minimum=0.2,
        maximum=10.0,
    ),
    Parameter(
        "altitude",
        NAN,
        "Height above the WGS 84 ellipsoid: a map's height above sea level plus the geoid's "
        "undulation there (-107 to 86 m). It is published in fix, and corrects the plumb line's "
        "curvature (5 m of latitude a km at 45 deg) unless deflection.xi or deflection.eta is set. "
        "The stars do not determine it. Unset publishes NaN, and some consumers drop such a fix.",
        unit="m",
        minimum=-1000.0,
        maximum=100000.0,
    ),
    Parameter(
        "altitude_stddev", 100.0, "Error of altitude, 1 sigma.", unit="m", minimum=0.0, maximum=100000.0
    ),
    Parameter(
        "clock_stddev",
        NAN,
        "Error against UTC of the clock that stamps the frames. Unset takes what the camera's host "
        "reports of its clock, at least the instrument file's value, or 0.01. 1 s is 464 m at the "
        "equator. If too small, fixes claim errors that are too small.",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
    ),
    Parameter(
        "deflection.xi",
        0.0,
        "Deflection of the vertical to the north, at the instrument; 1 arcsec is 31 m of geodetic latitude.",
        unit="arcsec",
        minimum=-120.0,
        maximum=120.0,
    ),
    Parameter(
        "deflection.eta",
        0.0,
        "Deflection of the vertical to the east.",
        unit="arcsec",
        minimum=-120.0,
        maximum=120.0,
    ),
    Parameter(
        "deflection.stddev",
        UNKNOWN_STDDEV_ARCSEC,
        "Error of each component; the default holds where the deflection is unknown.",
        unit="arcsec",
        minimum=0.0,
        maximum=120.0,
    ),
    Parameter(
        "deflection.geoid",
        "",
        "Geoid grid (GTX, NGS .bin, GeoTIFF; in m) that replaces the three above: its slopes are "
        "the deflection, and its roughness gives the error. Give a path, or the name of one of "
        "PROJ's grids such as egm96_15.gtx; '' for none. A coarse grid errs by 1 arcsec in plains "
        "and 10 in mountains. Outside its area the deflection is unknown: 6 arcsec, 190 m.",
    ),
    Parameter(
        "deflection.wanted",
        NAN,
        "Measure the deflection of the vertical at the site (needs site.geodetic and altitude) "
        "until each component errs by at most this. The service ~/deflection and the dashboard show "
        "the progress. Unset: it is not measured.",
        unit="arcsec",
        minimum=0.001,
        maximum=3.0,
        read_only=True,
    ),
    Parameter(
        "site.latitude",
        NAN,
        "Latitude of a known place, such as a pillar. heading/imu then needs no tilt. Unset: the "
        "place is unknown. If the stars contradict the place, no heading is published.",
        unit="deg",
        minimum=-90.0,
        maximum=90.0,
    ),
    Parameter(
        "site.longitude",
        NAN,
        "Longitude of the known place, east positive.",
        unit="deg",
        minimum=-360.0,
        maximum=360.0,
    ),
    Parameter(
        "site.geodetic",
        False,
        "True if the site is on WGS 84, as maps and receivers give it; false if it is astronomic, "
        "as in a fix without a deflection. If the deflection is unknown, the heading in the other "
        "system gets the deflection's error.",
    ),
    Parameter(
        "site.stddev",
        0.0,
        "Error of the site to the east and to the north; 31 m are 1 arcsec of pitch and roll.",
        unit="m",
        minimum=0.0,
        maximum=100000.0,
    ),
    Parameter(
        "min_stars", 5, "Minimum number of identified stars for a fix.", unit="", minimum=4, maximum=1000
    ),
    Parameter(
        "search_time",
        0.3,
        "Time limit for further searches of a frame that is not identified at once: with smaller "
        "triangles, where stars fill only a part of it; with other focal lengths, to report which "
        "one fits. They take at most half of the time between frames; recorded frames are searched "
        "to the end. 0: no further search.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "max_rate",
        NAN,
        "Maximum rate of frames that are answered, chosen evenly by their stamps. Unset answers all "
        "frames, or as large an even share as the processor can, which slows down other programs.",
        unit="Hz",
        minimum=0.01,
        maximum=MAX_RATE,
    ),
    Parameter(
        "gyro",
        False,
        "Use the turn rates in imu/data to predict where a turning camera looks, so that frames of "
        "four stars are identified too. The IMU has the axes of frame_id, related to the camera "
        "by calibration_url's link_to_camera; wrong ones do no harm. Without effect under "
        "use_sim_time, so that a replay gives the same answers at any rate.",
        read_only=True,
    ),
    Parameter(
        "gnss.use",
        False,
        "Learn the misalignment, the inclinometer's errors and the deflection from gnss/fix while "
        "the stars agree with it, and warn when they do not. `fix` remains the stars' own. GNSS "
        "that is spoofed from the first frame on teaches wrong values.",
        read_only=True,
    ),
    Parameter(
        "gnss.learned",
        "",
        "File that keeps what was learned from GNSS; it is read at the start. '' for none. Delete "
        "it after camera or inclinometer was remounted: an old file makes fixes wrong until GNSS "
        "disagrees.",
        read_only=True,
    ),
    Parameter(
        "tilt_window",
        0.5,
        "Time over which tilts are averaged if the exposure is unknown.",
        unit="s",
        minimum=0.01,
        maximum=60.0,
    ),
    Parameter(
        "tilt_timeout",
        NAN,
        "Longest time that a frame waits for the tilts of its exposure. Unset: 1.5 times the "
        "interval and delay of the tilts, at least 0.5 s.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "tilt_stddev",
        NAN,
        "Error of a tilt sample whose message states none. Unset takes the value of the instrument "
        "file or of inclinometer.model.",
        unit="deg",
        minimum=1e-7,
        maximum=10.0,
    ),
)


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


def geoid_file(name: str) -> Geoid | None:
    """Read the Geoid that deflection.geoid names, None for ''; GeoidError with the reason if it is broken."""
    return geoid.read(name) if name else None


def vertical_of(values: Mapping, known: Geoid | None) -> Vertical:
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


class Settings:
    """The parameters as `values` by name (settings.py), and the objects made from them and from their files.

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
                known = known_instrument(values["calibration_url"])
                if camera is not None:
                    check_camera(known, values["calibration_url"], camera)
            if "deflection.geoid" in names:
                grid = geoid_file(values["deflection.geoid"])
            if "gnss.learned" in names and values["gnss.learned"]:
                self.learned = states.read_learned(path_of(values["gnss.learned"]))
            check_gnss(values, instrument_of(values, ANY_CAMERA, known))
            atmosphere_of(values)
            check_deflection(values)
            site_of(values, vertical_of(values, grid))
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
        return vertical_of(self.values, self._geoid)

    @property
    def site(self) -> Place | None:
        """The place that is known; None where none is set."""
        return site_of(self.values, self.vertical)

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
            self.values["min_stars"],
        )
