# SPDX-License-Identifier: Apache-2.0
"""Description of the instrument: its optics, how its parts are fixed to each other, and how well that is known."""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import cached_property, lru_cache

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.errors import InstrumentError, TiltError
from starpos.frames.exposure import Exposure, Shutter
from starpos.frames.frame import Frame, Stars
from starpos.frames.gravity import contradicts
from starpos.frozen import at_once
from starpos.instrument.camera import EQUIDISTANT, PLUMB_BOB, Camera
from starpos.instrument.inclinometer import (
    EITHER_WAY,
    EXACT,
    RESPONSE_COEFFICIENTS,
    UNMEASURED_JUMP_C,
    InclinometerErrors,
    Tilt,
    angles_at,
    level_of,
    response_columns,
    stated_variances,
    up_of,
)
from starpos.instrument.sensors import built_in_rad, find, unnamed
from starpos.instrument.tilt_log import Tilts
from starpos.units import ARCSEC, DAY_S, utc_text

# default sag: a camera on a pillar or a heavy tripod during a night
SAG_ARCSEC_PER_SQRT_HOUR, MAX_SAG_ARCSEC = 10.0, 3600.0
# noise of the fictitious reading, rad: negligible
NO_NOISE = 1e-9


@dataclass(frozen=True)
class CameraVertical:
    """Attitude of a fixed camera at its calibration; InstrumentError for impossible values.

    camera_to_itrs      (3, 3): C into ITRS
    covariance_arcsec2  (3, 3) of it as a small rotation about the Earth's axes, by the stars alone
    """

    camera_to_itrs: tuple
    covariance_arcsec2: tuple

    def __post_init__(self) -> None:
        _check_rotation(self.camera_to_itrs, "the vertical's camera_to_itrs")
        _check_covariance(self.covariance_arcsec2, 3, "the vertical's covariance_arcsec2")


def _check_rotation(given: object, name: str) -> None:
    matrix = np.asarray(given, float)
    sound = (
        matrix.shape == (3, 3)
        # squares must not overflow; false for NaN too
        and np.abs(matrix).max() < 2
        and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6)
        and np.linalg.det(matrix) > 0
    )
    if not sound:
        raise InstrumentError(f"{name} must be a 3 x 3 rotation matrix")


def _check_covariance(given: object, rows: int, name: str) -> None:
    """Raise InstrumentError unless this is a covariance, to rounding."""
    matrix = np.asarray(given, float)
    sound = (
        matrix.shape == (rows, rows)
        and np.isfinite(matrix).all()
        and np.allclose(matrix, matrix.T, rtol=1e-6)
        and np.linalg.eigvalsh(matrix)[0] >= -1e-9 * max(np.trace(matrix), 1e-300)
    )
    if not sound:
        raise InstrumentError(
            f"{name} must be a symmetric {rows} x {rows} matrix without negative variances: correct it"
        )


def level_errors(sag_arcsec_per_sqrt_hour: float) -> InclinometerErrors:
    """Errors of a fixed camera as its own level: its sag alone."""
    return replace(EXACT, noise_rad=NO_NOISE, drift_rad_per_sqrt_hour=sag_arcsec_per_sqrt_hour * ARCSEC)


# the reading of that level
OWN_LEVEL = Tilt(0.0, 0.0, np.eye(2) * NO_NOISE**2, utc_unix_s=0.0)
NO_GRAVITY = (
    "give it as the telephone wrote it (a screenshot, an edited or a sent copy has no gravity). Without gravity "
    "there are still: starpos identify, its heading with --site, a log of the level as --tilt, or a plumb line"
)


