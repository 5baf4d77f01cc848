# SPDX-License-Identifier: Apache-2.0
"""Calibration by the solver itself, at a known place or from headings on the spot, and the average of the fixes.  Both
are here because they must forget at the same events: an average holds for one instrument, poses for one place.
"""

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from types import coroutine
from typing import Any

import numpy as np

from starpos.averaging.average import Average, Averager, average
from starpos.averaging.poses import slip_s
from starpos.calibration.misalignment import Calibrated, calibrate_at, turn
from starpos.earth.place import Place
from starpos.errors import FixError, InstrumentError, StarposError, TiltError
from starpos.fix.checks import at_another_lean
from starpos.fix.fix import Fix
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.identification import Identification
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration
from starpos.instrument.tilt_log import TiltLog, TiltsByTime
from starpos.session.camera_solver import CameraSolver
from starpos.session.driver import Diagnosis, Jobs, Level, Log, Outcome
from starpos.session.settings import Settings
from starpos.session.standing import Averaging, News

MAX_POSES = 36
# The newest tilts of a pose.
MAX_TILTS = 64


@dataclass(frozen=True)
class Seen:
    """The stars of a frame that has a time, with its tilt; found: their identification, None without one."""

    stars: Stars
    tilt: Tilt
    found: Identification | None = None

    @property
    def mid_unix_s(self) -> float:
        assert self.stars.mid_unix_s is not None
        return self.stars.mid_unix_s


@dataclass
class _Pose:
    """A camera that has stood still on the Earth since `first`."""

    first: Fix
    newest: Seen
    frames: int = 0
    tilts: deque[Tilt] = field(default_factory=lambda: deque(maxlen=MAX_TILTS))


class PoseMemory(deque[_Pose]):
    """Keeps each pose's last frame with the mean tilt of the pose; drops the oldest poses."""

    def __init__(self) -> None:
        super().__init__(maxlen=MAX_POSES)

    def keep(self, seen: Seen, fix: Fix) -> bool:
        """Keep a frame; return whether a new calibration is worthwhile: a new pose, or one with twice as many frames."""
        if not self or slip_s(fix.camera, self[-1].first.camera, fix.latitude) != 0:
            self.append(_Pose(fix, seen))
        pose = self[-1]
        pose.newest = seen
        pose.frames += 1
        pose.tilts.append(seen.tilt)
        return pose.frames & (pose.frames - 1) == 0

    def frames(self) -> list[Seen]:
        """Return a frame for each pose whose tilts agree, the oldest first."""
        made = []
        for pose in self:
            try:
                made.append(replace(pose.newest, tilt=mean_tilt(pose.tilts)))
            except TiltError:
                # The tilts contradict each other, and it is unknown which is right.
                continue
        return made

    def forget_before(self, utc_unix_s: float) -> None:
        """Drop the poses before that time, because the instrument has moved then."""
        while self and self[0].newest.mid_unix_s < utc_unix_s:
            self.popleft()


def mean_tilt(tilts: Sequence[Tilt]) -> Tilt:
    """Average the tilts of an instrument at rest without outliers; TiltError if the tilts contradict each other."""
    mean = TiltLog.of_readings(tilts).mean()
    return replace(mean, samples=sum(t.samples for t in tilts), step_rad=max(t.step_rad for t in tilts))


def arguments_of(seen: Sequence[Seen]) -> dict[str, Any]:
    """Frames as a calibration takes them: lists of stars, tilts by time, identifications by the frames' numbers."""
    return {
        "frames": [s.stars for s in seen],
        "tilts": TiltsByTime({s.mid_unix_s: s.tilt for s in seen}),
        "known": {k: s.found for k, s in enumerate(seen) if s.found is not None},
    }


@dataclass(frozen=True)
class Turned:
    """Result of headings on the spot: A3 and the place."""

    calibrated: Calibrated
    place: Average


def turn_on_the_spot(solver: Solver, poses: list[Seen], turn_stddev_deg: float) -> Turned:
    """Calibrate from poses on the spot; FixError if they give no place, or more than one."""
    calibrated = turn(solver, turn_stddev_deg=turn_stddev_deg, **arguments_of(poses))
    if not calibrated.fixes:
        raise FixError(f"no heading has a fix: {calibrated.solutions[0].message}")
    place = average(calibrated.fixes)
    if place.moved:
        raise FixError(
            "the headings are of more than one place: call solver/reset, and turn the instrument on the spot"
        )
    if _newest_is_off(calibrated.fixes):
        raise FixError(
            "the newest heading does not fit the others: the instrument has moved, then call solver/reset, or its tilt "
            "was wrong"
        )
    return Turned(calibrated, place)


