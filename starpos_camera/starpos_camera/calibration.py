# SPDX-License-Identifier: Apache-2.0
"""Camera calibration files: the YAML that camera_calibration and camera_info_manager write and read."""

import os
import tempfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

import yaml

from starpos.camera import Camera
from starpos.errors import InstrumentError

SIZE_LIMIT = 1 << 20


def path_of(url: str) -> Path:
    """The file a `calibration_url` names: file:///a/b.yaml or a path; InstrumentError for anything else."""
    parts = urlsplit(url)
    if not parts.scheme:
        return Path(url).expanduser()
    if parts.scheme != "file" or parts.netloc not in ("", "localhost") or not parts.path:
        raise InstrumentError(f"calibration_url {url!r}: give file:///path/to/camera.yaml, or a path.")
    return Path(unquote(parts.path))


def read(path: Path) -> Camera:
    """The camera of a calibration file; InstrumentError with the reason where it is none."""
    try:
        if path.stat().st_size > SIZE_LIMIT:
            raise InstrumentError(f"{path}: it is over 1 MiB, no calibration file; give another.")
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise InstrumentError(f"{path}: this calibration file cannot be read ({reason}).") from None
    try:
        model = content.get("distortion_model", "plumb_bob")
        width, height = content["image_width"], content["image_height"]
        k = _numbers(content["camera_matrix"], 9)
        d = (
            _numbers(content["distortion_coefficients"], 5)
            if "distortion_coefficients" in content
            else (0.0,) * 5
        )
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise InstrumentError(
            f"{path}: a key of this calibration file is missing or of the wrong kind ({error!r}); "
            "it needs image_width, image_height, camera_matrix, distortion_coefficients."
        ) from None
    if model != "plumb_bob":
        raise InstrumentError(
            f"{path}: the distortion model is {model!r}; only 'plumb_bob' is understood: calibrate with it."
        )
    if type(width) is not int or type(height) is not int:
        raise InstrumentError(f"{path}: image_width and image_height must be whole numbers of px.")
    if any(k[i] for i in (1, 3, 6, 7)) or k[8] != 1:
        raise InstrumentError(
            f"{path}: camera_matrix is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate without skew."
        )
    try:
        return Camera(width, height, k[0], k[4], k[2], k[5], d)
    except InstrumentError as error:
        raise InstrumentError(f"{path}: {error}") from None


def _numbers(matrix: dict, count: int) -> tuple[float, ...]:
    values = tuple(float(value) for value in matrix["data"])
    if len(values) != count:
        raise ValueError(f"{len(values)} values for {count}")
    return values


def write(path: Path, camera: Camera, name: str):
    """Write a calibration file so that at any moment there is the old or the new one, whole, even after a
    power cut. InstrumentError where it cannot be written.
    """
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(3, 3, (fx, 0, cx, 0, fy, cy, 0, 0, 1)),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": _matrix(1, 5, camera.distortion),
        "rectification_matrix": _matrix(3, 3, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        "projection_matrix": _matrix(3, 4, (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)),
    }
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with open(descriptor, "w", encoding="utf-8") as file:
            yaml.safe_dump(content, file, sort_keys=False, default_flow_style=None)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)  # mkstemp's is for its owner alone
        os.replace(temporary, path)
        temporary = None
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise InstrumentError(
            f"{path}: the calibration cannot be written there ({error.strerror}); it holds for this session only."
        ) from None
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def _matrix(rows: int, columns: int, values) -> dict:
    return {"rows": rows, "cols": columns, "data": [float(value) for value in values]}
