# SPDX-License-Identifier: Apache-2.0
"""A recorded night through a session, as the node `solver` works it when `replay` plays the bag to it."""

from collections.abc import Iterator
from pathlib import Path

from starpos.recording.bag import BagReader
from starpos.recording.instruments import GNSS, INPUTS, NAV_SAT_FIX, STARS, TILT, instrument_in
from starpos.session.frames import Output
from starpos.session.job import JobsInTurn
from starpos.session.log import Heard, Log
from starpos.session.now import Now, Sent
from starpos.session.session import SolverSession
from starpos.session.settings import Settings


class Replay:
    """A session whose messages come from a bag, each at the time it was recorded at; frames: star lists read so far."""

    def __init__(self, settings: Settings, heard: Heard, log: Log) -> None:
        self.frames = 0
        self._jobs: list[JobsInTurn] = []
        self._log = log
        self.session = SolverSession(settings, self._new_jobs, heard, log)

    def _new_jobs(self) -> JobsInTurn:
        self._jobs.append(JobsInTurn(self._log.error))
        return self._jobs[-1]

    def play(self, path: Path, namespace: str | None = None) -> Iterator[Output]:
        """Yield what the solver publishes of a bag; namespace: the instrument's, None where there is only one.

        Raises BagError if the bag cannot be read, FrameError if the instrument is not in it.
        """
        session, tilts, now_ns = self.session, 0, 0
        with BagReader(path, typed=True) as bag:
            topics = INPUTS if session.gnss is None else INPUTS | GNSS
            _, connections = instrument_in(bag, path, namespace, topics, (STARS,))
            for connection, log_ns, message in bag.decoded(connections):
                # Time never goes back, even if the times of a bag's messages do.
                now_ns = max(now_ns, log_ns)
                now = Now.in_data(now_ns * 1e-9)
                if connection.msgtype == TILT:
                    tilts += 1
                    yield from session.take_tilt(message, Sent(tilts), now)
                elif connection.msgtype == STARS:
                    self.frames += 1
                    yield from session.take_stars(message, now)
                elif connection.msgtype == NAV_SAT_FIX:
                    yield from session.take_gnss(message, now)
                else:
                    yield from session.take_camera(message, now)
                yield from self._settled(now)
        now = Now.in_data(now_ns * 1e-9)
        yield from session.end(now)
        while session.busy:
            yield from self._settled(now)
            yield from session.end(now)

    def _settled(self, now: Now) -> Iterator[Output]:
        while self.session.busy:
            for jobs in self._jobs:
                jobs.work()
            yield from self.session.at(now)
