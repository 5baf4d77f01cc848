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

import re
from importlib import import_module
from typing import Any

__version__ = "0.4.0"

# __init__.pyi says to editors and type checkers where the public names are, and here
with open(f"{__file__.rpartition('.')[0]}.pyi", encoding="utf-8") as _stub:
    _stated = _stub.read()
# name: module, and after a colon its name there
_HOMES = {name: home for home, name in re.findall(r"^from starpos\.(\S+) import (\w+) as ", _stated, re.M)}
_HOMES |= {
    name: f"{home}:{there}"
    for name, home, there in re.findall(r"^(\w+) = starpos\.(\S+)\.(\w+)$", _stated, re.M)
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
