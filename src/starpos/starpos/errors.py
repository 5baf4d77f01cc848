# SPDX-License-Identifier: Apache-2.0
"""All errors starpos raises. Every message is one sentence: what happened, where, and what to do about it."""

# Maximum length of a library's message quoted in a sentence.
LETTERS = 120


class StarposError(Exception):
    """The base of all errors that starpos raises on purpose.

    Examples
    --------
    >>> try:
    ...     starpos.open_night("nowhere")
    ... except starpos.StarposError as error:
    ...     print(error)
    nowhere: there is no such folder: ...
    """


class FrameError(StarposError):
    """A frame, or a list of stars, cannot be read or is inconsistent."""


class TiltError(StarposError):
    """The inclinometer's readings are missing, broken or out of range."""


class TiltRangeError(TiltError):
    """The instrument leans further than the inclinometer can measure."""


class CatalogueError(StarposError):
    """The star catalogue is missing or broken."""


class TimeError(StarposError):
    """A time is missing or outside the Earth-rotation tables."""


class InstrumentError(StarposError):
    """The instrument's description (camera, misalignment, mount) is missing or inconsistent."""


class FieldError(InstrumentError):
    """The focal length makes a field of another size than this program works with."""


class GeoidError(StarposError):
    """A grid of geoid undulations is missing or broken."""


class GnssError(StarposError):
    """A GNSS receiver's data cannot be used, or its table is missing or broken."""


class PlaceError(StarposError):
    """A known place is impossible, or the stars contradict it."""


class WriteError(StarposError):
    """A report or a picture cannot be written."""


class BagError(StarposError):
    """A recording (rosbag2) cannot be read, or unpacks to more than it may."""


class CalibrationError(StarposError):
    """The stars do not support a calibration."""


class FixError(StarposError):
    """The stars do not support a fix."""


class SatelliteError(StarposError):
    """Orbits or sightings of satellites cannot be used, or do not give a place."""


class StationError(StarposError):
    """The result of a zenith camera's session is missing or broken, or contradicts another one."""


class VoyageError(StarposError):
    """The record of a voyage (inertial readings, velocities) is missing or broken, or contradicts its stars."""


def named(name: str, said: object) -> str:
    """An error or a sentence on a frame, with its name before it unless it is in it."""
    return str(said) if name in str(said) else f"{name}: {said}"


def one_line(error: object) -> str:
    """The message of an error, or any text, on one line and short enough to be quoted in a sentence."""
    said = " ".join(str(error).split())
    if len(said) > LETTERS:
        said = said[:LETTERS].rsplit(" ", 1)[0] + " ..."
    return said or type(error).__name__
