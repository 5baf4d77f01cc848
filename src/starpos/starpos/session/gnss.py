# SPDX-License-Identifier: Apache-2.0
"""GNSS in a session: its fixes as they come, the comparison with the stars, what they teach, the known place.  The GNSS
position is compared with the star fix and never fused with it, so that each can expose an error in the other.
"""

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.earth.place import Place
from starpos.earth.vertical import Geodetic, Vertical
from starpos.errors import GnssError, PlaceError
from starpos.files import path_of
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.gnss import states
from starpos.gnss.filter import what_would_tell_more
from starpos.gnss.receiver import NEAREST_S, SPEED_S, GnssTrack, message_to_gnss
from starpos.gnss.solving import Watched, watched
from starpos.gnss.states import Learned
from starpos.gnss.watch import GnssStatus, GnssWatch
from starpos.instrument.instrument import Instrument
from starpos.session.driver import (
    ANOTHER_TIME_S,
    Diagnosis,
    Driver,
    Jobs,
    Level,
    Now,
    outcome_of,
    refusing,
)
from starpos.session.reports import AHEAD_S, ONE_CLOCK
from starpos.session.settings import Settings
from starpos.units import ARCSEC, utc_text

if TYPE_CHECKING:
    from starpos.session.satellites import LiveSatellites

# 1 sigma of a fix that states no error, m an axis
UNSTATED_M = 30.0
# places that differ by more, in sigma, contradict each other
CONTRADICTION_SIGMAS = 5.0
# maximum age of a GNSS place in a comparison, s
OLDEST_S = 5.0
# time for which places are kept: half of an exposure, and the waiting of its frame
KEPT_S = 300.0
# a fix that comes later than this after its stamp is of another clock, s
MAX_LATE_S = 30.0


class RecentPlaces:
    """The places of GNSS of the last KEPT_S, whatever the receiver's rate.

    A frame asks for the middle of its exposure only when that is over, is read, and has its tilts.
    unstated_m: 1 sigma an axis of a place whose message states no error; NaN: it is refused.
    """

    def __init__(self, unstated_m: float = math.nan) -> None:
        self._unstated_m = unstated_m
        self._places: list[Place] = []

    @property
    def newest(self) -> Place | None:
        """The newest place; None without one."""
        return self._places[-1] if self._places else None

    def receive(self, message: Any, now: Now) -> None:
        """Keep the place of a sensor_msgs/NavSatFix; GnssError with the reason if it cannot be used."""
        place = message_to_gnss(message, self._unstated_m)
        ahead_s = now.ahead_s(place.utc_unix_s)
        if ahead_s > AHEAD_S or -ANOTHER_TIME_S < ahead_s < -MAX_LATE_S:
            side = "ahead of" if ahead_s > 0 else "behind"
            raise GnssError(f"GNSS's stamps are {abs(ahead_s):.3g} s {side} this clock: {ONE_CLOCK}")
        back_s = self._places[-1].utc_unix_s - place.utc_unix_s if self._places else 0.0
        if 0 < back_s < ANOTHER_TIME_S:
            raise GnssError("GNSS's stamps go back: check that one receiver publishes, not two")
        if back_s > 0:
            # the stamps before were of another time
            self.forget()
        self._places.append(place)
        if self._places[0].utc_unix_s < place.utc_unix_s - 2 * KEPT_S:
            del self._places[: self._first_since(place.utc_unix_s - KEPT_S)]

    def at(self, utc_unix_s: float) -> Place | None:
        """The place at a time, None without one near; GnssError if the places there contradict each other."""
        # with those on either side from which the speed is known
        around_s = NEAREST_S + SPEED_S
        first = max(self._first_since(utc_unix_s - around_s) - 1, 0)
        return GnssTrack(self._places[first : self._first_since(utc_unix_s + around_s) + 1]).at(utc_unix_s)

    def forget(self) -> None:
        self._places.clear()

    def _first_since(self, utc_unix_s: float) -> int:
        return bisect_left(self._places, utc_unix_s, key=lambda p: p.utc_unix_s)


