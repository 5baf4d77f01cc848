# SPDX-License-Identifier: Apache-2.0
"""A night with GNSS: its frames one after another, each with what GNSS has taught before it."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from starpos.earth.vertical import Vertical
from starpos.errors import GnssError
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.gnss.place import GnssPlace, known_place
from starpos.gnss.solving import Watched, watched
from starpos.gnss.states import Learned
from starpos.gnss.track import GnssTrack
from starpos.gnss.watch import GnssWatch
from starpos.identification import Identification
from starpos.instrument.tilts import Tilts
from starpos.night.remarks import Kind, Remark
from starpos.night.searching import answer_frame


@dataclass(frozen=True)
class Receiver:
    """The GNSS places of a night, and what earlier nights learned of the instrument; None where nothing."""

    track: GnssTrack
    learned: Learned | None = None


@dataclass(frozen=True)
class WatchedNight:
    """The answer to each frame in the given order; what GNSS taught by the end; remarks."""

    answers: tuple[Watched, ...]
    learned: Learned | None
    remarks: tuple[Remark, ...]


def watched_night(
    solver: Solver,
    frames: Sequence[tuple[Stars, Identification | None]],
    tilts: Tilts | None,
    receiver: Receiver,
    vertical: Vertical,
) -> WatchedNight:
    """Solve a night's frames in the order of their times, each with its identification so far.

    tilts: None where headings alone are wanted.
    """
    watch = GnssWatch(solver.instrument, vertical, receiver.learned)
    said: Counter[str] = Counter()

    def place_at(stars: Stars) -> GnssPlace | None:
        if stars.mid_unix_s is None:
            return None
        try:
            return receiver.track.at(stars.mid_unix_s)
        except GnssError as error:
            said[str(error)] += 1
            return None

    answers: dict[int, Watched] = {}
    for k in sorted(range(len(frames)), key=lambda k: frames[k][0].mid_unix_s or 0.0):
        stars, found = frames[k]
        gnss = place_at(stars)
        place = None if gnss is None else known_place(gnss, vertical)
        rough = answer_frame(solver, stars, stars, tilts, place, known=found).solution
        answers[k] = watched(solver, stars, rough, gnss, watch)
    remarks = tuple(Remark(Kind.GNSS, f"{number} frames: {why}") for why, number in said.items())
    return WatchedNight(tuple(answers[k] for k in range(len(frames))), watch.learned, remarks)
