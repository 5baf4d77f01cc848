# SPDX-License-Identifier: Apache-2.0
"""The solver's decisions: which camera and tilts belong to a frame, how long it waits, and its answer.

A state machine without a clock or a thread of its own: its driver passes each message with its time of arrival, or the
time alone; it returns what to publish.  The node `solver` drives it with ROS's messages, replay.py with a bag's: the
same messages at the same times give the same answers.
"""

import math
import traceback
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

from starpos.averaging.average import Average
from starpos.earth.orientation import earth_state
from starpos.errors import InstrumentError, StarposError
from starpos.fix.attitude import CameraAttitude
from starpos.fix.checks import MODEL_BY_PARAMETERS, unnamed_inclinometer
from starpos.fix.fix import Fix
from starpos.fix.glows import Glows
from starpos.fix.searching import Question
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.gnss.solving import Watched
from starpos.identification.prior import Hint
from starpos.identification.search import Priors
from starpos.instrument.camera import Camera
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars
from starpos.recording.topics import ALL_INPUTS, CAMERA_INFO, NAV_SAT_FIX, STARS, TILT, TRAILS
from starpos.session import reports
from starpos.session.calibrating import OF_AVERAGE, OF_MOUNTING, Calibrating, Seen
from starpos.session.camera_solver import CameraSolver
from starpos.session.deflection import LiveDeflection
from starpos.session.driver import Answered, Changes, Driver, Jobs, Now, Output, Sent, refusing
from starpos.session.gnss import GnssTeacher, SessionPlaces
from starpos.session.gyro import Gyro
from starpos.session.pace import MAX_WAITING, Backlog, Pace, Waiting
from starpos.session.settings import Settings
from starpos.session.solving import AT_ONCE_S, Search, attitude_beside
from starpos.session.standing import ClockDoubt, LevelDoubt
from starpos.session.tilts import TiltBuffer
from starpos.sky import catalogue

if TYPE_CHECKING:
    from starpos.session.satellites import LiveSatellites

T = TypeVar("T")
# what takes a message; it may return answers
Receiver = Callable[[Any, Now, Sent], list[Output] | None]
NOTHING_TOLD = Sent()
J2000_UNIX_S = 946_728_000.0
# A stamp further in the future than AHEAD_S and this many stated sigmas is wrong.
CLOCK_SIGMAS = 6.0
# A clock that goes back by more was set.
STEP_S = 0.05
CAMERA_TOPIC = "camera/camera_info"