class ComparedPlaces(RecentPlaces):
    """Places of GNSS that are compared with a fix of their time; they never change a fix."""

    def __init__(self) -> None:
        super().__init__(UNSTATED_M)

    def receive(self, message: Any, now: Now) -> None:
        """Keep the place of a sensor_msgs/NavSatFix; after one without a usable place nothing is compared."""
        try:
            super().receive(message, now)
        except GnssError:
            self.forget()

    def remark(self, answer: Solution | None, vertical: Vertical) -> str:
        """Sentence with the distance, where both places cannot be right; '' otherwise."""
        fix = None if answer is None else answer.fix
        if fix is None:
            return ""
        try:
            gnss = self.at(fix.utc_unix_s)
        except GnssError:
            return ""
        wrong = "" if gnss is None else contradiction(gnss, fix.on_ground(vertical), fix.utc_unix_s, 0.0)[1]
        return f"{wrong}: check how frames are turned, A3 and the inclinometer's axes" if wrong else ""


def contradiction(gnss: Place, ground: Geodetic, utc_unix_s: float, speed: float) -> tuple[float, str]:
    """How far GNSS's place lies from ours of a time, m, and a sentence where the two cannot both be right.

    speed: of the vehicle, m/s, which goes on between the two times.
    """
    off = gnss.offset_m(ground.latitude, ground.longitude)
    on_the_way = speed * (utc_unix_s - gnss.utc_unix_s)
    claim = ground.covariance[:2, :2] + gnss.covariance + np.eye(2) * on_the_way**2
    apart, sigmas = float(np.linalg.norm(off)), float(np.sqrt(off @ np.linalg.solve(claim, off)))
    if sigmas < CONTRADICTION_SIGMAS:
        return apart, ""
    return apart, (
        f"GNSS has a place {apart:.3g} m from here, {sigmas:.2g} times their stated errors: one of them is wrong"
    )


GNSS_TOPIC = "gnss/fix"
# minimum interval between writings of what was learned, s
SAVE_EVERY_S = 60.0


