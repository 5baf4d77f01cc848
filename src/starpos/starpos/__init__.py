# SPDX-License-Identifier: Apache-2.0
"""Position and heading from the stars: the instrument's mathematics, without ROS.

Data flows one way: frame -> detection -> star vectors -> identification -> apparent places -> local frame -> fix.

A night that `starpos simulate night` has written:

    >>> import starpos
    >>> known = starpos.Calibration.of((0, 0, 0), (5, 5, 5))  # A3 in deg, its errors in arcsec
    >>> night = starpos.open_night("night", calibration=known, inclinometer="sca100t_calibrated")
    >>> night
    <night: 5 frames and tilt.csv, to be solved>
    >>> answer = night.solve()
    >>> answer
    <night: 5 of 5 frames fixed; +35.70... +51.41... +- 2... m N 2... m E, heading 235... +- 0.00... deg (WGS 84)>
    >>> answer.wgs84.sigma_north_m < 400  # 1 sigma in m; latitude, longitude and heading are in deg
    True
    >>> [shot.status.value for shot in answer.shots]
    ['ok', 'ok', 'ok', 'ok', 'ok']

Inside, angles are in rad, times Unix seconds in UTC.

The names below are the public ones. Each is imported when it is first asked for, so that `import starpos` takes no time.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# name: module, and after a colon its name there; __init__.pyi says the same to editors and type checkers
_HOMES = {
    "Atmosphere": "earth.refraction",
    "Average": "averaging.average",
    "Calibration": "instrument.instrument",
    "Camera": "instrument.camera",
    "Catalogue": "sky.catalogue",
    "Deflection": "earth.vertical",
    "DeflectionSession": "zenith.doubts",
    "Detection": "detection",
    "Fix": "fix.fix",
    "Frame": "frames.frame",
    "GnssTrack": "gnss.receiver",
    "InDegrees": "fix.fix",
    "Instrument": "instrument.instrument",
    "Night": "night.night",
    "NightOnDisk": "night.opening",
    "Place": "earth.place",
    "PlaceFix": "fix.fix",
    "PlayedNight": "session.replay",
    "Shot": "night.night",
    "Site": "sky.site",
    "Solution": "fix.solution",
    "Solver": "fix.solver",
    "StarposError": "errors",
    "Stars": "frames.frame",
    "Status": "fix.solution",
    "Tilt": "instrument.inclinometer",
    "TiltLog": "instrument.tilt_log",
    "Voyage": "navigation.voyage",
    "VoyageFix": "navigation.estimate",
    "average": "averaging.average",
    "calibrate_at": "calibration.misalignment",
    "calibrate_camera": "calibration.camera",
    "deflection": "night.work",
    "detect": "detection",
    "geodetic": "earth.vertical",
    "identify": "night.work",
    "load_catalogue": "sky.catalogue",
    "navigate": "night.under_way",
    "open_night": "night.opening",
    "read_frame": "frames.reading",
    "read_gnss_csv": "gnss.receiver",
    "read_instrument": "instrument.instrument_file:read",
    "read_tilt_csv": "instrument.tilt_table",
    "replay": "session.replay",
    "scene_of": "simulation.scene",
    "turn": "calibration.misalignment",
    "write_instrument": "instrument.instrument_file:write",
    "write_night": "simulation.scene",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home, _, there = _HOMES[name].partition(":")
    value = getattr(import_module(f"{__name__}.{home}"), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, and what every module has."""
    return sorted({*globals(), *__all__})