def _newest_is_off(fixes: list[Fix]) -> bool:
    averager = Averager()
    before = after = averager.average
    for fix in sorted(fixes, key=lambda f: f.utc_unix_s):
        before = after
        averager.include(fix)
        after = averager.average
    return before is not None and after is not None and after.left_out > before.left_out


# Fewer headings cannot show that they are of one place. The caller of the service asserts it, so it needs one less.
MIN_HEADINGS, MIN_BY_ITSELF = 3, 4
TURN_IT = "turn it on the spot"
CALIBRATE_IT = (
    "fixes have errors of over 1000 km. Set calibration_url or misalignment_stddev, call solver/calibrate at a known "
    "place, or set self_calibration and turn it on the spot"
)
# Number of old frames in a row, in order, that show that a bag is played again.
LATE_FRAMES = 3
# A calibration replaces one that the solver has found itself only if its error is smaller by this factor.
BETTER = 0.8
OF_CALIBRATION = {"misalignment", "misalignment_stddev", "calibration_url"}
# parameters by which A3 or the level's errors become others
OF_MOUNTING = OF_CALIBRATION | {"inclinometer.model"}
OF_AVERAGE = OF_MOUNTING | {
    "self_calibration",
    "refraction.pressure",
    "refraction.temperature",
    "refraction.humidity",
    "refraction.wavelength",
    "clock_stddev",
    "tilt_stddev",
}