@dataclass(frozen=True)
class ByGravity:
    """The tilts of a telephone's photographs, as `starpos.instrument.tilt_log.Tilts`; S is then C.

    log: of the telephone that took them, in S; None: their own files state gravity.
    camera: that took them; '': any.
    """

    log: Tilts | None = None
    camera: str = ""

    def has(self, frame: Exposure) -> bool:
        """Whether a photograph can have a tilt."""
        return (frame.gravity if self.log is None else frame.upper_edge) is not None

    def of(self, frame: Exposure, instrument: "Instrument") -> Tilts:
        """The tilts of a photograph, of three axes; TiltError if its file states no gravity, or by another level."""
        gravity, model = frame.gravity, instrument.inclinometer_model
        if not self.has(frame) or frame.mid_unix_s is None:
            raise self.missing(frame)
        if self.log is not None:
            return self.log
        assert gravity is not None
        if gravity.model != model and built_in_rad(model):
            raise TiltError(
                f"{frame.place}: its level is a {gravity.model}'s, the others' a {model}'s: solve them apart"
            )
        if self.camera and gravity.camera != self.camera:
            raise TiltError(
                f"{frame.place}: it is by another camera ({gravity.camera}) than the first ({self.camera}), whose level "
                "errs otherwise: solve them apart"
            )
        variance = instrument.inclinometer.noise_rad**2 + gravity.stddev_rad**2
        theta_x, theta_y, theta_z = np.arcsin(np.clip(gravity.up, -1, 1)).tolist()
        return Tilt(
            theta_x,
            theta_y,
            np.eye(2) * variance,
            theta_z=theta_z,
            variance_z=variance,
            utc_unix_s=frame.mid_unix_s,
            # a copy of the photograph has the same error
            times=(frame.mid_unix_s,),
        )

    def check_held(self, frame: Exposure, tilt: Tilt) -> None:
        """Raise TiltError if a photograph's Orientation contradicts a tilt of the log."""
        if self.log is not None and frame.upper_edge is not None and contradicts(frame.upper_edge, tilt.up):
            raise TiltError(
                f"{frame.place}: its Orientation says that another edge was up than the telephone's log does: it is "
                "the log of another telephone or time, or this one's sensor lies otherwise: state it with --misalignment"
            )

    def missing(self, frame: Exposure) -> TiltError:
        """Why a photograph has no gravity, and what can be done."""
        if self.log is not None:
            return TiltError(
                f"{frame.place}: it is no telephone's picture as the sensor gave it, so its place in the log's axes is "
                "unknown: give the file as the telephone wrote it, or --misalignment"
            )
        return TiltError(f"{frame.place}: {frame.unlevelled or 'its file states no gravity'}: {NO_GRAVITY}")

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """TiltError: gravity is a photograph's, whatever its time."""
        raise TiltError(f"no gravity: {NO_GRAVITY}")


# x of the base link is the top of the frame (-y of C), z the optical axis (docs/frames_and_symbols.md#frames)
TOP_OF_FRAME = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
# 1 sigma about S's axes of an A3 without a stated error: 10 deg, and any turn about the plumb line
UNKNOWN_ARCSEC = (36000.0, 36000.0, 324000.0)
# how long an A3 that is found may be used
VALID_DAYS = 365.0
# Limits of a calibration: an error of several turns means unknown; no inclinometer is hotter.
MAX_ARCSEC, MAX_C = 1e7, 200.0
MAX_CLOCK_S = 86400.0
# 1 sigma of a clock without a stated error, if it is kept by NTP
UNKNOWN_CLOCK_S = 0.1
MAX_RESPONSE = 0.5

