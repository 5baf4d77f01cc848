# SPDX-License-Identifier: Apache-2.0
"""A recorded night through a session, as the nodes solve it when `replay` plays the bag to them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.averaging.average import Average
from starpos.errors import StarposError
from starpos.fix.solution import Solution
from starpos.instrument.instrument import Instrument
from starpos.recording import topics
from starpos.recording.bag import BagReader
from starpos.recording.drivers import IMAGES, DriverMessages, Drivers
from starpos.session.driver import Answered, Averaged, Heard, JobsInTurn, Log, Now, Output, Sent
from starpos.session.session import SolverSession
from starpos.session.settings import Settings

if TYPE_CHECKING:
    from starpos.satellites.locating import SatelliteFix


class Replay:
    """A session whose messages come from a bag, each at the time it was recorded at.

    drivers: how the messages of a robot's own camera and IMU are used; None: by default parameters.
    frames: star lists and images read so far.
    remarks: sentences on how a robot's own messages are used.
    """

    def __init__(self, settings: Settings, heard: Heard, log: Log, drivers: Drivers | None = None) -> None:
        self.frames = 0
        self.remarks: list[str] = []
        self._tilts = 0
        self._jobs: list[JobsInTurn] = []
        self._heard, self._log = heard, log
        self._drivers = Drivers.of() if drivers is None else drivers
        self.session = SolverSession(settings, self._new_jobs, heard, log)

    def _new_jobs(self) -> JobsInTurn:
        self._jobs.append(JobsInTurn(self._log.error))
        return self._jobs[-1]

    def play(self, path: Path, namespace: str | None = None) -> Iterator[Output]:
        """Yield what the solver publishes of a bag; namespace: the instrument's, None where there is only one.

        Raises BagError if the bag cannot be read, FrameError if neither an instrument nor a robot's images are in it.
        """
        now_ns, messages = 0, DriverMessages(self._drivers)
        with BagReader(path, typed=True) as bag:
            inputs = topics.INPUTS if self.session.gnss is None else topics.INPUTS | topics.GNSS
            if self.session.satellites is not None:
                inputs = inputs | topics.SATELLITES
            chosen = topics.instrument_in(bag, namespace, inputs, self._drivers.remaps)
            if chosen.made:
                self.remarks.append(chosen.made)
            for connection, log_ns, message in bag.decoded(chosen.connections):
                # Time never goes back, even if the times of a bag's messages do.
                now_ns = max(now_ns, log_ns)
                now = Now.in_data(now_ns * 1e-9)
                yield from self._taken(connection.msgtype, message, messages, now)
                yield from self._settled(now)
        yield from self._ended(Now.in_data(now_ns * 1e-9))
        self.remarks += messages.remarks()

    def _taken(self, kind: str, message: Any, messages: DriverMessages, now: Now) -> list[Output]:
        """Have the session take a message, or the stars or tilt made from it."""
        session = self.session
        if kind == topics.TILT:
            return self._receive_tilt(message, now)
        if kind == topics.STARS:
            self.frames += 1
            return session.receive_stars(message, now)
        if kind in IMAGES:
            self.frames += 1
            try:
                stars, header = messages.stars_of(kind, message)
            except StarposError as error:
                self._heard.refuse("image_raw", str(error))
                return []
            return session.receive_detected(stars, header, now)
        if kind == topics.IMU:
            tilt = messages.tilt_of(message, now.unix_s or 0.0)
            return [] if tilt is None else self._receive_tilt(tilt, now)
        if kind == topics.TRAILS:
            return session.receive_trails(message, now)
        if kind == topics.NAV_SAT_FIX:
            return session.receive_gnss(message, now)
        if kind == topics.CAPTURE:
            messages.receive_capture(message)
            return []
        return session.receive_camera(message, now)

    def _receive_tilt(self, message: Any, now: Now) -> list[Output]:
        self._tilts += 1
        return self.session.receive_tilt(message, Sent(self._tilts), now)

    def _ended(self, now: Now) -> Iterator[Output]:
        yield from self.session.end(now)
        while self.session.busy:
            yield from self._settled(now)
            yield from self.session.end(now)

    def _settled(self, now: Now) -> Iterator[Output]:
        while self.session.busy:
            for jobs in self._jobs:
                jobs.work()
            yield from self.session.at(now)


@dataclass(kw_only=True)
class PlayedNight:
    """The result of a bag.

    Attributes
    ----------
    frames : number of frames read
    solutions : of these frames
    average : of their places; None without one
    by_satellites : the last place by satellites; None without one
    said : sentences
    trouble : why it broke off; '' if it did not

    Examples
    --------
    >>> played = starpos.replay("bag")
    >>> len(played.solutions), played.trouble
    (10, '')
    """

    instrument: Instrument
    frames: int = 0
    solutions: list[Solution] = field(default_factory=list)
    average: Average | None = None
    by_satellites: "SatelliteFix | None" = None
    said: list[str] = field(default_factory=list)
    trouble: str = ""

    @property
    def summary(self) -> str:
        """Numbers of frames, answers and fixes."""
        fixes = sum(s.fix is not None for s in self.solutions)
        return f"{self.frames} frames, {len(self.solutions)} answers, {fixes} fixes"


class _Said:
    """Keeps each sentence of a session once."""

    def __init__(self, night: PlayedNight) -> None:
        self._said = night.said

    def came(self, name: str) -> None:
        """A good message is not mentioned."""

    def refuse(self, name: str, sentence: str) -> None:
        self.error(sentence)

    def info(self, message: str) -> None:
        """Each fix has its own line."""

    def warning(self, message: str) -> None:
        """The frame's own line shows it."""

    def error(self, message: str) -> None:
        if message not in self._said:
            self._said.append(message)


