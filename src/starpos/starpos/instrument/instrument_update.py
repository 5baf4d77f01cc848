# SPDX-License-Identifier: Apache-2.0
"""Existing instrument files: a calibration puts A3 into them and keeps what people have written."""

from dataclasses import replace
from pathlib import Path

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file, yaml_file
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Instrument

# keys that a calibration finds, of A3 or of a fixed camera's vertical; a file may have some of them
FOUND = (
    "misalignment_deg",
    "calibration_stddev_arcsec",
    "calibration_covariance_arcsec2",
    "calibrated",
    "vertical",
)


def check_replaceable(path: Path) -> None:
    """Raise InstrumentError unless the file there is an instrument file, without a comment that a person wrote.

    The sentence does not say what to do.
    """
    try:
        instrument_file.read(path, needs_camera=False)
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
    kept = instrument_file.read(path, needs_camera=False)
    if (kept.vertical is not None) != fixed:
        other = "an instrument with an inclinometer" if fixed else "a camera that is fixed to the ground"
        raise InstrumentError(
            f"{path}: it is there already, and of {other}: move it away, or write another file"
        )
    if not camera_found and _lens(kept) != _lens(instrument):
        what = "camera"
    elif not camera_found and None not in (kept.size, instrument.size) and kept.size != instrument.size:
        what = "frame size"
    elif not fixed and _says_sensor(instrument) and _sensor(kept) != _sensor(instrument):
        what = "inclinometer"
    else:
        return
    raise InstrumentError(
        f"{path}: it is there already, with another {what} than this calibration's: give --instrument {path}, or write "
        "another file"
    )


def _lens(instrument: Instrument) -> tuple:
    return instrument.focal_px, instrument.camera, instrument.model if instrument.camera is None else None


def _sensor(instrument: Instrument) -> InclinometerErrors:
    # a calibration finds the errors of its poses and its noise
    return replace(instrument.inclinometer, pose_rad=0.0, noise_rad=0.0)


def _says_sensor(instrument: Instrument) -> bool:
    """Whether an instrument's inclinometer errors differ from the defaults."""
    return bool(instrument.inclinometer_model) or _sensor(instrument) != _sensor(Instrument(1.0))


def write(path: Path, instrument: Instrument, comment: str, *, camera_found: bool = False) -> None:
    """Write an instrument file; an existing one keeps all keys except A3's, and the camera's if it was found.

    InstrumentError if it cannot be written.
    """
    new = instrument_file.content_of(instrument)
    if path.exists():
        stated = instrument_file.read(path, needs_camera=False).inclinometer
        says = _says_sensor(instrument)
        pose = says and stated.pose_rad < instrument.inclinometer.pose_rad
        noise = says and stated.noise_rad < instrument.inclinometer.noise_rad
        found = {*FOUND, *["camera"] * camera_found}
        found |= {*["tilt_pose_arcsec"] * bool(pose), *["tilt_noise_deg"] * bool(noise)}
        kept = yaml_file.load(path, "instrument file")
        changed = {k: v for k, v in kept.items() if k not in found} | {k: new[k] for k in found if k in new}
        if not camera_found and instrument.frame_size is not None:
            # to which the new A3 belongs
            sides = dict(zip(instrument_file.SIDES, instrument.frame_size, strict=True))
            changed["camera"] = kept["camera"] | sides
        order = ["starpos_instrument", *instrument_file.KEYS]
        new = {k: changed[k] for k in sorted(changed, key=order.index)}
    yaml_file.save(path, new, comment)
