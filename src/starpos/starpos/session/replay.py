# SPDX-License-Identifier: Apache-2.0
"""A recorded night through a session, as the nodes solve it when `replay` plays the bag to them."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.averaging.average import Average
from starpos.earth.refraction import Atmosphere
from starpos.errors import StarposError
from starpos.fix.checks import BY_PARAMETERS, MODEL_BY_PARAMETERS, unknown_a3, unnamed_inclinometer
from starpos.fix.solution import Solution
from starpos.frames.frame import Stars
from starpos.frames.reading import read_frame
from starpos.frames.tables import TILTS
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.messages.stamp import PlainHeader, PlainStamp
from starpos.messages.tilt import Reading
from starpos.night.field import INSTRUMENT, is_field, opened
from starpos.night.opening import frames_in
from starpos.night.reading import stars_of
from starpos.night.remarks import of_extrapolation
from starpos.night.together import FrameAnswer, Gathered, Together
from starpos.recording import topics
from starpos.recording.bag import BagReader
from starpos.recording.drivers import DriverMessages, Drivers
from starpos.session.driver import Answered, Driver, JobsInTurn, Now, Output
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

    def __init__(self, settings: Settings, driver: Driver, drivers: Drivers | None = None) -> None:
        self.frames = 0
        self.remarks: list[str] = []
        self._jobs: list[JobsInTurn] = []
        self._driver = driver
        self._drivers = Drivers.of() if drivers is None else drivers
        self._messages = DriverMessages(self._drivers)
        self.session = SolverSession(settings, self._new_jobs, driver)

    def _new_jobs(self) -> JobsInTurn:
        self._jobs.append(JobsInTurn(self._driver.error))
        return self._jobs[-1]

    def play(self, path: Path, namespace: str | None = None) -> Iterator[Output]:
        """Yield what the solver publishes of a bag; namespace: the instrument's, None where there is only one.

        Raises BagError if the bag cannot be read, FrameError if neither an instrument nor a robot's images are in it.
        """
        with BagReader(path, typed=True) as bag:
            chosen = topics.instrument_in(bag, namespace, self.session.inputs, self._drivers.remaps)
            if chosen.made:
                self.remarks.append(chosen.made)
            decoded = bag.decoded(chosen.connections)
            yield from self._played((log_ns * 1e-9, c.msgtype, message) for c, log_ns, message in decoded)
        self.remarks += self._messages.remarks()

    def play_field(self, folder: Path) -> Iterator[Output]:
        """Yield what the solver publishes of an unpacked field report, each list and tilt at its own time."""
        instrument = instrument_file.read(folder / INSTRUMENT)
        stars = [stars_of(read_frame(path)) for path in frames_in(folder)]
        tilts = read_tilt_csv(folder / TILTS, instrument.inclinometer.noise_rad)
        self.session.instrument.use_known(instrument.camera_for(stars[0].width, stars[0].height))
        came: list[tuple[float, str, Any]] = [
            (unix_s, topics.TILT, _tilt_message(tilts, k))
            for k, unix_s in enumerate(tilts.utc_unix_s.tolist())
        ]
        came += [((s.mid_unix_s or 0.0) + (s.exposure_s or 0.0) / 2, topics.STARS, s) for s in stars]
        yield from self._played(sorted(came, key=lambda message: message[0]))

    def _played(self, messages: Iterable[tuple[float, str, Any]]) -> Iterator[Output]:
        """Take messages, each with its time and its type, one after another, and end."""
        now = Now.in_data(0.0)
        for unix_s, kind, message in messages:
            # Time never goes back, even if the times of a bag's messages do.
            now = Now.in_data(max(now.waiting_s, unix_s))
            yield from self._taken(kind, message, now)
            yield from self._settled(now)
        yield from self.session.end(now)
        while self.session.busy:
            yield from self._settled(now)
            yield from self.session.end(now)

    def _taken(self, kind: str, message: Any, now: Now) -> list[Output]:
        """Have the session take a message, or the stars or tilt made from it."""
        session = self.session
        self.frames += kind in topics.FRAMES
        if isinstance(message, Stars):
            stamp = PlainStamp.of_ns(round((message.mid_unix_s or 0.0) * 1e9))
            return session.receive_detected(message, PlainHeader(stamp, "camera"), now)
        if kind in topics.IMAGES:
            try:
                stars, header = self._messages.stars_of(kind, message)
            except StarposError as error:
                self._driver.refuse("image_raw", str(error))
                return []
            return session.receive_detected(stars, header, now)
        if kind == topics.CAPTURE:
            self._messages.receive_capture(message)
            return []
        if kind == topics.IMU:
            kind, message = topics.TILT, self._messages.tilt_of(message, now.waiting_s)
        return [] if message is None else session.receive(kind, message, now)

    def _settled(self, now: Now) -> Iterator[Output]:
        while self.session.busy:
            for jobs in self._jobs:
                jobs.work()
            yield from self.session.at(now)


def _tilt_message(log: TiltLog, k: int) -> Reading:
    z, variance_z = (math.nan if c is None else float(c[k]) for c in (log.theta_z, log.variance_z))
    return Reading(
        stamp_ns=round(float(log.utc_unix_s[k]) * 1e9),
        x=float(log.theta_x[k]),
        y=float(log.theta_y[k]),
        covariance=tuple(log.covariance[k].ravel().tolist()),
        temperature_c=float(log.temperature_c[k]),
        sequence=k,
        flags=0,
        z=z,
        z_variance=variance_z,
        frame_id="inclinometer",
    )


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
    >>> played = starpos.replay("night.zip")
    >>> played.average.frames, played.trouble
    (5, '')
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

    @property
    def together(self) -> Together:
        """The average, and what looks wrong with it, as parameters cure it."""
        gathered, whole, said = Gathered(), self.average, list[str]()
        for solution in self.solutions:
            gathered.gather(FrameAnswer("", solution))
        if gathered.solved:
            said.append(of_extrapolation(gathered.solved))
            said.append(unnamed_inclinometer(self.instrument, MODEL_BY_PARAMETERS))
        if whole:
            a3 = self.instrument.calibration
            said.append(unknown_a3(a3, whole.covariance, whole.terms, BY_PARAMETERS))
        return Together(average=whole, remarks=tuple(filter(None, said)), gathered=gathered)


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
        if is_field(bag):
            with opened(bag) as (folder, air):
                told = self.given or self.params_file is not None
                given = self.given if told else _parameters_in(folder, air)
                return self._played(lambda replay: replay.play_field(folder), given)
        return self._played(lambda replay: replay.play(Path(bag), self.namespace), self.given)

    def _played(self, play: Callable[[Replay], Iterator[Output]], given: Sequence[str]) -> PlayedNight:
        settings = Settings.of(self.params_file, given, self.namespace)
        night = PlayedNight(instrument=settings.instrument(None))
        said = _Said(night)
        replay = Replay(settings, said, Drivers.of(self.params_file, self.given, self.namespace, self.remaps))
        try:
            for output in play(replay):
                if isinstance(output, Answered):
                    # without what only its solver needs
                    night.solutions.append(replace(output.solution, hint=None))
                    night.average = output.average or night.average
                else:
                    night.by_satellites = output.fix or night.by_satellites
        except StarposError as error:
            night.trouble = str(error)
        night.frames = replay.frames
        night.said[:0] = replay.remarks
        return night


def _parameters_in(folder: Path, air: Atmosphere) -> list[str]:
    """The solver's parameters, NAME:=VALUE, of an unpacked field report."""
    measured = {"pressure": air.pressure_pa, "temperature": air.temperature_c, "humidity": air.humidity}
    refraction = [f"refraction.{name}:={float(value)}" for name, value in measured.items()]
    return [f"calibration_url:={folder / INSTRUMENT}", *refraction]


def replay(
    bag: str | Path,
    parameters: Sequence[str] = (),
    params_file: str | Path | None = None,
    namespace: str | None = None,
) -> PlayedNight:
    """The fixes of a recorded night, by the code of the node `solver`.

    Parameters
    ----------
    bag : path of a rosbag2 with stars, tilts and camera_info, or with a robot's images and IMU; or of a field report
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
    >>> played = starpos.replay("night.zip")
    >>> played.summary
    '5 frames, 5 answers, 5 fixes'
    """
    return Playing(None if params_file is None else Path(params_file), tuple(parameters), namespace)(str(bag))
