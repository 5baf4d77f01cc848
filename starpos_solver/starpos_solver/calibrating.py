# SPDX-License-Identifier: Apache-2.0
"""The solver's own calibration: at a known place, or from headings on the spot, by service or by itself; and the average.

Both share what they must forget, and when: an average is of one instrument, poses are of one place.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from starpos.averaging.average import Average, Averager, average
from starpos.calibration.misalignment import Calibrated, calibrate_at
from starpos.calibration.plumb_line import UNKNOWN_ARCSEC
from starpos.calibration.turning import turn
from starpos.errors import FixError, InstrumentError, StarposError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solver
from starpos.instrument.instrument import Calibration
from starpos.sky.site import Site
from starpos_common.diagnostics import Diagnosis, Level
from starpos_common.job import JobRunner, Outcome
from starpos_interfaces.srv import Calibrate, SelfCalibrate
from starpos_solver.averaging import Averaging, News
from starpos_solver.memory import PoseMemory, RecentFrames, Seen, tilts_of

# Fewer headings hold no check that they are of one place; a service's caller says that they are.
FEWEST_HEADINGS, FEWEST_BY_ITSELF = 3, 4
LATE_FRAMES = 3  # so many older ones in their own order are no late ones: a bag is played again
BETTER = 0.8  # of its error, by which a calibration must be to take the place of one that the solver has found itself
OF_CALIBRATION = {"misalignment", "misalignment_stddev", "calibration_url"}
OF_AVERAGE = OF_CALIBRATION | {
    "self_calibration",
    "refraction.pressure",
    "refraction.temperature",
    "refraction.humidity",
    "clock_stddev",
    "tilt_stddev",
}


@dataclass(frozen=True)
class Turned:
    """What headings on the spot tell: A3 and the place."""

    calibrated: Calibrated
    place: Average


class Calibrating:
    """`found` is the calibration that frames have told, None as long as that of the parameters holds.

    solver: the one in use, or an InstrumentError that says why there is none.  changed: called when `found` is another.
    """

    def __init__(
        self, node: Node, values: Mapping, solver: Callable[[], Solver], changed: Callable[[], None]
    ):
        self.found: Calibration | None = None
        self.average = Averaging()
        self._log = node.get_logger()
        self._values, self._solver, self._changed = values, solver, changed
        self._recent = RecentFrames(values["calibration_frames"])
        self._poses = PoseMemory()
        self._newest_unix_s = self._late_unix_s = -math.inf
        self._late = 0  # frames in a row that are older than the newest, each younger than the one before
        self._plumb_arcsec = math.nan  # how well `found` has the plumb line; nan: it is not known
        self._era = 0  # what was begun in an older one is of another instrument or place
        self._worker = JobRunner(node)
        self._running: Future | None = None
        self._asked = self._again = False  # by a service; to turn once more when there is time
        self._about = self._said = ""  # of `found`; of the last turn by itself
        group = ReentrantCallbackGroup()  # so that an answer which is awaited holds up nothing
        node.create_service(Calibrate, "solver/calibrate", self._on_calibrate, callback_group=group)
        node.create_service(
            SelfCalibrate, "solver/self_calibrate", self._on_self_calibrate, callback_group=group
        )

    @property
    def unknown(self) -> bool:
        """Whether fixes carry the error of an A3 of which nothing is known."""
        given = self.found is None and not self._values["self_calibration"]
        return not self._is_told and not given

    @property
    def _is_told(self) -> bool:
        """Whether frames have told how A3 is, and how well."""
        return not math.isnan(self._plumb_arcsec)

    # what happens to the node ----------------------------------------------------------------------------------------

    def learn(self, seen: Seen, fix: Fix | None) -> bool:
        """From one more frame, and the fix it gave; whether the average is of this frame too."""
        mid = seen.stars.mid_unix_s
        if mid == self._newest_unix_s or self._came_late(mid):
            return False
        self._newest_unix_s = mid
        self._recent.add(seen)
        if fix is None:
            return False
        news = self.average.add(fix)
        # while A3 is not known to be right, turning looks like moving
        if self._is_told and news is News.MOVED:
            self._era += 1
            self._poses.forget_before(self.average.began_unix_s)
        if self._is_told and news is News.LEFT_OUT:
            return False
        told_more = self._poses.add(seen, fix)
        if self._values["self_calibration"] and (told_more or self._again):
            self._turn_by_itself()
        return news is not News.LEFT_OUT

    def _came_late(self, mid_unix_s: float) -> bool:
        """Whether a frame is older than one before it; where many are, time has begun anew, and so does all here."""
        if mid_unix_s > self._newest_unix_s:
            self._late = 0
            return False
        self._late = self._late + 1 if self._late and mid_unix_s > self._late_unix_s else 1
        self._late_unix_s = mid_unix_s
        if self._late < LATE_FRAMES:
            return True
        self.forget()
        return False

    def _moved_on(self, since_unix_s: float):
        self._era += 1
        self._poses.forget_before(since_unix_s)
        self.average.begin_anew()

    def forget(self) -> None:
        """The frames and the place; not what they have told of the instrument."""
        self._era += 1
        self._newest_unix_s, self._late = -math.inf, 0
        self._recent.clear()
        self._poses.clear()
        self.average.begin_anew()

    def camera_changed(self) -> None:
        """A3 is that of the other camera."""
        self.forget()
        if self.found is not None:
            self._log.warning("another camera_info: the calibration found with the other one is unknown now")
            self._drop(Calibration.of(self.found.misalignment_deg, UNKNOWN_ARCSEC))

    def parameters_set(self, names: frozenset[str]) -> None:
        """Some of them, to whatever values."""
        if "calibration_frames" in names:
            self._recent.keep(self._values["calibration_frames"])
        if names & OF_AVERAGE:
            self.average.begin_anew()
        by_itself = "self_calibration" in names and self._values["self_calibration"]
        if names & OF_CALIBRATION or by_itself:
            self._drop(None)
        if by_itself:
            self._turn_by_itself()

    def _drop(self, instead: Calibration | None):
        self._era += 1
        self.found, self._plumb_arcsec = instead, math.nan
        self._about = self._said = ""

    def _adopt(self, calibrated: Calibrated):
        self._era += 1
        self.found = calibrated.instrument.calibration
        self._plumb_arcsec = calibrated.plumb_stddev_arcsec
        self._about = _about(calibrated)
        self._log.info(self._about)
        self.average.begin_anew()
        self._changed()

    # at a known place ------------------------------------------------------------------------------------------------

    async def _on_calibrate(self, request, response):
        response.misalignment_deg, response.covariance_deg2 = [math.nan] * 3, [math.nan] * 9
        outcome = await self._asked_for(lambda: self._at_known_place(request))
        response.message = outcome.trouble
        if outcome.trouble:
            return response
        self._adopt(outcome.value)
        response.success, response.message = True, self._about
        return _with_a3(response, outcome.value)

    def _at_known_place(self, request) -> Callable[[], Calibrated]:
        """The job; StarposError where the request or what is here does not do."""
        latitude, longitude, most = request.latitude, request.longitude, self._values["calibration_frames"]
        if not (abs(latitude) <= 90 and abs(longitude) <= 360):
            raise InstrumentError(
                f"latitude {latitude:g}, longitude {longitude:g}: give those of the place, by gravity, in deg"
            )
        if request.frames > most:
            raise FixError(
                f"{request.frames} frames are more than are kept: give up to {most}, or raise calibration_frames"
            )
        frames = self._recent.newest(request.frames or most)
        if len(frames) < max(request.frames, 1):
            asked = f" of {request.frames}" if request.frames else ""
            raise FixError(
                f"only {len(frames)}{asked} frames with stars and a tilt have arrived: wait for more, or ask for fewer"
            )
        solver = self._solver()
        site = Site(latitude, longitude, solver.atmosphere)
        turn_deg = self._values["calibration_turn_stddev"]
        stars, tilts = [f.stars for f in frames], tilts_of(frames)
        return lambda: calibrate_at(solver, stars, tilts, site, turn_stddev_deg=turn_deg)

    # turning on the spot ---------------------------------------------------------------------------------------------

    async def _on_self_calibrate(self, request, response):
        response.misalignment_deg, response.covariance_deg2 = [math.nan] * 3, [math.nan] * 9
        response.latitude = response.longitude = response.plumb_stddev = math.nan
        response.covariance = [math.nan] * 4
        outcome = await self._asked_for(self._on_the_spot)
        response.message = outcome.trouble
        if outcome.trouble:
            return response
        turned = outcome.value
        response.message = self._why_not(turned, FEWEST_HEADINGS)
        if not response.message:
            self._adopt_turned(turned)
            response.success, response.message = True, self._about
        place = turned.place
        response.headings = place.frames
        response.plumb_stddev = turned.calibrated.plumb_stddev_arcsec / 3600
        response.latitude, response.longitude = math.degrees(place.latitude), math.degrees(place.longitude)
        response.covariance = place.covariance[:2, :2].ravel()
        return _with_a3(response, turned.calibrated)

    def _on_the_spot(self) -> Callable[[], Turned]:
        """The job; StarposError where there is nothing to do it with."""
        poses = self._poses.frames()
        if len(poses) < 2:
            raise FixError(
                f"the instrument has stood at {_headings(len(poses))} here: turn it on the spot, to "
                f"{FEWEST_HEADINGS} headings or more"
            )
        solver = self._solver()
        turn_deg = self._values["calibration_turn_stddev"]
        return lambda: _turn(solver, poses, turn_deg)

    def _turn_by_itself(self):
        """From the poses there are; when it is busy, from those there are then."""
        self._again = self._worker.busy or self._asked
        if self._again:
            return
        if len(self._poses) < FEWEST_BY_ITSELF:
            self._said = f"{_headings(len(self._poses))} so far, {FEWEST_BY_ITSELF} are needed"
            return
        try:
            job, era = self._on_the_spot(), self._era
        except StarposError as e:
            self._said = str(e)
            return
        self._run(job).add_done_callback(lambda future: self._turned_by_itself(future.result(), era))

    def _turned_by_itself(self, outcome: Outcome, era: int):
        if era == self._era:
            said = outcome.trouble or self._why_not(outcome.value, FEWEST_BY_ITSELF)
            if not said and not self._is_better(outcome.value.calibrated):
                said = "the headings here tell the calibration in use no better"
            self._said = said
            if not said:
                self._adopt_turned(outcome.value)
            elif outcome.trouble and self._is_told:  # the newest heading is where it no longer holds together
                self._moved_on(self._newest_unix_s)
        if self._again:
            self._turn_by_itself()

    def _why_not(self, turned: Turned, fewest: int) -> str:
        """Why A3 is not taken from it; '' where it is."""
        found, limit = turned.calibrated.plumb_stddev_arcsec, self._values["self_calibration_limit"]
        if turned.place.frames < fewest:
            return (
                f"{turned.place.frames} headings agree, too few to know that they are of one place: turn the instrument "
                f"to {fewest} or more"
            )
        if not found <= limit:
            return (
                f"the headings tell the plumb line in the camera to {found:.0f} arcsec only, self_calibration_limit is "
                f"{limit:g}: turn the instrument further, or to more headings"
            )
        return ""

    def _is_better(self, calibrated: Calibrated) -> bool:
        """Than what is in use, whose zero wanders; by so much that the average should begin anew for it."""
        if not self._is_told:
            return True
        now = calibrated.instrument.calibration.utc_unix_s
        hours = abs(now - self.found.utc_unix_s) / 3600
        drift = np.degrees(calibrated.instrument.inclinometer.drift_rad_per_sqrt_hour) * 3600
        return calibrated.plumb_stddev_arcsec < BETTER * math.hypot(
            self._plumb_arcsec, drift * math.sqrt(hours)
        )

    def _adopt_turned(self, turned: Turned):
        self._adopt(turned.calibrated)
        self.average.turned_on_the_spot(turned.place)

    # work ------------------------------------------------------------------------------------------------------------

    async def _asked_for(self, prepare: Callable[[], Callable[[], object]]) -> Outcome:
        """What a service's job gave; `prepare` makes it, or raises a StarposError."""
        if self._asked:
            return Outcome(trouble="another calibration is being worked out: call again when it has answered")
        self._asked = True
        try:
            if self._worker.busy:
                await self._running
            job, era = prepare(), self._era
            outcome = await self._run(job)
        except StarposError as e:
            return Outcome(trouble=str(e))
        finally:
            self._asked = False
        if era != self._era:
            changed = "the instrument was changed, moved or reset meanwhile: call again"
            return Outcome(trouble=outcome.trouble or changed)
        return outcome

    def _run(self, job: Callable[[], object]) -> Future:
        self._running = self._worker.run(job)
        return self._running

    def report(self) -> Diagnosis:
        """For /diagnostics."""
        values = {"frames kept": len(self._recent), "headings": len(self._poses)}
        values |= {"self-calibration": self._values["self_calibration"], "working": self._worker.busy}
        values |= {"last turn on the spot": self._said}
        if self._is_told:
            values |= {"plumb line (arcsec)": self._plumb_arcsec, "found of frames": self.found.frames}
        if self.unknown:
            sentence = "camera against inclinometer is not known: " + (self._said or "turn it on the spot")
            return Diagnosis(Level.WARN, sentence, values)
        return Diagnosis(Level.OK, self._about or "that of the parameters", values)


