# SPDX-License-Identifier: Apache-2.0
"""What the instrument is: optics, how its parts are fixed to each other, and how well that is known; its YAML file."""

import reprlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos import camera_yaml, rotation, yaml_file
from starpos.camera import Camera
from starpos.camera_yaml import LARGEST_SIDE
from starpos.errors import InstrumentError
from starpos.fix import Mounting
from starpos.inclinometer import SCA100T_NOISE_RAD

FORMAT = 1
# x of the base link is the top of the frame (-y of C), z the optical axis (DESIGN section 2)
TOP_OF_FRAME = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
UNSTATED_CALIBRATION_ARCSEC = 5.0  # 1 sigma a axis of an A3 given without its error


@dataclass(frozen=True)
class Instrument:
    """The paper's instrument, or another.

    focal_px: focal length; camera: full intrinsics, None for an ideal camera of any size; misalignment_deg: A3 =
    R3(rz) R2(ry) R1(rx), active, C into S; calibration_stddev_arcsec (3,): its errors about S's axes, the
    inclinometer's zero included; link_to_camera (3, 3): the base link's axes as C sees them.
    """

    focal_px: float
    camera: Camera | None = None
    misalignment_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    calibration_stddev_arcsec: tuple[float, float, float] = (UNSTATED_CALIBRATION_ARCSEC,) * 3
    link_to_camera: tuple = TOP_OF_FRAME
    tilt_noise_rad: float = SCA100T_NOISE_RAD
    clock_stddev_s: float = 0.01

    def __post_init__(self):
        for name, numbers in (
            ("focal length", [self.focal_px]),
            ("misalignment", self.misalignment_deg),
            ("calibration_stddev_arcsec", self.calibration_stddev_arcsec),
            ("link_to_camera", np.ravel(self.link_to_camera)),
            ("tilt noise", [self.tilt_noise_rad]),
            ("clock_stddev", [self.clock_stddev_s]),
        ):
            if not np.isfinite(np.asarray(numbers, float)).all():
                raise InstrumentError(f"the instrument's {name} is not a finite number: give one")
        if self.focal_px <= 0:
            raise InstrumentError(
                f"focal length {self.focal_px:g} px: must be positive (focal_mm * 1000 / pixel_um)"
            )
        if len(self.misalignment_deg) != 3 or len(self.calibration_stddev_arcsec) != 3:
            raise InstrumentError("misalignment_deg and calibration_stddev_arcsec are three numbers each")
        if min(*self.calibration_stddev_arcsec, self.clock_stddev_s) < 0:
            raise InstrumentError("a standard deviation of the instrument is negative: it must be 0 or more")
        if self.tilt_noise_rad <= 0:  # against 0 no instrument is ever at rest
            raise InstrumentError(
                f"the inclinometer's noise (tilt_noise_deg) is {np.degrees(self.tilt_noise_rad):g} deg: must be "
                "positive (of one reading, SCA100T 0.0035)"
            )
        link = np.asarray(self.link_to_camera, float)
        if (
            link.shape != (3, 3)
            or not np.allclose(link @ link.T, np.eye(3), atol=1e-6)
            or np.linalg.det(link) < 0
        ):
            raise InstrumentError("link_to_camera must be a 3 x 3 rotation matrix")

    def camera_for(self, width: int, height: int) -> Camera:
        """The camera of a frame of this size; InstrumentError where the intrinsics are of another size."""
        if self.camera is None:
            return Camera.from_focal(width, height, self.focal_px)
        if (self.camera.width, self.camera.height) != (width, height):
            raise InstrumentError(
                f"the frame is {width} x {height} px but the camera's intrinsics are of {self.camera.width} x "
                f"{self.camera.height} px: use those of this frame size"
            )
        return self.camera

    @property
    def mounting(self) -> Mounting:
        """A3 and the base link as matrices."""
        rx, ry, rz = np.radians(self.misalignment_deg)
        a3 = rotation.about_axis(2, rz) @ rotation.about_axis(1, ry) @ rotation.about_axis(0, rx)
        sigma = np.radians(np.asarray(self.calibration_stddev_arcsec) / 3600)
        return Mounting(a3, np.asarray(self.link_to_camera, float), np.diag(sigma**2))

    def turned_to(self, a3: np.ndarray) -> "Instrument":
        """The same with another A3 (3, 3)."""
        rx, ry = np.arctan2(a3[2, 1], a3[2, 2]), np.arcsin(np.clip(-a3[2, 0], -1, 1))
        rz = np.arctan2(a3[1, 0], a3[0, 0])
        return replace(self, misalignment_deg=tuple(float(x) for x in np.degrees([rx, ry, rz])))


def focal_px_of(focal_mm: float, pixel_um: float) -> float:
    """Focal length in px; InstrumentError unless both are positive."""
    if not (focal_mm > 0 and pixel_um > 0 and np.isfinite([focal_mm, pixel_um]).all()):
        raise InstrumentError(
            f"focal length {focal_mm:g} mm with {pixel_um:g} um pixels: both must be positive"
        )
    return focal_mm * 1000 / pixel_um


