# SPDX-License-Identifier: Apache-2.0
"""Files of the instrument (YAML, format 1) and of its camera (ROS's calibration YAML): read, written, updated."""

import math
import reprlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from starpos.errors import FrameError, InstrumentError, TimeError
from starpos.frames.exposure import Shutter
from starpos.instrument import platepar, sensors, yaml_file
from starpos.instrument.camera import COEFFICIENTS, PLUMB_BOB, Camera, check_axis, stated_lens
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import (
    MAX_SAG_ARCSEC,
    Calibration,
    CameraVertical,
    Instrument,
    focal_px_of,
    level_errors,
)
from starpos.units import ARCSEC, unix_of, utc_text

# Most pixels along a frame's side.
LARGEST_SIDE = 1_000_000


def read_camera(path: Path) -> Camera:
    """Read the camera from a calibration file; InstrumentError says why a file cannot be used."""
    content = yaml_file.load(path, "calibration file")
    try:
        model = content.get("distortion_model", "plumb_bob")
        width, height = content["image_width"], content["image_height"]
        k = tuple(float(value) for value in content["camera_matrix"]["data"])
        terms = content.get("distortion_coefficients")
        d = () if terms is None else tuple(float(value) for value in terms["data"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InstrumentError(
            f"{path}: a key of this calibration file is missing or of the wrong kind ({repr(error)[:120]}); "
            "it needs image_width, image_height, camera_matrix, distortion_coefficients."
        ) from None
    model, d = stated_lens(model if isinstance(model, str) else reprlib.repr(model), d, str(path))
    if any(type(side) is not int or side > LARGEST_SIDE for side in (width, height)):
        raise InstrumentError(f"{path}: image_width and image_height must be whole numbers of px.")
    if len(k) != 9 or any(k[i] for i in (1, 3, 6, 7)) or k[8] != 1:
        raise InstrumentError(
            f"{path}: camera_matrix is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate without skew."
        )
    check_axis(width, height, k[2], k[5], str(path))
    try:
        return Camera(
            width=width, height=height, fx=k[0], fy=k[4], cx=k[2], cy=k[5], distortion=d, model=model
        )
    except InstrumentError as error:
        raise InstrumentError(f"{path}: {error}") from None


def write_camera(path: Path, camera: Camera, name: str, comment: str = "") -> None:
    """Write a calibration file, whole or not at all; `comment` is text for people that every reader ignores.

    InstrumentError if the file cannot be written.
    """
    yaml_file.save(path, _camera_content(camera, name), comment)


def camera_as_written(path: Path, name: str) -> bool:
    """Whether a file is unchanged since `write` wrote it with a comment and this name."""
    try:
        text = yaml_file.text_at(path, "calibration file")
        comment = yaml_file.own_comment(text)
        return bool(comment) and text == yaml_file.text_of(_camera_content(read_camera(path), name), comment)
    except InstrumentError:
        return False


def _camera_content(camera: Camera, name: str) -> dict:
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    model, distortion = camera.stated
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _ros_matrix(3, 3, (fx, 0, cx, 0, fy, cy, 0, 0, 1)),
        "distortion_model": model,
        "distortion_coefficients": _ros_matrix(1, len(distortion), distortion),
        "rectification_matrix": _ros_matrix(3, 3, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        "projection_matrix": _ros_matrix(3, 4, (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)),
    }


def _ros_matrix(rows: int, columns: int, values: Sequence[float]) -> dict:
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values]}


# how the value of each key is read; it states the field of that name, or of the one in RENAMED
Schema = dict[str, Callable[[dict, str], Any]]
FORMAT = 1
MAX_FRAMES = 1 << 31
# placeholder of a focal length that a file for pointings does not state: it is not used
POINTED_FOCAL_PX = 10_000.0
# By key of the file: field of InclinometerErrors, and unit (rad or 1).
INCLINOMETER = {
    "tilt_noise_deg": ("noise_rad", math.radians(1)),
    "tilt_quantum_deg": ("quantum_rad", math.radians(1)),
    "tilt_drift_arcsec_per_sqrt_hour": ("drift_rad_per_sqrt_hour", ARCSEC),
    "tilt_temperature_arcsec_per_c": ("temperature_rad_per_c", ARCSEC),
    "tilt_scale": ("scale", 1.0),
    "tilt_cross": ("cross", 1.0),
    "tilt_pose_arcsec": ("pose_rad", ARCSEC),
    "tilt_range_deg": ("range_rad", math.radians(1)),
}
# keys that a calibration finds, of A3 or of a fixed camera's vertical; a file may have some of them
STDDEV, COVARIANCE = "calibration_stddev_arcsec", "calibration_covariance_arcsec2"
LINK_STDDEV = "link_to_camera_stddev_arcsec"
RENAMED = {COVARIANCE: "covariance_arcsec2", LINK_STDDEV: "mount_stddev_arcsec"}
CALIBRATION_KEYS = "misalignment_deg", STDDEV, COVARIANCE, "calibrated", "vertical"
SIDES = "width", "height"
INTRINSICS = "fx", "fy", "cx", "cy"


