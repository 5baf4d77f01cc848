# SPDX-License-Identifier: Apache-2.0
"""Position and heading from the stars: the instrument's mathematics, without ROS.

Data flows one way: frame -> detection -> star vectors -> identification -> apparent places -> local frame -> fix.

    from starpos import Calibration, Instrument, Solver, detect, load_catalogue, read_frame, read_tilt_csv

    known = Calibration.of((0.91, -0.48, 20.0), (5.0, 5.0, 5.0))  # A3 in deg, its errors in arcsec
    solver = Solver(Instrument(focal_px=600e3 / 6.4, calibration=known), load_catalogue())
    solution = solver.solve(detect(read_frame("frame.fits")).stars, read_tilt_csv("tilt.csv").average)

The names below are the public ones. Each is imported when it is first asked for, so that `import starpos` takes no time.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# __init__.pyi says the same to editors and type checkers
_HOMES = {
    "Atmosphere": "earth.refraction",
    "Average": "averaging.average",
    "Calibration": "instrument.instrument",
    "Camera": "instrument.camera",
    "Catalogue": "sky.catalogue",
    "Deflection": "earth.vertical",
    "Detection": "detection",
    "Fix": "fix.fix",
    "Frame": "frames.frame",
    "Instrument": "instrument.instrument",
    "Site": "sky.site",
    "Solution": "fix.solver",
    "Solver": "fix.solver",
    "StarposError": "errors",
    "Stars": "frames.stars",
    "Status": "fix.solver",
    "Tilt": "instrument.inclinometer",
    "TiltLog": "instrument.tilt_log",
    "average": "averaging.average",
    "calibrate_at": "calibration.misalignment",
    "detect": "detection",
    "geodetic": "earth.vertical",
    "load_catalogue": "sky.catalogue",
    "read_frame": "frames.reading",
    "read_tilt_csv": "instrument.tilt_table",
    "turn": "calibration.turning",
}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, and what every module has."""
    return sorted({*globals(), *__all__})
