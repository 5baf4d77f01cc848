# SPDX-License-Identifier: Apache-2.0
"""Sources of the tilt of an exposure: a log of readings, readings that have just arrived, or a single tilt."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from starpos.errors import TiltError
from starpos.instrument.inclinometer import Tilt


class Tilts(Protocol):
    """The tilts of a night; a `TiltLog` is one, and so is a `Tilt`, which serves any exposure."""

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Average over an exposure, whose middle may lie spread_s off; raises TiltError."""


@dataclass(frozen=True)
class NoTilts:
    """No tilts, and the sentence that says why."""

    why: str = "no tilt: give the inclinometer's"

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Raise TiltError."""
        raise TiltError(self.why)


NO_TILTS = NoTilts()


@dataclass(frozen=True)
class TiltsByTime:
    """The tilts of exposures, each known by their middle (Unix seconds)."""

    tilts: Mapping[Any, Tilt]

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Give the tilt of the exposure with this middle."""
        return self.tilts[mid_unix_s]