def _turn(solver: Solver, poses: list[Seen], turn_stddev_deg: float) -> Turned:
    """FixError where the poses are not of one place or tell none."""
    calibrated = turn(solver, [p.stars for p in poses], tilts_of(poses), turn_stddev_deg)
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
    for fix in sorted(fixes, key=lambda f: f.utc_unix_s):
        before = averager.average
        averager.add(fix)
    return before is not None and averager.average.left_out > before.left_out


def _about(found: Calibrated) -> str:
    c = found.instrument.calibration
    turn_deg = math.sqrt(np.linalg.eigvalsh(np.asarray(c.covariance_arcsec2))[-1]) / 3600
    without = sum(s.fix is None for s in found.solutions)
    left_out = f", {without} more had no fix" if without else ""
    return (
        "A3 of {} frames is {:.5f} {:.5f} {:.5f} deg{}; the plumb line in the camera is known to {:.2f} arcsec, the turn "
        "about it, which counts at another lean, to {:.2g} deg"
    ).format(c.frames, *c.misalignment_deg, left_out, found.plumb_stddev_arcsec, turn_deg)


def _headings(count: int) -> str:
    return f"{count} heading{'s' if count != 1 else ''}"


def _with_a3(response, found: Calibrated):
    c = found.instrument.calibration
    response.misalignment_deg = list(c.misalignment_deg)
    response.covariance_deg2 = c.angle_covariance_deg2.ravel()
    return response