def read(path: Path | str, needs_camera: bool = True) -> Instrument:
    """Read an Instrument from its YAML file; InstrumentError says why a file cannot be used.

    Of RMS's platepar and `.config` it is the camera alone (platepar.py). docs/reference/files.md#the-instrument has the
    keys of the format, their units, and how a file has them that leaves them out.

    Parameters
    ----------
    path : of the file
    needs_camera : whether a file without a camera is refused; pointings need none

    Returns
    -------
    Instrument
        as the file states it

    Examples
    --------
    >>> starpos.read_instrument("instrument.yaml").calibration.misalignment_deg
    (0.0, 0.0, 0.0)
    """
    path = Path(path)
    if platepar.is_rms(path):
        return platepar.read(path).instrument
    content = yaml_file.load(path, "instrument file")
    if not isinstance(content, dict) or content.pop("starpos_instrument", None) != FORMAT:
        raise InstrumentError(
            f"{path}: no instrument file of format {FORMAT}: its first key is `starpos_instrument: {FORMAT}`"
        )
    try:
        return _from_mapping(content, path.parent, needs_camera)
    except (InstrumentError, FrameError) as e:
        raise InstrumentError(f"{path}: {e}") from None


def write(path: Path | str, instrument: Instrument, comment: str = "") -> None:
    """Write a file that `read` turns into the same Instrument.

    Parameters
    ----------
    path : of the file, which is replaced
    instrument : what is written
    comment : text for people, written at the end of the file

    Returns
    -------
    None

    Raises
    ------
    InstrumentError
        the file cannot be written

    Examples
    --------
    >>> instrument = starpos.Instrument(4635.9375)
    >>> starpos.write_instrument("mine.yaml", instrument)
    >>> starpos.read_instrument("mine.yaml") == instrument
    True
    """
    yaml_file.save(Path(path), content_of(instrument), comment)


def content_of(instrument: Instrument) -> dict[str, Any]:
    """The keys and values of an instrument's file."""
    c, vertical = instrument.calibration, instrument.vertical
    content: dict[str, Any] = {"starpos_instrument": FORMAT, "camera": _camera_of(instrument)}
    content |= _stated(c, CALIBRATION)
    if not math.isnan(c.utc_unix_s):
        content["calibrated"] = {"utc": utc_text(c.utc_unix_s), **_stated(c, CALIBRATED)}
    content |= _stated(instrument, INSTRUMENT)
    if instrument.inclinometer_model:
        content["inclinometer"] = {"model": instrument.inclinometer_model}
    if vertical is None:
        for key, (name, unit) in INCLINOMETER.items():
            content[key] = _in_unit(getattr(instrument.inclinometer, name), unit)
    else:
        sag = _in_unit(instrument.inclinometer.drift_rad_per_sqrt_hour, ARCSEC)
        content["vertical"] = _stated(vertical, VERTICAL) | {SAG: sag}
    if instrument.shutter is not None:
        content["shutter"] = _stated(instrument.shutter, SHUTTER)
    return content


def _stated(of: Any, schema: Schema) -> dict[str, Any]:
    """The keys and values of a part of an instrument, without what is as good as not stated."""
    values = {key: np.asarray(getattr(of, RENAMED.get(key, key))).tolist() for key in schema}
    return {
        key: v
        for key, v in values.items()
        if v != 0 and v != [] and (isinstance(v, list) or math.isfinite(v))
    }


def _camera_of(instrument: Instrument) -> dict[str, Any]:
    """The keys and values of an instrument's camera."""
    camera = instrument.camera
    if camera is None:
        sides = zip(SIDES, instrument.frame_size or (), strict=False)
        content: dict[str, Any] = {"focal_px": float(instrument.focal_px), **dict(sides)}
    else:
        content = {"width": camera.width, "height": camera.height}
        content |= {k: float(getattr(camera, k)) for k in INTRINSICS}
        content["distortion"] = [float(d) for d in camera.distortion]
    model = instrument.model if camera is None else camera.model
    return content if model == PLUMB_BOB else content | {"model": model}