# every frame asks for its camera
_ideal = lru_cache(maxsize=4)(Camera.from_focal)


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """A3, how well it is known, and when and how it was found; InstrumentError for impossible values.

    Attributes
    ----------
    misalignment_deg : (rx, ry, rz): A3 = R3(rz) R2(ry) R1(rx), active, C into S
    covariance_arcsec2 : (3, 3) of A3 as a small rotation about S's axes, including the inclinometer's zero
    remounted_arcsec : 1 sigma about each axis of A3's turn since camera and inclinometer were taken apart and put
        together again; 0: they were not
    utc_unix_s : when it was found; NaN: unknown
    temperature_c : temperature of the inclinometer then; NaN: unknown
    tilt_deg : its two or three angles then; an error of the scale grows with the distance from them
    frames : number of frames it was found from
    valid_days : how long it may be used
    response : coefficients of the inclinometer's response that were found with A3 (inclinometer.py), or ()
    response_covariance : square, of these

    Examples
    --------
    >>> known = starpos.Calibration.of((0.91, -0.48, 20.0), (5.0, 5.0, 5.0))  # deg, arcsec
    >>> known.a3.shape
    (3, 3)
    """

    misalignment_deg: tuple[float, ...] = (0.0, 0.0, 0.0)
    covariance_arcsec2: tuple = tuple(map(tuple, np.diag(UNKNOWN_ARCSEC) ** 2))
    remounted_arcsec: float = 0.0
    utc_unix_s: float = math.nan
    temperature_c: float = math.nan
    tilt_deg: tuple[float, ...] = (0.0, 0.0)
    frames: int = 0
    valid_days: float = float("inf")
    response: tuple[float, ...] = ()
    response_covariance: tuple = ()

    def __post_init__(self) -> None:
        angles, tilt = np.asarray(self.misalignment_deg, float), np.asarray(self.tilt_deg, float)
        # each false for NaN too
        if not (angles.shape == (3,) and np.abs(angles).max() <= 360):
            raise InstrumentError(
                "misalignment_deg is three numbers within 360 deg: give A3's three angles in deg"
            )
        if not (
            tilt.shape in ((2,), (3,))
            and np.abs(tilt).max() <= 90
            and np.sum(np.sin(np.radians(tilt[:2])) ** 2) <= 1
        ):
            raise InstrumentError(
                "tilt_deg of the calibration is impossible: give the elevations of the inclinometer's two or three axes, "
                "in deg"
            )
        if not (np.isnan(self.temperature_c) or abs(self.temperature_c) < MAX_C):
            raise InstrumentError(f"temperature_c of the calibration is {self.temperature_c:g}: give deg C")
        covariance = np.asarray(self.covariance_arcsec2, float)
        if not np.abs(covariance).max(initial=0) <= MAX_ARCSEC**2:
            raise InstrumentError(
                f"the calibration's covariance is beyond any turn: give variances of at most {MAX_ARCSEC**2:g} arcsec2"
            )
        _check_covariance(covariance, 3, "the calibration's covariance")
        self._check_response()
        if not 0 <= self.remounted_arcsec <= MAX_ARCSEC:
            raise InstrumentError(
                f"remounted_arcsec of the calibration is {self.remounted_arcsec:g}: give 0 to {MAX_ARCSEC:g}"
            )
        if not self.valid_days > 0:
            raise InstrumentError(f"valid_days is {self.valid_days}: must be positive")
        for name in ("utc_unix_s", "temperature_c"):
            if math.isnan(getattr(self, name)):
                # one NaN object, which compares equal to itself in sequences
                object.__setattr__(self, name, math.nan)

    def _all(self) -> tuple:
        return tuple(getattr(self, f.name) for f in fields(self))

    def __eq__(self, other: object) -> bool:
        """Whether all fields are equal, unknown ones too: in Python 3.13 a dataclass with a NaN differs from itself."""
        return self._all() == other._all() if isinstance(other, Calibration) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._all())

    def _check_response(self) -> None:
        """Raise InstrumentError for coefficients of a response that no sensor has."""
        if not self.response:
            return
        n, covariance = len(self.response), np.asarray(self.response_covariance, float)
        if n not in RESPONSE_COEFFICIENTS.values() or covariance.shape != (n, n):
            raise InstrumentError(
                f"the calibration's response has {n} coefficients: give the 5 of two axes or the 9 of three, and a "
                "covariance of as many rows and columns"
            )
        if not np.abs(self.response).max() <= MAX_RESPONSE:
            raise InstrumentError(
                f"the calibration's response is not valid: its coefficients must be at most {MAX_RESPONSE:g}"
            )
        _check_covariance(covariance, n, "the covariance of the calibration's response")

    @classmethod
    def of(
        cls, misalignment_deg: Sequence[float], stddev_arcsec: Sequence[float] = UNKNOWN_ARCSEC
    ) -> "Calibration":
        """Make a Calibration from three angles and the standard deviations (3,) about S's axes."""
        for name, numbers in (
            ("misalignment_deg", misalignment_deg),
            ("calibration_stddev_arcsec", stddev_arcsec),
        ):
            if np.shape(numbers) != (3,):
                raise InstrumentError(f"{name} is three numbers, one for each axis: give three")
        if not (
            np.isfinite(stddev_arcsec).all() and 0 <= min(stddev_arcsec) <= max(stddev_arcsec) <= MAX_ARCSEC
        ):
            raise InstrumentError(
                f"calibration_stddev_arcsec must be finite numbers of 0 or more, at most {MAX_ARCSEC:g}"
            )
        covariance = np.diag(np.square(np.asarray(stddev_arcsec, float)))
        return cls(
            misalignment_deg=tuple(misalignment_deg),
            covariance_arcsec2=tuple(map(tuple, covariance.tolist())),
        )

    @cached_property
    def a3(self) -> np.ndarray:
        """The rotation A3 (3, 3), C into S."""
        rx, ry, rz = np.radians(self.misalignment_deg)
        return rotation.about_axis(2, rz) @ rotation.about_axis(1, ry) @ rotation.about_axis(0, rx)

    def turned_to(self, a3: np.ndarray) -> "Calibration":
        """The calibration with another A3 (3, 3)."""
        rx, ry = np.arctan2(a3[2, 1], a3[2, 2]), np.arctan2(-a3[2, 0], np.hypot(a3[2, 1], a3[2, 2]))
        # what is left is about Z, also where ry is 90 deg and rx is any angle
        left = a3 @ (rotation.about_axis(1, ry) @ rotation.about_axis(0, rx)).T
        rz = np.arctan2(left[1, 0], left[0, 0])
        return replace(self, misalignment_deg=tuple(float(x) for x in np.degrees([rx, ry, rz])))

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of A3."""
        return np.asarray(self.covariance_arcsec2, float) * ARCSEC**2

    @cached_property
    def covariance_root(self) -> np.ndarray:
        """The symmetric root (3, 3) in rad of this covariance."""
        return symmetric_root(self.covariance)

    @cached_property
    def response_root(self) -> np.ndarray:
        """The symmetric root (m, m) of the covariance of the response."""
        return symmetric_root(self.response_covariance)

    @cached_property
    def up(self) -> np.ndarray:
        """Up (3,) in S when it was found."""
        return up_of(np.radians(self.tilt_deg))

    def warmer_c(self, tilt: Tilt) -> float:
        """The inclinometer's temperature at a tilt minus the calibration's; NaN if one is unknown."""
        return tilt.temperature_c - self.temperature_c

    @property
    def unmeasured_c(self) -> float:
        """1 sigma of `warmer_c` where it is unknown.

        If a calibration has neither a date nor a temperature, its stated error holds for all temperatures: 0.
        """
        dated = np.isfinite([self.utc_unix_s, self.temperature_c]).any()
        return UNMEASURED_JUMP_C if dated else 0.0

    @property
    def angle_covariance_deg2(self) -> np.ndarray:
        """Covariance (3, 3) of misalignment_deg; near ry = 90 deg it grows without bound."""
        step = 1e-7
        around = [
            [self.turned_to(rotation.from_vector(s * axis) @ self.a3).misalignment_deg for s in (-step, step)]
            for axis in np.eye(3)
        ]
        differences = np.radians([np.subtract(after, before) for before, after in around])
        slope = rotation.half_turns(differences).T / (2 * step)
        return slope @ np.asarray(self.covariance_arcsec2) @ slope.T / 3600**2

    @property
    def unknown(self) -> bool:
        """Whether nothing is known of how the inclinometer lies against the camera."""
        return bool(self._variances[1] >= (UNKNOWN_ARCSEC[0] / 2) ** 2)

    @property
    def turn_stddev_deg(self) -> float:
        """Standard deviation (deg) about the axis about which A3 is known least: mostly the plumb line."""
        return float(np.sqrt(max(self._variances[-1], 0.0))) / 3600

    @cached_property
    def _variances(self) -> np.ndarray:
        """Variances (3,) in arcsec2 about the axes about which A3 is known best to least."""
        return np.linalg.eigvalsh(np.asarray(self.covariance_arcsec2, float))

    def check_age(self, utc_unix_s: float) -> None:
        """Raise InstrumentError if it is too old, or too new, for a frame of that time."""
        age_days = abs(utc_unix_s - self.utc_unix_s) / DAY_S
        if age_days > self.valid_days:
            raise InstrumentError(
                f"the calibration of {utc_text(self.utc_unix_s)} is {age_days:.0f} days from this frame and holds for "
                f"{self.valid_days:g}: calibrate again, or raise valid_days in the instrument file"
            )


# lower bound of the cosine that turns an error of the sine into one of the angle
MIN_COSINE = 0.1


@at_once
@dataclass(frozen=True)
class LocalLevel:
    """The local level L that a tilt shows.

    up        (3,) in S, corrected by the response
    a2        (3, 3): S into L
    camera    (3, 3): C into L, A2 A3
    response  (3, m): change of up for 1 sigma of each error of the response
    """

    up: np.ndarray
    a2: np.ndarray
    camera: np.ndarray
    response: np.ndarray

    @cached_property
    def turns(self) -> np.ndarray:
        """Matrix (3, 3) from a change of up (3,) in S to a small rotation (3,) of L about its axes; zero about Z."""
        return np.array([self.a2[1], -self.a2[0], np.zeros(3)])


@dataclass(frozen=True)
class Instrument:
    """The instrument of the paper, or another one; InstrumentError for impossible values.

    Attributes
    ----------
    focal_px : focal length, px
    camera : full intrinsics; None: an ideal camera
    frame_size : (width, height) px of the whole frame of that ideal camera, in whose middle its axis lies, and to
        which A3 belongs; None: not stated, the axis is in the middle of any frame
    model : of the lens of that ideal camera: PLUMB_BOB, or EQUIDISTANT for a fisheye
    calibration : A3 and its errors
    link_to_camera : (3, 3), base link into C
    mount_stddev_arcsec : 1 sigma of link_to_camera about each axis; 0 for a link along the camera's own axes
    axis_stddev_rad : 1 sigma of the optical axis in frames that are an unknown part of a sensor
    lens_stddev_rad : 1 sigma of directions in C, about each axis across the optical one, by what is unknown of the lens
    inclinometer : its errors; unless stated, an SCA100T's as sold
    inclinometer_model : name among sensors.presets() that these errors began with; '': none
    clock_stddev_s : standard deviation of the clock against UTC, s
    shutter : times of the camera's rows; None: as the source of the frames states them
    vertical : of a camera fixed to the ground, which is its own level; None: there is an inclinometer

    Examples
    --------
    >>> known = starpos.Calibration.of((0, 0, 0), (5, 5, 5))
    >>> instrument = starpos.Instrument(4636.0, calibration=known)
    >>> instrument.camera_for(1000, 700).fx
    4636.0
    """

    focal_px: float
    _: KW_ONLY
    camera: Camera | None = None
    frame_size: tuple[int, int] | None = None
    model: str = PLUMB_BOB
    calibration: Calibration = field(default_factory=Calibration)
    link_to_camera: tuple = TOP_OF_FRAME
    mount_stddev_arcsec: float = 0.0
    axis_stddev_rad: float = 0.0
    lens_stddev_rad: float = 0.0
    inclinometer: InclinometerErrors = field(default_factory=unnamed)
    inclinometer_model: str = ""
    clock_stddev_s: float = UNKNOWN_CLOCK_S
    shutter: Shutter | None = None
    vertical: CameraVertical | None = None

    def __post_init__(self) -> None:
        if not 0 < self.focal_px < math.inf:
            raise InstrumentError(
                f"focal length {self.focal_px:g} px: must be positive (focal_mm * 1000 / pixel_um)"
            )
        if not 0 <= self.clock_stddev_s <= MAX_CLOCK_S:
            raise InstrumentError(
                f"clock_stddev_s of the instrument is {self.clock_stddev_s:g}: it must be 0 or more, at most a day"
            )
        if not 0 <= self.mount_stddev_arcsec <= MAX_ARCSEC:
            raise InstrumentError(
                f"link_to_camera_stddev_arcsec is {self.mount_stddev_arcsec:g}: give 0 to {MAX_ARCSEC:g}"
            )
        # with noise 0 every instrument would count as moving
        if self.inclinometer.noise_rad <= 0:
            raise InstrumentError(
                f"the inclinometer's noise (tilt_noise_deg) is {np.degrees(self.inclinometer.noise_rad):g} deg: must be "
                "positive (of one reading, SCA100T 0.0035)"
            )
        _check_rotation(self.link_to_camera, "link_to_camera")

    @property
    def has_level_inside(self) -> bool:
        """Whether the inclinometer is a camera's own, whose axes are near the camera's."""
        return built_in_rad(self.inclinometer_model) > 0 and not self.calibration.unknown

    def levelled_by(self, model: str) -> "Instrument":
        """The instrument with a level of this model inside its camera, as far as A3 and the inclinometer are unknown."""
        known = self
        if self.calibration.unknown:
            stddev = built_in_rad(model) / ARCSEC
            known = replace(known, calibration=Calibration.of((0.0, 0.0, 0.0), (stddev,) * 3))
        if not self.inclinometer_model and self.inclinometer == unnamed():
            name, errors = find(model)
            known = replace(known, inclinometer=errors, inclinometer_model=name)
        return known

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height (px) of the whole frame, to which camera and A3 belong; None: not stated."""
        return self.frame_size if self.camera is None else (self.camera.width, self.camera.height)

    def camera_for(self, width: int, height: int, origin_px: tuple[float, float] | None = None) -> Camera:
        """The camera for a frame of this size, that begins at a column and row of the whole one.

        InstrumentError if the frame is of another size than the whole one, or not within it.
        """
        if self.size is None:
            return _ideal(width, height, self.focal_px, self.model)
        whole = self.camera or _ideal(*self.size, self.focal_px, self.model)
        left, top = origin_px or (math.nan, math.nan)
        # an unstated part of just this size: the camera was calibrated with pictures that are cut out alike
        if math.isnan(left + top) and self.size == (width, height):
            return whole
        if not (0 <= left <= whole.width - width and 0 <= top <= whole.height - height):
            where = "" if math.isnan(left + top) else f" at column {left:g}, row {top:g}"
            what = "focal length and A3 are" if self.camera is None else "the camera's intrinsics are"
            raise InstrumentError(
                f"the frame is {width} x {height} px{where} but {what} of {whole.width} x {whole.height} px: "
                "use an instrument file of this frame size, or frames whose header states their part of the sensor "
                "(XORGSUBF, YORGSUBF)"
            )
        return whole.part(left, top, width, height) if (width, height) != self.size else whole

    def whole_of(self, camera: Camera, origin_px: tuple[float, float] | None) -> Camera:
        """The camera of the whole frame from the camera of a part which begins at a column and row, if both are known."""
        if self.size is None or origin_px is None or math.isnan(sum(origin_px)):
            return camera
        return camera.part(-origin_px[0], -origin_px[1], *self.size)

    def level(self, tilt: Tilt) -> LocalLevel:
        """The level at a tilt; InstrumentError if the response is of a sensor with another number of axes.

        TiltError if it may point up or down.

        Zeros that were not calibrated are assumed to err by the contradiction of the axes.
        """
        c = self.calibration
        if tilt.either_way:
            raise TiltError(EITHER_WAY)
        if c.response:
            columns = response_columns(tilt.theta, tilt.up, c.up)
            if columns.shape[1] != len(c.response):
                raise InstrumentError(
                    f"the calibration's response has {len(c.response)} coefficients, and a tilt of {tilt.axes} axes "
                    f"needs {columns.shape[1]}: calibrate with the inclinometer that is used"
                )
            up, response = rotation.normalised(tilt.up - columns @ c.response), columns @ c.response_root
        else:
            # with three axes the consistent angles, as at the calibration: so nothing counts at its lean
            up, theta = tilt.up, angles_at(tilt.up, tilt.axes)
            variances = stated_variances(self.inclinometer, tilt.axes)
            wrong = self.inclinometer.contradiction(tilt) / np.maximum(np.cos(theta), MIN_COSINE)
            variances[: tilt.axes] += wrong**2
            response = response_columns(theta, tilt.up, c.up) * np.sqrt(variances)
        a2 = level_of(up)
        return LocalLevel(up, a2, a2 @ c.a3, response)


