# SPDX-License-Identifier: Apache-2.0
"""Camera calibration files: the YAML that camera_calibration, camera_info_manager and image_proc write and read."""

import reprlib
from collections.abc import Sequence
from pathlib import Path

from starpos.errors import InstrumentError
from starpos.instrument import yaml_file
from starpos.instrument.camera import Camera
from starpos.instrument.lens import stated_lens

# Most pixels along a frame's side.
LARGEST_SIDE = 1_000_000


def read(path: Path) -> Camera:
    """Read the camera from a calibration file; InstrumentError says why a file cannot be used."""
    content = yaml_file.load(path, "calibration file")
    try:
        model = content.get("distortion_model", "plumb_bob")
        width, height = content["image_width"], content["image_height"]
        k = _numbers(content["camera_matrix"], 9)
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
    if any(k[i] for i in (1, 3, 6, 7)) or k[8] != 1:
        raise InstrumentError(
            f"{path}: camera_matrix is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate without skew."
        )
    try:
        return Camera(
            width=width, height=height, fx=k[0], fy=k[4], cx=k[2], cy=k[5], distortion=d, model=model
        )
    except InstrumentError as error:
        raise InstrumentError(f"{path}: {error}") from None


def _numbers(matrix: dict, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in matrix["data"])
    if len(values) != count:
        raise ValueError(f"{len(values)} values for {count}")
    return values


def write(path: Path, camera: Camera, name: str, comment: str = "") -> None:
    """Write a calibration file, whole or not at all; `comment` is text for people that every reader ignores.

    InstrumentError if the file cannot be written.
    """
    yaml_file.save(path, _content(camera, name), comment)


def as_written(path: Path, name: str) -> bool:
    """Whether a file is unchanged since `write` wrote it with a comment and this name."""
    try:
        text = yaml_file.text_at(path, "calibration file")
        comment = yaml_file.own_comment(text)
        return bool(comment) and text == yaml_file.text_of(_content(read(path), name), comment)
    except InstrumentError:
        return False


def _content(camera: Camera, name: str) -> dict:
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    return {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(3, 3, (fx, 0, cx, 0, fy, cy, 0, 0, 1)),
        "distortion_model": camera.model,
        "distortion_coefficients": _matrix(1, len(camera.distortion), camera.distortion),
        "rectification_matrix": _matrix(3, 3, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        "projection_matrix": _matrix(3, 4, (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)),
    }


def _matrix(rows: int, columns: int, values: Sequence[float]) -> dict:
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values]}