def _from_mapping(content: dict, folder: Path, needs_camera: bool) -> Instrument:
    _refuse_others(content, KEYS)
    optics: dict[str, Any] = {"focal_px": POINTED_FOCAL_PX}
    if "camera" in content or needs_camera:
        optics = _camera(content.get("camera"), folder)
    given = {name: _error(content, key, unit) for key, (name, unit) in INCLINOMETER.items() if key in content}
    sensor, errors = _sensor(content, bool(given))
    more = _arguments(content, INSTRUMENT)
    if "shutter" in content:
        more["shutter"] = Shutter(**_arguments(_mapping(content, "shutter", SHUTTER), SHUTTER, needed=True))
    instrument = Instrument(
        **optics,
        calibration=_calibration(content),
        inclinometer=replace(errors, **given),
        inclinometer_model=sensor,
        **more,
    )
    if "vertical" not in content:
        return instrument
    if given or sensor:
        raise InstrumentError(
            "vertical is of a camera without an inclinometer: leave out inclinometer and the tilt_ keys"
        )
    about = _mapping(content, "vertical", (*VERTICAL, SAG))
    if math.isnan(instrument.calibration.utc_unix_s):
        raise InstrumentError("a vertical sags with time: say when it was found, calibrated: {utc: ...}")
    sag = _number(about, SAG)
    if not 0 <= sag <= MAX_SAG_ARCSEC:
        raise InstrumentError(f"{SAG} is {sag:g}: give a number from 0 to {MAX_SAG_ARCSEC:g}")
    vertical = CameraVertical(**_arguments(about, VERTICAL, needed=True))
    return replace(instrument, vertical=vertical, inclinometer=level_errors(sag))


def _arguments(content: dict, schema: Schema, needed: bool = False) -> dict[str, Any]:
    """The arguments of a part of an instrument that a mapping states; needed: all of them."""
    return {
        RENAMED.get(key, key): read(content, key) for key, read in schema.items() if needed or key in content
    }


def _camera(camera: object, folder: Path) -> dict[str, Any]:
    """Arguments of an Instrument: its camera, or the focal length and the lens of a camera without intrinsics."""
    if isinstance(camera, str):
        camera = {"calibration": camera}
    if not isinstance(camera, dict):
        raise InstrumentError(
            f"camera is {_short(camera)}: give {{focal_mm, pixel_um}} or {{width, height, fx, fy, cx, cy}}"
        )
    model = camera.get("model", PLUMB_BOB)
    if model not in tuple(COEFFICIENTS):
        raise InstrumentError(f"the camera's model is {_short(model)}: give {' or '.join(COEFFICIENTS)}")
    if "calibration" in camera:
        _refuse_others(camera, ("calibration",))
        if not isinstance(camera["calibration"], str):
            raise InstrumentError(
                f"the camera's calibration is {_short(camera['calibration'])}: give the name of a file"
            )
        full = read_camera(folder / camera["calibration"])
        return {"focal_px": full.fx, "camera": full}
    if "focal_mm" in camera or "focal_px" in camera:
        stated = ("focal_mm", "pixel_um") if "focal_mm" in camera else ("focal_px",)
        _refuse_others(camera, (*stated, *SIDES, "model"))
        numbers = [_number(camera, key) for key in stated]
        focal_px = focal_px_of(*numbers) if "focal_mm" in camera else numbers[0]
        size = _size(camera) if any(side in camera for side in SIDES) else None
        return {"focal_px": focal_px, "model": model, "frame_size": size}
    _refuse_others(camera, (*SIDES, *INTRINSICS, "distortion", "model"))
    width, height = _size(camera)
    numbers_by_key = {key: _number(camera, key) for key in INTRINSICS}
    distortion = _row({"distortion": [], **camera}, "distortion")
    full = Camera(width=width, height=height, distortion=distortion, model=model, **numbers_by_key)
    check_axis(width, height, full.cx, full.cy, "camera")
    return {"focal_px": full.fx, "camera": full}


def _size(camera: dict) -> tuple[int, int]:
    """Width and height of a camera's frame."""
    for side in SIDES:
        if type(camera.get(side)) is not int or not 1 <= camera[side] <= LARGEST_SIDE:
            raise InstrumentError(
                f"the camera's {side} is {_short(camera.get(side))}: give a whole number of pixels"
            )
    return camera[SIDES[0]], camera[SIDES[1]]