class Calibrating:
    """Keeps the calibration from frames: `found`, None while the parameters' calibration holds.

    instrument: the camera and the solver in use.
    changed: called when `found` changes.
    """

    def __init__(
        self,
        settings: Settings,
        jobs: Jobs,
        instrument: CameraSolver,
        changed: Callable[[], None],
        log: Log,
    ) -> None:
        self.found: Calibration | None = None
        self.average = Averaging()
        self._log = log
        self._settings, self._instrument, self._changed = settings, instrument, changed
        self._values = settings.values
        self._recent: deque[Seen] = deque(maxlen=self._values["calibration_frames"])
        self._poses = PoseMemory()
        self._newest_unix_s = self._late_unix_s = -math.inf
        # Number of frames in a row that are older than the newest, each younger than the one before.
        self._late = 0
        # What `found` with its error comes from; None where that is no frames.
        self._calibrated: Calibrated | None = None
        # Grows when the instrument or the place changes; a job of an older era is out of date.
        self._era = 0
        self._worker = jobs
        # Whether a service waits for a job.
        self._asked = False
        # Whether to calibrate by itself again when there is time.
        self._again = False
        # Why the last calibration by itself was not taken.
        self._said = ""

    @property
    def about(self) -> str:
        """A sentence about the calibration that was found; '' without one."""
        if (found := self._calibrated) is None:
            return ""
        c = found.instrument.calibration
        without = sum(s.fix is None for s in found.solutions)
        left_out = f", {without} more had no fix" if without else ""
        rx, ry, rz = c.misalignment_deg
        return (
            f"A3 of {c.frames} frames is {rx:.5f} {ry:.5f} {rz:.5f} deg{left_out}; the plumb line in the camera is known "
            f"to {found.plumb_stddev_arcsec:.2f} arcsec; {at_another_lean(c)}"
        )

    @property
    def unknown(self) -> bool:
        """Whether A3 is not known, so that fixes carry its error."""
        return self._calibrated is None and self._settings.instrument(self.found).calibration.unknown

    # events of the session ----------------------------------------------------------------------------------------------

    def include(self, seen: Seen, fix: Fix | None) -> Average | None:
        """Keep a frame, and average its fix; return the average if it includes this frame."""
        mid = seen.mid_unix_s
        if mid == self._newest_unix_s or self._came_late(mid):
            return None
        self._newest_unix_s = mid
        if len(seen.stars):
            self._recent.append(seen)
        if fix is None:
            return None
        news = self.average.include(fix)
        # While A3 is not known, turning looks like moving.
        if self._calibrated and news is News.MOVED:
            self._era += 1
            self._poses.forget_before(self.average.began_unix_s)
        if self._calibrated and news is News.LEFT_OUT:
            return None
        worthwhile = self._poses.keep(seen, fix)
        if self._values["self_calibration"] and (worthwhile or self._again):
            self._turn_by_itself()
        return None if news is News.LEFT_OUT else self.average.place

    def _came_late(self, mid_unix_s: float) -> bool:
        """Whether a frame is older than an earlier one; after several such frames time has started again: forget all."""
        if mid_unix_s > self._newest_unix_s:
            self._late = 0
            return False
        self._late = self._late + 1 if self._late and mid_unix_s > self._late_unix_s else 1
        self._late_unix_s = mid_unix_s
        if self._late < LATE_FRAMES:
            return True
        self.forget()
        return False

    def forget(self) -> None:
        """Forget the frames and the place, but not the calibration from them."""
        self._era += 1
        self._newest_unix_s, self._late = -math.inf, 0
        self._recent.clear()
        self._poses.clear()
        self.average.begin_anew()

    def camera_changed(self) -> None:
        """Drop A3, because it belongs to the other camera."""
        self.forget()
        if self.found is not None:
            self._log.warning("another camera_info: the calibration found with the other one is unknown now")
            self._drop(Calibration.of(self.found.misalignment_deg))

    def parameters_set(self, names: frozenset[str]) -> None:
        """Apply a change of these parameters."""
        if "calibration_frames" in names:
            self._recent = deque(self._recent, maxlen=self._values["calibration_frames"])
        if names & OF_AVERAGE:
            self.average.begin_anew()
        by_itself = "self_calibration" in names and self._values["self_calibration"]
        if names & OF_CALIBRATION or by_itself:
            self._drop(None)
        if by_itself:
            self._turn_by_itself()

    def _drop(self, instead: Calibration | None) -> None:
        self._era += 1
        self.found, self._calibrated, self._said = instead, None, ""

    def _adopt(self, calibrated: Calibrated) -> None:
        self._era += 1
        self.found, self._calibrated = calibrated.instrument.calibration, calibrated
        self._log.info(self.about)
        self.average.begin_anew()
        self._changed()

    # at a known place ------------------------------------------------------------------------------------------------

    async def at_known_place(self, latitude: float, longitude: float, frames: int) -> Outcome:
        """Find A3 from a number of the newest frames (0: all) at a place by gravity (deg), and use it: a Calibrated."""
        outcome = await self._asked_for(lambda: self._at_known_place(latitude, longitude, frames))
        if not outcome.trouble:
            self._adopt(outcome.value)
        return outcome

    def _at_known_place(self, latitude: float, longitude: float, wanted: int) -> Callable[[], Calibrated]:
        """Make the job; StarposError if the request is wrong or the frames here do not suffice."""
        most = self._values["calibration_frames"]
        if not (abs(latitude) <= 90 and abs(longitude) <= 360):
            raise InstrumentError(
                f"latitude {latitude:g}, longitude {longitude:g}: give the place's, by gravity, in deg"
            )
        if wanted > most:
            raise FixError(
                f"{wanted} frames are more than are kept: give up to {most}, or raise calibration_frames"
            )
        frames = list(self._recent)[-(wanted or most) :]
        if len(frames) < max(wanted, 1):
            asked = f" of {wanted}" if wanted else ""
            raise FixError(
                f"only {len(frames)}{asked} frames with stars and a tilt have arrived: wait for more, or ask for fewer"
            )
        solver = self._instrument.solver_now
        site = Place.by_gravity(latitude, longitude)
        turn_deg, given = self._values["calibration_turn_stddev"], arguments_of(frames)
        return lambda: calibrate_at(solver, site=site, turn_stddev_deg=turn_deg, **given)

    # turning on the spot ---------------------------------------------------------------------------------------------

    async def on_the_spot(self) -> tuple[Turned | None, str]:
        """Find A3 and the place from the headings here, and use them unless the second says why not."""
        outcome = await self._asked_for(self._on_the_spot)
        if outcome.trouble:
            return None, outcome.trouble
        why_not = self._why_not(outcome.value, MIN_HEADINGS)
        if not why_not:
            self._adopt_turned(outcome.value)
        return outcome.value, why_not

    def _on_the_spot(self) -> Callable[[], Turned]:
        """Make the job; StarposError if there are too few poses or no solver."""
        poses = self._poses.frames()
        if len(poses) < 2:
            raise FixError(
                f"the instrument has stood at {_headings(len(poses))} here: turn it on the spot, to "
                f"{MIN_HEADINGS} headings or more"
            )
        solver = self._instrument.solver_now
        turn_deg = self._values["calibration_turn_stddev"]
        return lambda: turn_on_the_spot(solver, poses, turn_deg)

    def _turn_by_itself(self) -> None:
        """Calibrate from the present poses; if a job runs, do it afterwards, from the poses kept then."""
        self._again = self._worker.busy or self._asked
        if self._again:
            return
        if len(self._poses) < MIN_BY_ITSELF:
            self._said = f"{_headings(len(self._poses))} so far, {MIN_BY_ITSELF} are needed"
            return
        try:
            job, era = self._on_the_spot(), self._era
        except StarposError as e:
            self._said = str(e)
            return
        self._worker.run(job, lambda outcome: self._turned_by_itself(outcome, era))

    def _turned_by_itself(self, outcome: Outcome, era: int) -> None:
        if not self._values["self_calibration"]:
            # switched off while it worked
            self._again = False
            return
        if era == self._era:
            said = outcome.trouble or self._why_not(outcome.value, MIN_BY_ITSELF)
            if not said and not self._is_better(outcome.value.calibrated):
                said = "the headings here do not improve the calibration in use"
            self._said = said
            if not said:
                self._adopt_turned(outcome.value)
            elif outcome.trouble and self._calibrated:
                # The newest heading does not fit the others: the place has changed.
                self._era += 1
                self._poses.forget_before(self._newest_unix_s)
                self.average.begin_anew()
        if self._again:
            self._turn_by_itself()

    def _why_not(self, turned: Turned, fewest: int) -> str:
        """Say in a sentence why A3 is not taken from a turn; '' if it is."""
        found, limit = turned.calibrated.plumb_stddev_arcsec, self._values["self_calibration_limit"]
        if turned.place.frames < fewest:
            return (
                f"{turned.place.frames} headings agree, too few to know that they are of one place: turn the instrument "
                f"to {fewest} or more"
            )
        if not found <= limit:
            return (
                f"the headings determine the plumb line in the camera to {found:.0f} arcsec only, self_calibration_limit "
                f"is {limit:g}: turn the instrument further, or to more headings"
            )
        return ""

    def _is_better(self, calibrated: Calibrated) -> bool:
        """Whether it improves on the calibration in use by enough to start the average again.

        The zero of the inclinometer drifts, so the calibration in use gets worse with time.
        """
        if (before := self._calibrated) is None:
            return True
        found, known = calibrated.instrument, before.instrument
        hours = abs(found.calibration.utc_unix_s - known.calibration.utc_unix_s) / 3600
        drift = np.degrees(found.inclinometer.drift_rad_per_sqrt_hour) * 3600
        now_arcsec = math.hypot(before.plumb_stddev_arcsec, drift * math.sqrt(hours))
        return calibrated.plumb_stddev_arcsec < BETTER * now_arcsec

    def _adopt_turned(self, turned: Turned) -> None:
        self._adopt(turned.calibrated)
        self.average.turned_on_the_spot(turned.place)

    # work ------------------------------------------------------------------------------------------------------------

    async def _asked_for(self, prepare: Callable[[], Callable[[], object]]) -> Outcome:
        """Run the job of a service and return its outcome; `prepare` makes the job, or raises a StarposError."""
        if self._asked:
            return Outcome(trouble="another calibration is being worked out: call again when it has answered")
        self._asked = True
        try:
            await _until(lambda: not self._worker.busy)
            era, came = self._era, deque[Outcome]()
            self._worker.run(prepare(), came.append)
            await _until(lambda: bool(came))
        except StarposError as e:
            return Outcome(trouble=str(e))
        finally:
            self._asked = False
        if era != self._era:
            changed = "the instrument was changed, moved or reset meanwhile: call again"
            return Outcome(trouble=came[0].trouble or changed)
        return came[0]

    def report(self) -> Diagnosis:
        """Make the diagnostic `Calibration`."""
        values: dict[str, object] = {"frames kept": len(self._recent), "headings": len(self._poses)}
        values |= {"self-calibration": self._values["self_calibration"], "working": self._worker.busy}
        values |= {"last turn on the spot": self._said}
        if (found := self._calibrated) is not None:
            frames = found.instrument.calibration.frames
            values |= {"plumb line (arcsec)": found.plumb_stddev_arcsec, "found of frames": frames}
        if self.unknown:
            remedy = (self._said or TURN_IT) if self._values["self_calibration"] else CALIBRATE_IT
            return Diagnosis(
                Level.WARN, f"the misalignment of camera and inclinometer is not known: {remedy}", values
            )
        return Diagnosis(Level.OK, self.about or "from the parameters", values)


@coroutine
def _until(done: Callable[[], bool]) -> Iterator[None]:
    """Wait in a coroutine of the node, which its executor resumes again and again."""
    while not done():
        yield


def _headings(count: int) -> str:
    return f"{count} heading{'s' if count != 1 else ''}"
