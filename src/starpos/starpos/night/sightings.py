# SPDX-License-Identifier: Apache-2.0
"""The frames of a zenith camera's session: the sighting of each, and what they come to together."""

from collections.abc import Sequence
from dataclasses import dataclass

from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, StarposError
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, check_explained
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilts import Tilts
from starpos.night.reading import Instruments
from starpos.night.work import Identifying
from starpos.sky import catalogue
from starpos.zenith.adjustment import Adjusted, adjusted
from starpos.zenith.doubts import check_session
from starpos.zenith.sighting import Mark, ZenithSighting, sighting


@dataclass(frozen=True)
class ZenithSighted:
    """Makes the ZenithSighting of a frame at a mark; a frame's fault is a Solution that gives the reason."""

    instruments: Instruments
    atmosphere: Atmosphere
    tilts: Tilts
    mark: Mark

    def __call__(self, item: Frame | Stars) -> ZenithSighting | Solution:
        """The sighting of a frame, identified by every way there is."""
        sight, _ = Identifying(self.instruments)(item)
        instrument = sight.instrument or self.instruments.of(item)
        if sight.found is None or instrument is None:
            return sight.solution
        solver = Solver(instrument, catalogue.load_catalogue(), self.atmosphere)
        try:
            check_explained(sight.solution)
            return sighting(solver, sight.stars, sight.found, self.mark, self.tilts)
        except StarposError as error:
            return Solution.refused(sight.stars, error)


@dataclass(frozen=True, eq=False)
class DeflectionSession:
    """A session: its sightings in order of time, and the deflection that they give."""

    sightings: tuple[ZenithSighting, ...]
    adjusted: Adjusted

    @classmethod
    def of(
        cls, sightings: Sequence[ZenithSighting], instrument: Instrument, atmosphere: Atmosphere, mark: Mark
    ) -> "DeflectionSession":
        """Adjust the sightings; FixError, with a sentence, where they do not bear a deflection."""
        if not sightings:
            raise FixError("no frame with stars and a tilt: there is no deflection")
        in_time = tuple(sorted(sightings, key=lambda s: s.utc_unix_s))
        found = adjusted(in_time, instrument, atmosphere, mark)
        check_session(found, in_time)
        return cls(in_time, found)

    @property
    def mid_unix_s(self) -> float:
        """Mean time of its frames, UTC."""
        return sum(s.utc_unix_s for s in self.sightings) / len(self.sightings)