@dataclass(frozen=True)
class Playing:
    """The work on one bag, for any process."""

    params_file: Path | None
    given: Sequence[str]
    namespace: str | None
    remaps: topics.Remaps = field(default_factory=dict)

    def __call__(self, bag: str) -> PlayedNight:
        settings = Settings.of(self.params_file, self.given, self.namespace)
        night = PlayedNight(instrument=settings.instrument(None))
        said = _Said(night)
        replay = Replay(
            settings,
            said,
            said,
            Drivers.of(self.params_file, self.given, self.namespace, self.remaps),
        )
        try:
            for output in replay.play(Path(bag), self.namespace):
                if isinstance(output, Answered):
                    # without what only its solver needs
                    night.solutions.append(replace(output.solution, hint=None))
                elif isinstance(output, Averaged):
                    night.average = output.place
                else:
                    night.by_satellites = output.fix or night.by_satellites
        except StarposError as error:
            night.trouble = str(error)
        night.frames = replay.frames
        night.said[:0] = replay.remarks
        return night


def replay(
    bag: str | Path,
    parameters: Sequence[str] = (),
    params_file: str | Path | None = None,
    namespace: str | None = None,
) -> PlayedNight:
    """The fixes of a recorded night, by the code of the node `solver`.

    Parameters
    ----------
    bag : path of a rosbag2 with stars, tilts and camera_info, or with a robot's images and IMU
    parameters : of the solver, as 'NAME:=VALUE'; with 'detector:' or 'inclinometer:' in front, of these
    params_file : YAML of parameters, as the nodes take it
    namespace : of the instrument, in a bag that holds several

    Returns
    -------
    PlayedNight
        `solutions` of the frames, `average` of their places (None without one), `said`: sentences; `trouble`: why it
        broke off, '' if it did not

    Raises
    ------
    StarposError
        a parameter is not allowed

    Examples
    --------
    >>> played = starpos.replay("bag", ["misalignment:=[0.31, -0.22, 0.53]", "misalignment_stddev:=5"])
    >>> played.summary
    '10 frames, 10 answers, 10 fixes'
    """
    return Playing(None if params_file is None else Path(params_file), tuple(parameters), namespace)(str(bag))