class GnssTeacher:
    """Keeps the newest fixes of GNSS, and what they have taught of the instrument in use.

    jobs: writes the file.  satellites: their place teaches where GNSS has none.
    """

    def __init__(
        self, settings: Settings, jobs: Jobs, driver: Driver, satellites: "LiveSatellites | None" = None
    ) -> None:
        self.newest: Watched | None = None
        self._settings, self._values = settings, settings.values
        self._jobs, self._driver = jobs, driver
        self.places, self._satellites = RecentPlaces(), satellites
        self._watch: GnssWatch | None = None
        self._instrument: Instrument | None = None
        self._saved_s = -math.inf
        # what the file holds
        self._saved = settings.learned
        self._trouble = ""

    @property
    def learned(self) -> Learned | None:
        """What is known of the instrument now."""
        return self._settings.learned if self._watch is None else self._watch.learned

    def receive(self, message: Any, now: Now) -> None:
        """Keep the place of a sensor_msgs/NavSatFix; one that cannot be used is refused with the reason."""
        with refusing(self._driver, GNSS_TOPIC):
            self.places.receive(message, now)

    def solve(self, solver: Solver, stars: Stars, rough: Solution, compared: bool = True) -> Watched:
        """Solve a frame with what GNSS taught before it; compared: with GNSS's place of its time too."""
        watch = self._watch_of(solver.instrument)
        answer = watched(solver, stars, rough, self._compared_with(stars, rough) if compared else None, watch)
        if self._settings.site is not None:
            # the heading there is better than any fix's
            answer = replace(answer, solution=replace(answer.solution, at_place=rough.at_place))
        if compared:
            self.newest = answer
        return answer

    def _watch_of(self, instrument: Instrument) -> GnssWatch:
        """The watch of an instrument; a new one where A3 or the inclinometer is stated otherwise."""
        before = self._instrument
        if self._watch is None:
            self._watch = GnssWatch(instrument, self._settings.vertical, self._settings.learned)
        elif before is not None and (
            before.calibration != instrument.calibration or before.inclinometer != instrument.inclinometer
        ):
            self._driver.warning(
                "another A3 or inclinometer is stated: what GNSS taught of the other is forgotten"
            )
            self._watch = GnssWatch(instrument, self._settings.vertical)
        self._instrument = instrument
        return self._watch

    def other_camera(self) -> None:
        """Forget what was learned of the other camera."""
        if self._watch is not None and self._instrument is not None:
            self._driver.warning("another camera_info: what GNSS taught of the other camera is forgotten")
            self._watch = GnssWatch(self._instrument, self._settings.vertical)

    def _compared_with(self, stars: Stars, rough: Solution) -> Place | None:
        if stars.mid_unix_s is None:
            return None
        try:
            place = self.places.at(stars.mid_unix_s)
        except GnssError as error:
            self._driver.refuse(GNSS_TOPIC, str(error))
            return None
        if place is None and self._satellites is not None and rough.fix is not None:
            return self._satellites.teaching(stars.mid_unix_s)
        return place

    # the file --------------------------------------------------------------------------------------------------------

    def save_if_due(self, now: Now) -> None:
        """Write what was learned, as a job, if the last time is long enough ago."""
        due = not self._jobs.busy and abs(now.waiting_s - self._saved_s) >= SAVE_EVERY_S
        if due and self._worth_saving:
            self._saved_s = now.waiting_s
            self._jobs.run(self._saving(), lambda made: self._note(made.trouble))

    def close(self) -> None:
        """Write what was learned, at the end."""
        if self._worth_saving:
            self._note(outcome_of(self._saving(), self._driver.error).trouble)

    def _saving(self) -> Callable[[], None]:
        path, learned = path_of(self._values["gnss.learned"]), self.learned
        assert learned is not None
        self._saved = learned
        return lambda: states.save_learned(path, learned)

    @property
    def _worth_saving(self) -> bool:
        """Whether there is a file to write, and what was learned is whole and from other frames than the file's."""
        watch = self._watch
        if not self._values["gnss.learned"] or watch is None or watch.learned is None or watch.is_learning:
            return False
        return watch.learned.frames not in (0, 0 if self._saved is None else self._saved.frames)

    def _note(self, trouble: str) -> None:
        if trouble and trouble != self._trouble:
            self._driver.warning(trouble)
        self._trouble = trouble

    # diagnostics -----------------------------------------------------------------------------------------------------

    def report(self) -> Diagnosis:
        """Make the diagnostic `GNSS`."""
        check = None if self.newest is None else self.newest.compared
        values = self._values_of(self.learned)
        if self._trouble:
            return Diagnosis(Level.WARN, self._trouble, values)
        if check is None:
            since = "no GNSS place at the newest frame" if self.newest else "no frame with a GNSS place yet"
            return Diagnosis(Level.WARN, f"{since}: the stars' place goes on with what was learned", values)
        values |= {
            "status": check.status.value,
            "distance (m)": check.distance_m,
            "bearing (deg)": check.bearing_deg,
            "sigma (m)": check.sigma_m,
        }
        if check.status == GnssStatus.DISAGREES:
            return Diagnosis(Level.ERROR, check.sentence, values)
        if check.status == GnssStatus.DOUBTFUL:
            return Diagnosis(Level.WARN, f"{check.sentence}: it teaches nothing now", values)
        return Diagnosis(Level.OK, check.sentence, values)

    def _values_of(self, learned: Learned | None) -> dict[str, object]:
        if learned is None or not learned.frames:
            return {"frames learned from": 0}
        across, about = learned.a3_stddev_rad
        return {
            "frames learned from": learned.frames,
            "poses learned from": learned.poses,
            "learned since": utc_text(learned.since_unix_s),
            "A3 across the plumb line (arcsec, 1 sigma)": across / ARCSEC,
            "A3 about the plumb line (arcsec, 1 sigma)": about / ARCSEC,
            "deflection (arcsec, 1 sigma)": learned.deflection_stddev_rad / ARCSEC,
            "more would tell": what_would_tell_more(learned),
        }


class SessionPlaces:
    """The known place at each time, as `Places`.

    gnss: None without gnss.use.  satellites: None without satellites.elements.
    """

    def __init__(
        self, settings: Settings, gnss: GnssTeacher | None, satellites: "LiveSatellites | None" = None
    ) -> None:
        self._settings, self._gnss, self._satellites = settings, gnss, satellites

    @property
    def known(self) -> bool:
        """Whether a source of the place is set."""
        located = self._satellites is not None and self._satellites.located
        return self._settings.site is not None or self._gnss is not None or located

    def at(self, utc_unix_s: float) -> Place:
        """The place at a time; raises PlaceError where it is not known."""
        if (site := self._settings.site) is not None:
            return site
        try:
            gnss = None if self._gnss is None else self._gnss.places.at(utc_unix_s)
        except GnssError as error:
            raise PlaceError(f"no heading at a known place: {error}") from None
        if gnss is None and self._satellites is not None:
            gnss = self._satellites.at(utc_unix_s)
        if gnss is None:
            raise PlaceError(
                f"no GNSS place within {NEAREST_S:g} s of the frame: no heading at a known place: check gnss/fix and the "
                "clocks, or set site.latitude and site.longitude"
            )
        return gnss.deflected(self._settings.vertical)