def _calibration(content: dict) -> Calibration:
    if STDDEV in content and COVARIANCE in content:
        raise InstrumentError(f"{STDDEV} and {COVARIANCE} say the same thing: give one of them")
    more = _arguments(content, CALIBRATION)
    if STDDEV in content:
        angles = more.get("misalignment_deg", (0.0, 0.0, 0.0))
        more["covariance_arcsec2"] = Calibration.of(angles, _row(content, STDDEV)).covariance_arcsec2
    if content.get("calibrated") is not None:
        about = _mapping(content, "calibrated", ("utc", *CALIBRATED))
        try:
            more["utc_unix_s"] = unix_of(str(about.get("utc")))
        except TimeError as e:
            raise InstrumentError(f"calibrated: {e}") from None
        more |= _arguments(about, CALIBRATED)
    return Calibration(**more)


def _sensor(content: dict, stated: bool) -> tuple[str, InclinometerErrors]:
    """Model of the inclinometer ('' without one) and the errors that this gives; stated: whether the file states some.

    A file that states some errors without a model describes a measured sensor: the other errors are a good sensor's.
    """
    if "inclinometer" not in content:
        return ("", InclinometerErrors()) if stated else sensors.find("")
    about = content["inclinometer"]
    if not isinstance(about, dict) or not isinstance(about.get("model"), str):
        raise InstrumentError(f"inclinometer is {_short(about)}: give {{model: NAME}}")
    _refuse_others(about, ("model",))
    return sensors.find(about["model"])


def _mapping(content: dict, key: str, known: Collection[str]) -> dict:
    """The mapping that a key has, of known keys."""
    about = content.get(key)
    if not isinstance(about, dict):
        raise InstrumentError(f"{key} is {_short(about)}: give {{{', '.join(known)}}}")
    _refuse_others(about, known)
    return about


def _refuse_others(mapping: dict, known: Collection[str]) -> None:
    if unknown := [key for key in mapping if key not in known]:
        raise InstrumentError(f"unknown key {_short(unknown[0])}: the keys here are {', '.join(known)}")


def _number(mapping: dict, key: str) -> float:
    try:
        # float would make 1 of true, which YAML also reads from yes and on
        if isinstance(mapping[key], bool):
            raise TypeError
        # and it reads 1e-3, which YAML takes for text
        return float(mapping[key])
    except KeyError:
        raise InstrumentError(f"{key} is missing: give a number") from None
    except (TypeError, ValueError, OverflowError):
        raise InstrumentError(f"{key} is {_short(mapping[key])}: give a number") from None


def _list(mapping: dict, key: str, what: str) -> list:
    if not isinstance(mapping.get(key), list):
        raise InstrumentError(f"{key} is {_short(mapping.get(key))}: give {what}")
    return mapping[key]  # type: ignore[no-any-return]


def _row(mapping: dict, key: str) -> tuple[float, ...]:
    return tuple(
        _number({key: v}, key) for v in _list(mapping, key, "a list of numbers, like [0.0, 0.0, 0.0]")
    )


def _square(mapping: dict, key: str) -> tuple:
    rows = _list(mapping, key, "rows of numbers")
    matrix = tuple(_row({key: row}, key) for row in rows)
    if {len(row) for row in matrix} - {len(rows)}:
        raise InstrumentError(f"{key} is {_short(rows)}: give as many numbers in each row as there are rows")
    return matrix


def _count(mapping: dict, key: str) -> int:
    number = mapping[key]
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < MAX_FRAMES:
        raise InstrumentError(f"calibrated: {key} is {_short(number)}: give a whole number")
    return number


def _error(mapping: dict, key: str, unit: float) -> float:
    """An error of the inclinometer, given in `unit`, in rad or as a share."""
    given = _number(mapping, key)
    most = math.pi / 2 if key == "tilt_range_deg" else 1
    if not 0 <= given * unit <= most:
        raise InstrumentError(f"{key} is {given:g}: give a finite number from 0 to {most / unit:.4g}")
    return given * unit


# of A3, of how it was found, of the rest, of a shutter, and of a fixed camera's vertical
CALIBRATION: Schema = {"misalignment_deg": _row, COVARIANCE: _square, "remounted_arcsec": _number}
CALIBRATED: Schema = {
    "temperature_c": _number,
    "tilt_deg": _row,
    "frames": _count,
    "valid_days": _number,
    "response": _row,
    "response_covariance": _square,
}
INSTRUMENT: Schema = {"link_to_camera": _square, LINK_STDDEV: _number, "clock_stddev_s": _number}
SHUTTER: Schema = {"readout_s": _number, "readout_stddev_s": _number}
VERTICAL: Schema = {"camera_to_itrs": _square, "covariance_arcsec2": _square}
SAG = "sag_arcsec_per_sqrt_hour"
KEYS = ("camera", *CALIBRATION_KEYS[:4], "remounted_arcsec", *tuple(INSTRUMENT)[:2], "inclinometer", *INCLINOMETER,
        "clock_stddev_s", "shutter", "vertical")  # fmt: skip