def focal_px_of(focal_mm: float, pixel_um: float) -> float:
    """Focal length in px; InstrumentError unless both are positive."""
    if not (focal_mm > 0 and pixel_um > 0 and np.isfinite([focal_mm, pixel_um]).all()):
        raise InstrumentError(
            f"focal length {focal_mm:g} mm with {pixel_um:g} um pixels: both must be positive"
        )
    return focal_mm * 1000 / pixel_um


# Longer over shorter side of sensors and of cameras' crops, and tolerance on it.
SENSOR_SHAPES = (1.0, 5 / 4, 4 / 3, 3 / 2, 8 / 5, 16 / 9)
SHAPE_OFF = 0.05
# Frame sizes of some cameras; programs also crop larger sensors to these sizes.
STANDARD_SIZES = {(320, 240), (640, 480), (800, 600), (1024, 768), (1280, 720), (1280, 960), (1280, 1024), (1600, 1200),
                  (1920, 1080)}  # fmt: skip
# 1 sigma of the axis from a frame's centre if the frame's part of the sensor is unknown: its longer side, and at least
# this, as most sensors have up to 7000 px
MIN_UNKNOWN_PX = 2000.0
# 1 sigma, in focal lengths, along x and y, of a fisheye's axis from a frame's centre, as of three real cameras; with an
# axis much further off its stars do not fit an ideal lens
FISHEYE_AXIS = 0.04
SIZE_IN_FILE = "camera: {focal_mm, pixel_um, width, height} in the instrument file"


