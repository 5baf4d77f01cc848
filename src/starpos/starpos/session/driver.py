# SPDX-License-Identifier: Apache-2.0
"""What a session and its driver exchange: times, sentences, answers, diagnostics, and jobs of several seconds."""

import math
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Protocol

from starpos.errors import StarposError
from starpos.parameters.table import FRAME_NAME

# every node loads this module, and few of them what a solution consists of
if TYPE_CHECKING:
    from starpos.averaging.average import Average
    from starpos.earth.vertical import Geodetic
    from starpos.fix.attitude import CameraAttitude
    from starpos.fix.solution import Solution
    from starpos.gnss.watch import GnssCheck
    from starpos.satellites.locating import SatelliteFix
    from starpos.satellites.trails import SatelliteTrail

# Times that differ by more are not of the same evening.
ANOTHER_TIME_S = 3600.0


@dataclass(frozen=True)
class Sent:
    """What the middleware reports of a message.

    number: its place among its publisher's messages; None where that is unknown.
    unix_s: when it was written, by the clock of its publisher's host; None where that is unknown.
    """

    number: int | None = None
    unix_s: float | None = None


@dataclass(frozen=True)
class Now:
    """A moment.

    unix_s: by the clock of whoever takes the messages; None while it is not known.
    waiting_s: by the clock in which waiting is counted; NaN while it is not known.
    played: whether both are the clock of recorded data: then nothing depends on speed.
    """

    unix_s: float | None
    waiting_s: float
    played: bool = False

    @classmethod
    def in_data(cls, unix_s: float | None) -> "Now":
        """A moment by the clock of recorded data."""
        return cls(unix_s, math.nan if unix_s is None else unix_s, played=True)

    def ahead_s(self, unix_s: float | None) -> float:
        """How far a time is ahead of this one (s); 0 if one of them is not known.

        It is also 0 if the two are not of the same evening: a night is played without /clock, or the robot does not
        know the date.
        """
        if unix_s is None or self.unix_s is None:
            return 0.0
        ahead_s = unix_s - self.unix_s
        return 0.0 if ahead_s > ANOTHER_TIME_S and not self.played else ahead_s


@dataclass(frozen=True, kw_only=True)
class Answered:
    """The answer to a frame: its message's stamp, its solution, the place on the ellipsoid, None without one.

    no_camera: no camera calibration has arrived.
    attitude: the camera's, by its stars; None if they do not determine it.
    compared: the GNSS place at the frame, and what the guard says of it; None without one.
    average: of the fixes here, after this one was added to it; None where it does not include this one.
    """

    stamp: Any
    solution: "Solution"
    ground: "Geodetic | None"
    no_camera: bool
    attitude: "CameraAttitude | None" = None
    compared: "GnssCheck | None" = None
    average: "Average | None" = None


@dataclass(frozen=True, kw_only=True)
class Located:
    """The place by the satellites' trails on the last frames, or why it is missing, and a sentence on what is left out.

    stamp: of the newest frame.
    """

    stamp: Any
    trails: "tuple[SatelliteTrail, ...]"
    fix: "SatelliteFix | None" = None
    why: str = ""
    left_out: str = ""


Output = Answered | Located


class Log(Protocol):
    """Takes sentences, as rclpy's logger does."""

    def info(self, message: str) -> object: ...

    def warning(self, message: str) -> object: ...


class Changes:
    """Logs a state once until it changes."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._logged: object = None

    def say(self, sentence: str, good: bool, state: object = None) -> bool:
        """Log a sentence, unless its state (or it itself) was logged last; returns whether it was new."""
        state = state or sentence
        if state == self._logged:
            return False
        self._logged = state
        if good:
            self._log.info(sentence)
        else:
            self._log.warning(sentence)
        return True


class Driver(Log, Protocol):
    """Whoever drives a session: a log, also of defects' tracebacks, and an account of messages by their topics' names."""

    def error(self, message: str) -> object: ...

    def came(self, name: str) -> object: ...

    def refuse(self, name: str, sentence: str) -> object: ...


@contextmanager
def refusing(driver: Driver, name: str) -> Iterator[None]:
    """Refuse a message of a topic with the reason where the block raises a StarposError, else note that it came."""
    try:
        yield
    except StarposError as error:
        driver.refuse(name, str(error))
    else:
        driver.came(name)


class Level(IntEnum):
    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Diagnosis:
    """Result of a diagnostic task: a level, a sentence, and named values (numbers, strings, booleans)."""

    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """The value that a job returned, or the sentence that says why it failed."""

    value: Any = None
    trouble: str = ""


def outcome_of(job: Callable[[], Any], say: Callable[[str], object]) -> Outcome:
    """Do a job; a defect ends this job only, and `say` gets its traceback."""
    try:
        return Outcome(job())
    except StarposError as e:
        return Outcome(trouble=str(e))
    except Exception as e:
        say(traceback.format_exc())
        return Outcome(trouble=f"it failed ({type(e).__name__}: {e})")


class Jobs(ABC):
    """Runs one job at a time; a subclass says where."""

    def __init__(self) -> None:
        self.busy = False
        self._then: Callable[[Outcome], object] | None = None

    def run(self, job: Callable[[], Any], then: Callable[[Outcome], object]) -> None:
        """Begin a job; `then` gets its Outcome, never within this call. Must not be called while one runs."""
        assert not self.busy
        self.busy, self._then = True, then
        self._begin(job)

    def disown(self) -> None:
        """Drop the outcome of the job that runs, because what it is of has changed."""
        self._then = None

    @abstractmethod
    def _begin(self, job: Callable[[], Any]) -> None:
        """Begin a job, and call `_end` with its Outcome once it is done."""

    def _end(self, outcome: Outcome) -> None:
        then, self._then, self.busy = self._then, None, False
        if then is not None:
            then(outcome)


class JobsInTurn(Jobs):
    """Jobs that are done in this thread, each at the next `work`."""

    def __init__(self, say: Callable[[str], object]) -> None:
        super().__init__()
        self._say = say

    def _begin(self, job: Callable[[], Any]) -> None:
        self._job = job

    def work(self) -> None:
        """Do the job that waits, if there is one."""
        if self.busy:
            self._end(outcome_of(self._job, self._say))


def name_in(message: Any) -> str:
    """The frame of a message with a header; '' if it is not a valid name."""
    name: str = message.header.frame_id
    return name if FRAME_NAME.fits(name) else ""
