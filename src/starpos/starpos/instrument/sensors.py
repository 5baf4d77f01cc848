# SPDX-License-Identifier: Apache-2.0
"""Errors of inclinometers by name, from their data sheets; docs/sensors.md says where each figure stands.

What a sheet states becomes 1 sigma by one rule. A standard deviation, an rms and a typical value count as they are.
Murata's minimum and maximum are 3 sigma, as its sheets say. Another limit (a maximum, "<", the largest deviation from a
straight line) is a uniform distribution (GUM, 4.3.7). A noise density per sqrt(Hz) becomes the noise behind a filter of
first order.  The figures are in data/sensors.csv.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import groupby
from math import pi, radians, sqrt
from types import MappingProxyType

from starpos.errors import InstrumentError
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.tables import packaged
from starpos.units import ARCSEC

# Rad; an acceleration of 1 mg looks like a tilt of 1e-3.
UNITS = {"": 1.0, "deg": radians(1), "arcsec": ARCSEC, "mrad": 1e-3, "mg": 1e-3}
# Noise bandwidth of a filter of first order, in units of its -3 dB bandwidth: pi / 2.
FIRST_ORDER = 1.57


def _sigma(row: Mapping[str, str]) -> float:
    """1 sigma of a row of the table, in rad or as a share."""
    stated = float(row["value"]) * UNITS[row["unit"]] / float(row["over"] or 1)
    if row["rule"] == "density":
        return stated * sqrt(FIRST_ORDER * float(row["hz"]))
    return stated / {"": 1, "limit": sqrt(3), "three": 3}[row["rule"]]


SCA100T_CALIBRATED = InclinometerErrors()


# Row of a level inside a camera: 1 sigma of its zero and of its axes against the camera's, together, about each axis.
BUILT_IN = "built_in_rad"


@lru_cache(maxsize=1)
def _rows() -> Mapping[str, Mapping[str, float]]:
    """The figures of each model, by their fields."""
    models = groupby(packaged("starpos.instrument", "sensors.csv"), lambda r: r["model"])
    return MappingProxyType({model: {r["field"]: _sigma(r) for r in of_model} for model, of_model in models})


@lru_cache(maxsize=1)
def presets() -> Mapping[str, InclinometerErrors]:
    """The errors of each inclinometer with a name."""
    return MappingProxyType(
        {
            model: InclinometerErrors(**{name: sigma for name, sigma in of_model.items() if name != BUILT_IN})
            for model, of_model in _rows().items()
        }
    )


def built_in_rad(model: str) -> float:
    """1 sigma about each axis of a camera's own level against it, its zero included; 0 for another level."""
    return _rows().get(model, {}).get(BUILT_IN, 0.0)


@lru_cache(maxsize=1)
def unnamed() -> InclinometerErrors:
    """The errors if neither inclinometer nor errors are stated: of an SCA100T as sold, at any lean."""
    return replace(presets()["sca100t"], range_rad=pi / 2)


def find(model: str) -> tuple[str, InclinometerErrors]:
    """Name among `presets` and errors of a model in any case; '' gives '' and `unnamed`.

    Raises InstrumentError with the names for an unknown one.
    """
    name = model.strip().lower()
    if not name:
        return "", unnamed()
    if name not in presets():
        raise InstrumentError(
            f"the inclinometer's model {model[:40]!r} is not known: the models are {', '.join(presets())}; "
            "for another sensor state its errors (tilt_noise_deg and the others) in the instrument file"
        )
    return name, presets()[name]