class SolverSession:
    """An instrument's messages to its solutions.

    jobs: makes the runner of long jobs; when an Outcome has come, call `at`.
    arrived: gives the messages of `tilt`, or of `stars`, that have come but are not taken yet.
    topic: full name of the topic of the camera's intrinsics, for sentences.
    """

    def __init__(
        self,
        settings: Settings,
        jobs: Callable[[], Jobs],
        driver: Driver,
        *,
        arrived: Callable[[str], Iterable[tuple[Any, Sent]]] = lambda name: (),
        topic: str = CAMERA_TOPIC,
    ) -> None:
        # the runners whose outcomes answers depend on
        self._jobs: list[Jobs] = []

        def waited_for() -> Jobs:
            self._jobs.append(jobs())
            return self._jobs[-1]

        self.latest: Waiting | None = None
        self.answer: Solution | None = None
        self.pace = Pace()
        # whether another frame can be answered at once, live: whoever drives the session calls `at` again, so that
        # messages that arrived meanwhile are taken first
        self.more = False
        self.tilts = TiltBuffer(settings)
        self.doubt = ClockDoubt()
        self._level = LevelDoubt()
        self.gyro = Gyro(driver)
        self.satellites: LiveSatellites | None = None
        if settings.orbits is not None:
            from starpos.session import satellites

            self.satellites = satellites.LiveSatellites(settings, settings.orbits, waited_for(), driver)
        self.gnss: GnssTeacher | None = None
        if settings.values["gnss.use"]:
            self.gnss = GnssTeacher(settings, jobs(), driver, self.satellites)
        self._receivers: dict[str, Receiver] = {
            CAMERA_INFO: self._receive_camera,
            TILT: self._receive_tilt,
            STARS: self._receive_stars,
        }
        if (gnss := self.gnss) is not None:
            self._receivers[NAV_SAT_FIX] = lambda message, now, sent: gnss.receive(message, now)
        if (by_trails := self.satellites) is not None:
            self._receivers[TRAILS] = lambda message, now, sent: by_trails.receive(message)
        self.places = SessionPlaces(settings, self.gnss, self.satellites)
        self.deflection = LiveDeflection(settings, waited_for())
        self._search = Search(settings.values)
        self._glows = Glows()
        self._settings, self._values = settings, settings.values
        self._catalogue = catalogue.load_catalogue()
        # This reads the tables of the Earth's rotation, so that the first frame is not slow.
        earth_state(J2000_UNIX_S)
        self._driver = driver
        self._arrived = arrived
        self._backlog = Backlog()
        self._was_s: float | None = None
        self._ended = False
        # from the last fix
        self._hint: Hint | None = None
        self._changes = Changes(driver)
        self.instrument = CameraSolver(
            self._make_solver,
            self._other_camera,
            waited_for(),
            lambda why: self._changes.say(why, good=False),
            topic,
        )
        self.calibrating = Calibrating(
            settings, waited_for(), self.instrument, self._other_calibration, driver
        )
        if unnamed := unnamed_inclinometer(settings.instrument(None), MODEL_BY_PARAMETERS):
            driver.warning(unnamed)

    def _make_solver(self, camera: Camera) -> Solver:
        return self._settings.solver(camera, self.calibrating.found, self._catalogue)

    def _other_calibration(self) -> None:
        self._believe_level()
        self.instrument.remake()

    def _believe_level(self) -> None:
        """Believe the level again, also of the newest frame."""
        self._level.clear()
        if self.latest is not None:
            self.latest = replace(self.latest, refused=None)

    def _other_camera(self) -> None:
        self._settings.camera = self.instrument.camera
        self._forget()
        self._search.other_camera()
        self._glows = Glows()
        self._believe_level()
        if self.gnss is not None:
            self.gnss.other_camera()
        self.calibrating.camera_changed()

    def _forget(self) -> None:
        """Forget what is known by the camera's pose."""
        self._hint = None
        self.gyro.forget()
        if self.satellites is not None:
            self.satellites.forget()
        self.deflection.forget()

    @property
    def inputs(self) -> dict[str, str]:
        """The types of the messages that it takes by the relative names of their topics."""
        return {name: kind for name, kind in ALL_INPUTS.items() if kind in self._receivers}

    @property
    def waits(self) -> bool:
        """Whether a frame or a tilt waits for its time."""
        return bool(self._backlog) or self.tilts.waits

    @property
    def busy(self) -> bool:
        """Whether a job runs: what comes meanwhile may be answered with its outcome, or without."""
        return any(jobs.busy for jobs in self._jobs)

    # parameters ------------------------------------------------------------------------------------------------------

    def parameters_set(self, names: frozenset[str]) -> None:
        """Apply a change of these parameters."""
        if "clock_stddev" in names:
            self.doubt.clear()
        if names & OF_MOUNTING:
            self._believe_level()
        elif names & OF_AVERAGE:
            self._level.begin_anew()
        self.calibrating.parameters_set(names)
        self.deflection.parameters_set(names)
        self.instrument.remake()

    # inputs ----------------------------------------------------------------------------------------------------------

    def receive(self, kind: str, message: Any, now: Now, sent: Sent = NOTHING_TOLD) -> list[Output]:
        """Take a message of a type of `inputs`.

        Another camera counts from now on; in recorded data from its stamp on, since it may be read before frames that
        were taken before it.
        """
        made = self._begun(now)
        made += self._receivers[kind](message, now, sent) or []
        return made + self._work(now)

    def _receive_camera(self, message: Any, now: Now, sent: Sent) -> None:
        with refusing(self._driver, "camera_info"):
            self.instrument.receive(message, at_once=not now.played)

    def _receive_tilt(self, message: Any, now: Now, sent: Sent) -> None:
        with refusing(self._driver, "tilt"):
            self.tilts.receive(message, sent, now)

    def _receive_stars(self, message: Any, now: Now, sent: Sent) -> list[Output]:
        """Take a StarArray, and those that have come after it."""
        made = self._add_stars(message, now, sent)
        for later, later_sent in self._arrived("stars"):
            made += self._add_stars(later, now, later_sent)
        return made

    def _add_stars(self, message: Any, now: Now, sent: Sent) -> list[Output]:
        """Have a frame wait for its tilts, if there is room; return a bad one's answer."""
        if not self._accepts(message.header, now, sent):
            return []
        try:
            stars = message_to_stars(message)
        except StarposError as e:
            bad = replace(Solution.unreadable("stars", e), stars_detected=len(message.stars))
            self._note(bad, now)
            return [self._output(message.header.stamp, Watched(solution=bad))]
        self._wait_for(stars, message.header, now)
        return []

    def receive_detected(self, stars: Stars, header: Any, now: Now) -> list[Output]:
        """Take stars as a StarArray with this header holds them."""
        made = self._begun(now)
        if self._accepts(header, now, NOTHING_TOLD):
            self._wait_for(stars, header, now)
        return made + self._work(now)

    def _accepts(self, header: Any, now: Now, sent: Sent) -> bool:
        """Whether a frame is wanted and can be answered in time."""
        self._driver.came("stars")
        if not now.played:
            self.pace.numbered(sent.number, now.waiting_s)
        if not self.pace.wants(stamp_to_unix(header.stamp), self._values["max_rate"]):
            return False
        self._search.note_frame(now)
        if not now.played and not self._backlog.has_room(self._delay_s(now)):
            self.pace.drop(now.waiting_s)
            return False
        self.pace.took(now.waiting_s)
        return True

    def _wait_for(self, stars: Stars, header: Any, now: Now) -> None:
        """Have a frame wait for its tilts."""
        # If the user sets clock_stddev, it replaces the error that the camera's host states.
        if not math.isnan(self._values["clock_stddev"]):
            stars = replace(stars, clock_stddev_s=0.0)
        self.instrument.note_frame_size(stars.width, stars.height, at_once=not now.played)
        if len(self._backlog) >= MAX_WAITING:
            self.pace.drop(now.waiting_s)
            self._driver.refuse("stars", f"a frame was dropped: {MAX_WAITING} wait for their tilts")
            return
        ahead_s = now.ahead_s(stars.mid_unix_s)
        self._backlog.append(Waiting(header=header, stars=stars, since_s=now.waiting_s, ahead_s=ahead_s))
        if self.instrument.preparing and not now.played:
            self.pace.dropped += self._backlog.keep_newest()

    def _delay_s(self, now: Now) -> float:
        """For how long frames wait for their tilts, by the tilts that have come, and by the first frame."""
        if not self._backlog or self._ready(self._backlog[0], now):
            return self.tilts.delay_s
        return max(self.tilts.delay_s, now.waiting_s - self._backlog[0].since_s)

    def at(self, now: Now) -> list[Output]:
        """Go on to a time."""
        self._advance(now)
        return self._work(now)

    def _begun(self, now: Now) -> list[Output]:
        """Go on to the time of a message before it is taken; live, what is ready is answered with it."""
        self._advance(now)
        return self._work(now) if now.played else []

    def end(self, now: Now) -> list[Output]:
        """Answer the frames that wait, because nothing comes any more; again after a job."""
        self._advance(now)
        self._ended = True
        return self._work(now)

    def _advance(self, now: Now) -> None:
        self._ended = False
        was_s, self._was_s = self._was_s, now.unix_s
        if was_s is None or now.unix_s is None:
            return
        if now.unix_s < was_s - STEP_S:
            # The clock was set back: no tilt may be from the future, and another player is no second inclinometer.
            self.tilts.forget_after(now.unix_s)
            self.tilts.forget_publishers()
        if now.unix_s > was_s:
            for message in self.tilts.pop_early():
                with refusing(self._driver, "tilt"):
                    self.tilts.keep_in_time(message, now)

    def _work(self, now: Now) -> list[Output]:
        """Answer what can be answered, and have the trails of these frames looked at."""
        made = self._answers(now)
        return made if self.satellites is None else [*made, *self.satellites.fetch()]

    def _answers(self, now: Now) -> list[Output]:
        """Answer the first frames that have everything they need: of recorded ones all, live one at a time."""
        made: list[Output] = []
        self.more = False
        # In recorded data a job is done when it was begun, however long it takes.
        while not (now.played and self.busy) and self._first_ready(now):
            if made and not now.played:
                self.more = True
                return made
            # After a stall the frame's own tilts may be among them.
            for message, sent in self._arrived("tilt"):
                self._receive_tilt(message, now, sent)
            made.append(self._solve(self._backlog.pop_first(now.waiting_s).dated(now), now))
        self._backlog.pause()
        return made

    def _first_ready(self, now: Now) -> bool:
        if self._backlog:
            self.instrument.advance_to(self._backlog[0].stars.mid_unix_s)
        return bool(self._backlog) and self._ready(self._backlog[0], now)

    def _ready(self, frame: Waiting, now: Now) -> bool:
        if self.instrument.preparing:
            return False
        if math.isnan(frame.since_s):
            frame = self._backlog[0] = replace(frame, since_s=now.waiting_s)
        mid, waited_s = frame.stars.mid_unix_s, now.waiting_s - frame.since_s
        # a negative wait: the clock has begun anew
        if mid is None or self._ended or waited_s > self.tilts.patience_s or waited_s < 0:
            return True
        if self.instrument.solver is None:
            return bool(self.instrument.trouble)
        # an instrument at a known place may have no inclinometer
        if self.places.known and not len(self.tilts):
            return True
        return self.tilts.complete(mid, frame.stars.exposure_s or 0.0)

    def _solve(self, frame: Waiting, now: Now) -> Answered:
        predicted: Priors = self._guarded(
            lambda: self.gyro.predicted(frame.stars, self.instrument.solver), lambda e: ()
        )
        until_s = self._search.until_s(now, bool(self._backlog))
        question = self._question(frame, predicted=predicted, hint=self._hint, until_s=until_s)
        answer = self._answer(frame, question)
        if (fix := answer.fix) is not None and answer.ok:
            frame, answer = self._guarded(
                lambda: self._with_doubt(frame, answer, fix),
                lambda e: (frame, _failed(frame, "the solver failed on this frame", e)),
            )
        self.latest = frame
        # if a frame's time is in doubt, so is GNSS's place for it
        answered = self._taught(frame, answer, compared=not frame.doubted)
        if now.played:
            # by the clock of recorded data no time passes
            answered = replace(answered, solution=replace(answered.solution, identify_s=0.0, fix_s=0.0))
        self._note(answered.solution, now)
        if (satellites := self.satellites) is not None and not frame.doubted:
            self._guarded(
                lambda: satellites.note(frame.header.stamp, frame.stars, answered.solution), lambda e: None
            )
        attitude = self._attitude(frame, question, answered.solution)
        return replace(answered, attitude=attitude, average=self._learn(frame, answered.solution))

    def _guarded(self, work: Callable[[], T], instead: Callable[[Exception], T]) -> T:
        """What `work` makes.  A defect in it is logged and loses only that: the session goes on with `instead`."""
        try:
            return work()
        except Exception as e:
            self._driver.error(traceback.format_exc())
            return instead(e)

    def _question(self, frame: Waiting, **known: Any) -> Question:
        """What is asked of a frame; known: further fields of a Question."""
        # a node has no picture to look at, only the list
        stars = frame.stars
        places = self.places if self.places.known else None
        return Question(item=stars, stars=stars, tilts=self.tilts, places=places, **known)

    def _answer(self, frame: Waiting, question: Question) -> Solution:
        def work() -> Solution:
            try:
                solver = self.instrument.solver_now
            except InstrumentError as e:
                return Solution.failed(frame.stars, Status.BAD_INPUT, str(e))
            if frame.ahead_s > reports.AHEAD_S + CLOCK_SIGMAS * solver.clock_stddev_s(frame.stars):
                return Solution.failed(
                    frame.stars,
                    Status.BAD_INPUT,
                    f"the frame is stamped {frame.ahead_s:.3g} s in the future: {reports.ONE_CLOCK}",
                )
            return self._search.solve(solver, question).beside(self._glows)

        return self._guarded(work, lambda e: _failed(frame, "the solver failed on this frame", e))

    def _with_doubt(self, frame: Waiting, answer: Solution, fix: Fix) -> tuple[Waiting, Solution]:
        """What earlier frames show of a frame's time and level: it has the time's error, or no fix."""
        stated_s = math.hypot(
            self.instrument.solver_now.clock_stddev_s(frame.stars), frame.stars.stamp_stddev_s
        )
        self.doubt.judge(fix, stated_s)
        if self.doubt.seconds <= stated_s:
            if not self._level.contradicts(fix, stated_s):
                return frame, answer
            return _refused(frame, answer, reports.OTHER_LEVEL)
        frame = replace(frame, stars=replace(frame.stars, clock_stddev_s=self.doubt.seconds), doubted=True)
        known = self._question(frame, hint=answer.hint, until_s=AT_ONCE_S, known=answer.found)
        answer = self._answer(frame, known)
        return _refused(frame, answer, reports.OTHER_TILTS) if self.doubt.leans_otherwise else (frame, answer)

    def _taught(self, frame: Waiting, answer: Solution, compared: bool) -> Answered:
        """The answer to a frame, with gnss.use by what GNSS has taught; compared: with GNSS's place of its time too."""
        solver, gnss, taught = self.instrument.solver, self.gnss, Watched(solution=answer)
        if gnss is not None and solver is not None and frame.refused is None:
            why = "what GNSS taught could not be used on this frame"
            taught = self._guarded(
                lambda: gnss.solve(solver, frame.stars, answer, compared),
                lambda e: Watched(solution=_failed(frame, why, e)),
            )
        return self._output(frame.header.stamp, taught)

    def _attitude(self, frame: Waiting, question: Question, answer: Solution) -> CameraAttitude | None:
        if (solver := self.instrument.solver) is None:
            return None
        question = replace(question, item=frame.stars, stars=frame.stars)
        return self._guarded(
            lambda: attitude_beside(solver, question, answer, frame.header.frame_id, self.gyro),
            lambda e: None,
        )

    def _learn(self, frame: Waiting, answer: Solution) -> Average | None:
        """Give a frame to the calibration and the average, even one that a stale calibration refuses.

        A frame whose time is in doubt is left out.  Returns the average if it includes the frame.
        """
        stars, solver = frame.stars, self.instrument.solver
        if solver is None or stars.mid_unix_s is None or frame.doubted:
            return None
        if answer.status is Status.BAD_INPUT and frame.ahead_s > reports.AHEAD_S:
            return None
        try:
            tilt = answer.tilt or self.tilts.average(stars.mid_unix_s, stars.exposure_s or 0.0)
            solver.instrument.inclinometer.check_live(tilt)
        except StarposError:
            return None
        self._guarded(lambda: self.deflection.include(solver, stars, tilt, answer.found), lambda e: None)
        return self._guarded(
            lambda: self.calibrating.include(Seen(stars, tilt, answer.found), answer.fix),
            # data that cause a defect must not stay
            lambda e: self.calibrating.forget(),
        )

    def _note(self, answer: Solution, now: Now) -> None:
        """Note the answer to the newest frame."""
        self.answer = answer
        self.pace.answered(answer.ok)
        self._hint = answer.hint or self._hint
        self._changes.say("fixes are coming" if answer.ok else answer.message, answer.ok, answer.status)
        if self.gnss is not None:
            self.gnss.save_if_due(now)

    def _output(self, stamp: Any, made: Watched) -> Answered:
        no_camera = self.instrument.solver is None and self.instrument.camera is None
        solution, ground = made.solution, made.ground
        if ground is None and solution.fix is not None:
            ground = solution.fix.on_ground(self._settings.vertical)
        return Answered(
            stamp=stamp, solution=solution, ground=ground, no_camera=no_camera, compared=made.compared
        )

    def solve_again(self) -> Answered | None:
        """Solve the newest frame with what is known now, identified anew whatever was found before; None without one.

        A frame that earlier ones contradict stays refused.
        """
        if (latest := self.latest) is None:
            return None
        question = self._question(latest, until_s=self._search.until_s(None, False))
        return self._taught(latest, latest.refused or self._answer(latest, question), compared=False)

    def reset(self) -> None:
        """Forget tilts, frames and the place, but no calibration that was found."""
        self.tilts.clear()
        self._backlog.clear()
        self.latest = self.answer = None
        self._forget()
        if self.gnss is not None:
            self.gnss.places.forget()
        self.doubt.clear()
        self._level.clear()
        self.calibrating.forget()


def _refused(frame: Waiting, answer: Solution, why: str) -> tuple[Waiting, Solution]:
    """A frame whose level earlier frames contradict, and its answer: what needs no level."""
    refused = replace(answer, status=Status.NO_TILT, message=why, fix=None, tilt=None, circle=None)
    return replace(frame, doubted=True, refused=refused), refused


def _failed(frame: Waiting, what: str, error: Exception) -> Solution:
    return Solution.failed(frame.stars, Status.BAD_INPUT, f"{what} ({type(error).__name__}: {error})")