def framed(instrument: Instrument, first: Frame | Stars, error: str) -> tuple[Instrument, str]:
    """The instrument for the frames of a night by the first of them; and a sentence if their axis is not known, else ''.

    An instrument that knows its frame's size stays as it is.  Else a frame counts as a whole one, and its size holds for
    the others, unless its header says that it begins somewhere on a sensor, or no sensor has its shape: then
    axis_stddev_rad has the axis's error, and `error` says of what it becomes a part.  A standard size may be either: that
    is a doubt, which is not counted.
    """
    if instrument.size is not None:
        return instrument, ""
    width, height, origin_px = first.width, first.height, first.origin_px
    longer, shorter = max(width, height), min(width, height)
    if origin_px is None:
        instrument = replace(instrument, frame_size=(width, height))
        if any(abs(longer / shorter / shape - 1) < SHAPE_OFF for shape in SENSOR_SHAPES):
            if (longer, shorter) not in STANDARD_SIZES:
                return instrument, ""
            return instrument, (
                f"frames of {width} x {height} px count as whole ones: if they are cut out of larger ones, the optical "
                f"axis may be off their middle and the place wrong: give the whole frame's size, {SIZE_IN_FILE}"
            )
        why = f"no sensor has the shape of frames of {width} x {height} px"
    elif np.isfinite(origin_px).all():
        left, top = origin_px
        # a crop is assumed to be from the middle, for lack of better; frames that begin elsewhere then agree with it
        whole_size = round(width + 2 * max(left, 0.0)), round(height + 2 * max(top, 0.0))
        instrument = replace(instrument, frame_size=whole_size)
        why = (
            f"these frames of {width} x {height} px begin at column {left:g}, row {top:g} of a sensor whose "
            f"size is not stated"
        )
    else:
        why = f"these frames of {width} x {height} px are cut out of larger ones at an unstated position"
    error_px = max(longer, MIN_UNKNOWN_PX)
    if instrument.model == EQUIDISTANT:
        error_px = min(error_px, FISHEYE_AXIS * instrument.focal_px)
    error_rad = math.atan(error_px / instrument.focal_px)
    return replace(instrument, axis_stddev_rad=error_rad), (
        f"{why}: the optical axis may be {error_px:.0f} px from their centre, {math.degrees(error_rad):.2g} deg that "
        f"count as an error of {error}: give the whole frame's size, {SIZE_IN_FILE}"
    )


def with_frame_size(instrument: Instrument, first: Frame | Stars) -> tuple[Instrument, str]:
    """The instrument as `framed` has it, with the axis's error included in A3's, and its doubt; '' if A3 is not known.

    Headings at a known place, which need no A3, take the error from axis_stddev_rad.
    """
    instrument, doubt = framed(instrument, first, "A3")
    calibration = instrument.calibration
    if not doubt or calibration.unknown:
        return instrument, ""
    axis2 = (instrument.axis_stddev_rad / ARCSEC) ** 2
    widened = np.asarray(calibration.covariance_arcsec2, float) + np.eye(3) * axis2
    wide = replace(calibration, covariance_arcsec2=tuple(map(tuple, widened.tolist())))
    return replace(instrument, calibration=wide), doubt
