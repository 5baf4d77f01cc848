# SPDX-License-Identifier: Apache-2.0
"""Writing of the instrument file for ~/save_calibration."""

from pathlib import Path

from starpos.errors import InstrumentError
from starpos.files import path_of
from starpos.instrument import instrument_file, instrument_update
from starpos.instrument.instrument import Instrument


def save(path: str, calibration_url: str, instrument: Instrument) -> Path:
    """Write an instrument file to `path`, or without one to calibration_url; return its Path.

    Raises InstrumentError if it cannot be written, or if the file there is no instrument file or has a person's comment.
    """
    if not path and not calibration_url:
        raise InstrumentError("there is no file to write: give a path, or set calibration_url")
    if path and not path_of(path).is_absolute():
        raise InstrumentError(
            f"{path}: give a full path, from / on: the node would write it into the folder it was started in"
        )
    where = path_of(path or calibration_url)
    try:
        occupied = where.exists()
    except (OSError, ValueError) as e:
        raise InstrumentError(f"{where}: the file cannot be written there ({e})") from None
    if occupied:
        try:
            instrument_update.check_replaceable(where)
        except InstrumentError as e:
            raise InstrumentError(f"{e}: move it away, or give another path") from None
    instrument_file.write(where, instrument)
    return where