def _in_unit(value: float, unit: float) -> float:
    """A value in a unit, with as few digits as `read` needs to restore it exactly."""
    exact = float(value / unit)
    short = (float(f"{exact:.{digits}g}") for digits in range(1, 17))
    return next((number for number in short if number * unit == value), exact)


def _short(value: object) -> str:
    """A value of a file, short enough for a sentence, however deep it is."""
    if isinstance(value, int) and abs(value) > 1e18:
        return "a number beyond any sense"
    text = "missing" if value is None else reprlib.repr(value)
    return text if len(text) < 60 else text[:57] + "..."


def check_replaceable(path: Path) -> None:
    """Raise InstrumentError unless the file there is an instrument file, without a comment that a person wrote.

    The sentence does not say what to do.
    """
    try:
        read(path, needs_camera=False)
    except InstrumentError:
        raise InstrumentError(
            f"{path}: it is there already, and no instrument file that can be read"
        ) from None
    if line := yaml_file.line_of_comment(yaml_file.text_at(path, "instrument file")):
        raise InstrumentError(
            f"{path}: it is there already, and its line {line} has a comment, which would be lost"
        )


def check_fits(
    path: Path, instrument: Instrument, *, fixed: bool = False, camera_found: bool = False
) -> None:
    """Raise InstrumentError if the file describes another instrument than the one to be calibrated.

    fixed: of a camera fixed to the ground.  camera_found: the file's camera will be replaced too.
    """
    if not path.exists():
        return
    kept = read(path, needs_camera=False)
    if (kept.vertical is not None) != fixed:
        other = "an instrument with an inclinometer" if fixed else "a camera that is fixed to the ground"
        raise InstrumentError(
            f"{path}: it is there already, and of {other}: move it away, or write another file"
        )
    if not camera_found and _lens(kept) != _lens(instrument):
        what = "camera"
    elif not camera_found and None not in (kept.size, instrument.size) and kept.size != instrument.size:
        what = "frame size"
    elif not fixed and _says_sensor(instrument) and _sensor_errors(kept) != _sensor_errors(instrument):
        what = "inclinometer"
    else:
        return
    raise InstrumentError(
        f"{path}: it is there already, with another {what} than this calibration's: give --instrument {path}, or write "
        "another file"
    )


def _lens(instrument: Instrument) -> tuple:
    return instrument.focal_px, instrument.camera, instrument.model if instrument.camera is None else None


def _sensor_errors(instrument: Instrument) -> InclinometerErrors:
    # a calibration finds the errors of its poses and its noise
    return replace(instrument.inclinometer, pose_rad=0.0, noise_rad=0.0)


def _says_sensor(instrument: Instrument) -> bool:
    """Whether an instrument's inclinometer errors differ from the defaults."""
    return bool(instrument.inclinometer_model) or _sensor_errors(instrument) != _sensor_errors(
        Instrument(1.0)
    )


def update(path: Path, instrument: Instrument, comment: str, *, camera_found: bool = False) -> None:
    """Write an instrument file; an existing one keeps all keys except A3's, and the camera's if it was found.

    InstrumentError if it cannot be written.
    """
    new = content_of(instrument)
    if path.exists():
        stated = read(path, needs_camera=False).inclinometer
        says = _says_sensor(instrument)
        pose = says and stated.pose_rad < instrument.inclinometer.pose_rad
        noise = says and stated.noise_rad < instrument.inclinometer.noise_rad
        found = {*CALIBRATION_KEYS, *["camera"] * camera_found}
        found |= {*["tilt_pose_arcsec"] * bool(pose), *["tilt_noise_deg"] * bool(noise)}
        kept = yaml_file.load(path, "instrument file")
        changed = {k: v for k, v in kept.items() if k not in found} | {k: new[k] for k in found if k in new}
        if not camera_found and instrument.frame_size is not None:
            # to which the new A3 belongs
            sides = dict(zip(SIDES, instrument.frame_size, strict=True))
            changed["camera"] = kept["camera"] | sides
        order = ["starpos_instrument", *KEYS]
        new = {k: changed[k] for k in sorted(changed, key=order.index)}
    yaml_file.save(path, new, comment)
