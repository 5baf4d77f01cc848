# SPDX-License-Identifier: Apache-2.0
"""A night compared with GNSS: what its places teach, and how each frame agrees with them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from starpos.earth.vertical import Vertical
from starpos.errors import GnssError
from starpos.fix.searching import Sight
from starpos.fix.solver import Solver, placed
from starpos.gnss.receiver import GnssTrack
from starpos.gnss.solving import Watched, watched
from starpos.gnss.states import Learned
from starpos.gnss.watch import GnssWatch
from starpos.instrument.tilt_log import Tilts


@dataclass(frozen=True)
class WatchedNight:
    """The answer to each frame in the given order; what GNSS taught by the end; remarks."""

    answers: tuple[Watched, ...]
    learned: Learned | None
    remarks: tuple[str, ...]


def watched_night(
    solver: Solver,
    sights: Sequence[Sight],
    tilts: Tilts | None,
    track: GnssTrack,
    before: Learned | None,
    vertical: Vertical,
) -> WatchedNight:
    """Solve a night's frames, which are identified already, in the order of their times.

    tilts: None where headings alone are wanted.  before: what earlier nights learned of the instrument.
    """
    watch = GnssWatch(solver.instrument, vertical, before)
    said: Counter[str] = Counter()
    answers: dict[int, Watched] = {}
    for k in sorted(range(len(sights)), key=lambda k: sights[k].stars.mid_unix_s or 0.0):
        stars, rough, gnss = sights[k].stars, sights[k].solution, None
        if stars.mid_unix_s is not None:
            try:
                gnss = track.at(stars.mid_unix_s)
            except GnssError as error:
                said[str(error)] += 1
        if rough.found is not None and tilts is not None:
            solved = solver.solve(stars, tilts, known=rough.found)
            refused = replace(rough, status=solved.status, message=solved.message)
            rough = refused if solved.found is None else solved
        if gnss is not None:
            rough = placed(solver, stars, rough, gnss.deflected(vertical))
        answers[k] = watched(solver, stars, rough, gnss, watch)
    remarks = tuple(f"{number} frames: {why}" for why, number in said.items())
    return WatchedNight(tuple(answers[k] for k in range(len(sights))), watch.learned, remarks)