def read(path) -> Instrument:
    """An Instrument from its YAML file (format below); InstrumentError with the reason where it is none.

    starpos_instrument: 1
    camera: {focal_mm, pixel_um} or {width, height, fx, fy, cx, cy, distortion: [k1, k2, p1, p2, k3]}
            or {calibration: camera.yaml}, a CameraInfo calibration file beside this one or at a full path
    misalignment_deg: [rx, ry, rz]
    calibration_stddev_arcsec: [x, y, z]
    link_to_camera: [[..], [..], [..]]
    tilt_noise_deg: 0.0035
    clock_stddev_s: 0.01
    """
    path = Path(path)
    content = yaml_file.load(path, "instrument file")
    if not isinstance(content, dict) or content.pop("starpos_instrument", None) != FORMAT:
        raise InstrumentError(
            f"{path}: no instrument file of format {FORMAT}: its first key is `starpos_instrument: {FORMAT}`"
        )
    try:
        return _from_mapping(content, path.parent)
    except InstrumentError as e:
        raise InstrumentError(f"{path}: {e}") from None


def _from_mapping(content: dict, folder: Path) -> Instrument:
    known = (
        "camera",
        "misalignment_deg",
        "calibration_stddev_arcsec",
        "link_to_camera",
        "tilt_noise_deg",
        "clock_stddev_s",
    )
    _refuse_others(content, known)
    camera, given = content.get("camera"), {}
    if not isinstance(camera, dict):
        raise InstrumentError(
            f"camera is {_short(camera)}: give {{focal_mm, pixel_um}} or {{width, height, fx, fy, cx, cy}}"
        )
    if "focal_mm" in camera:
        _refuse_others(camera, ("focal_mm", "pixel_um"))
        focal_px = focal_px_of(_number(camera, "focal_mm"), _number(camera, "pixel_um"))
    elif "calibration" in camera:
        _refuse_others(camera, ("calibration",))
        if not isinstance(camera["calibration"], str):
            raise InstrumentError(
                f"the camera's calibration is {_short(camera['calibration'])}: give the name of a file"
            )
        given["camera"] = camera_yaml.read(folder / camera["calibration"])
        focal_px = given["camera"].fx
    else:
        axes = ("fx", "fy", "cx", "cy")
        _refuse_others(camera, ("width", "height", *axes, "distortion"))
        for side in ("width", "height"):
            if not isinstance(camera.get(side), int) or not 1 <= camera[side] <= LARGEST_SIDE:
                raise InstrumentError(
                    f"the camera's {side} is {_short(camera.get(side))}: give a whole number of pixels"
                )
        given["camera"] = Camera(
            camera["width"],
            camera["height"],
            *(_number(camera, k) for k in axes),
            _row(camera.get("distortion", [0.0] * 5), "distortion"),
        )
        focal_px = given["camera"].fx
    for key in ("misalignment_deg", "calibration_stddev_arcsec"):
        if key in content:
            given[key] = _row(content[key], key)
    if "link_to_camera" in content:
        rows = content["link_to_camera"]
        if not isinstance(rows, list) or len(rows) != 3:
            raise InstrumentError(f"link_to_camera is {_short(rows)}: give three rows of three numbers")
        given["link_to_camera"] = tuple(_row(row, "link_to_camera") for row in rows)
        if {len(row) for row in given["link_to_camera"]} != {3}:
            raise InstrumentError(
                "link_to_camera has a row of another length: give three rows of three numbers"
            )
    if "tilt_noise_deg" in content:
        given["tilt_noise_rad"] = float(np.radians(_number(content, "tilt_noise_deg")))
    if "clock_stddev_s" in content:
        given["clock_stddev_s"] = _number(content, "clock_stddev_s")
    return Instrument(focal_px, **given)


def _refuse_others(mapping: dict, known: tuple[str, ...]) -> None:
    if unknown := [key for key in mapping if key not in known]:
        raise InstrumentError(f"unknown key {_short(unknown[0])}: the keys here are {', '.join(known)}")


def _number(mapping: dict, key: str) -> float:
    try:
        return float(mapping[key])  # float reads 1e-3 too, which YAML takes for text
    except KeyError:
        raise InstrumentError(f"{key} is missing: give a number") from None
    except (TypeError, ValueError, OverflowError):
        raise InstrumentError(f"{key} is {_short(mapping[key])}: give a number") from None


def _row(numbers: list, key: str) -> tuple[float, ...]:
    if not isinstance(numbers, list):
        raise InstrumentError(f"{key} is {_short(numbers)}: give a list of numbers, like [0.0, 0.0, 0.0]")
    return tuple(_number({key: v}, key) for v in numbers)


def _short(value) -> str:
    """What a file gives for a value, in a sentence; however deep it is."""
    if isinstance(value, int) and abs(value) > 1e18:
        return "a number beyond any sense"
    text = "missing" if value is None else reprlib.repr(value)
    return text if len(text) < 60 else text[:57] + "..."
