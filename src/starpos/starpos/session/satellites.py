# SPDX-License-Identifier: Apache-2.0
"""The place by satellites in a session: trails of the last frames, their stars and orbits, adjusted in a job."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from starpos.earth.place import Place
from starpos.errors import SatelliteError, StarposError
from starpos.fix.solution import Solution
from starpos.frames.frame import FrameTrail, Stars
from starpos.gnss.receiver import gnss_place
from starpos.messages.stamp import stamp_to_ns
from starpos.messages.stars import message_to_trails
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import StoredOrbits, chosen
from starpos.satellites.frames import FrameSky
from starpos.satellites.locating import locate
from starpos.satellites.trails import SatelliteTrail
from starpos.session.driver import Diagnosis, Driver, Jobs, Level, Located, refusing
from starpos.session.settings import Settings
from starpos.sky import catalogue

# frames whose stars wait for their trails, or trails for their stars
KEPT = 32
# The place's error is the same in all frames. So 40 frames teach by it, each as if the place's variance were 40 times as
# large: together they have the information of one place.
TEACHES = 40
Frame = tuple[Any, Stars, Solution, list[FrameTrail]]


class LiveSatellites:
    """Collects trails of identified frames while satellites.elements is set; each frame with trails begins a job."""

    def __init__(self, settings: Settings, orbits: StoredOrbits, jobs: Jobs, driver: Driver) -> None:
        self._settings, self._orbits, self._jobs, self._driver = settings, orbits, jobs, driver
        self._catalogue = catalogue.load_catalogue()
        self.forget()

    def forget(self) -> None:
        """Forget frames, trails and the place, as where the instrument was moved."""
        self._identified: dict[int, tuple[Stars, Solution]] = {}
        self._found: dict[int, tuple[Any, list[FrameTrail]]] = {}
        self._waiting: list[Frame] = []
        self._newest: Located | None = None
        self._made: list[Located] = []
        self._place: Place | None = None
        self._taught = 0
        self._jobs.disown()

    # what comes -------------------------------------------------------------------------------------------------------

    def receive(self, message: Any) -> None:
        with refusing(self._driver, "trails"):
            stamp, ns = message.header.stamp, stamp_to_ns(message.header.stamp)
            self._found[ns] = stamp, message_to_trails(message)
            self._pair(ns)

    def note(self, stamp: Any, stars: Stars, answer: Solution) -> None:
        """Take the stars of a frame, if they are identified."""
        if answer.found is not None and answer.pointing is not None:
            shutter = self._settings.instrument(None).shutter or stars.shutter
            self._identified[stamp_to_ns(stamp)] = replace(stars, shutter=shutter), answer
            self._pair(stamp_to_ns(stamp))

    def _pair(self, ns: int) -> None:
        if ns in self._identified and ns in self._found:
            (stamp, found), seen = self._found.pop(ns), self._identified.pop(ns)
            self._waiting += [(stamp, *seen, found)] if found else []
        for kept in (self._identified, self._found):
            while len(kept) > KEPT:
                kept.pop(next(iter(kept)))

    def fetch(self) -> list[Located]:
        """What was found since the last call; begins to look at frames that wait."""
        if self._waiting and not self._jobs.busy:
            self._begin()
        made, self._made = self._made, []
        return made

    def _begin(self) -> None:
        frames, values = tuple(self._waiting), self._settings.values
        trails = () if self._newest is None else self._newest.trails
        self._waiting.clear()
        instrument = self._settings.instrument(None)
        # an error of the stamps may be the same in all frames
        clock_s = max(
            math.hypot(max(instrument.clock_stddev_s, stars.clock_stddev_s), stars.stamp_stddev_s)
            for _, stars, _, _ in frames
        )
        prior = KnownBefore.at_height(values["altitude"], values["altitude_stddev"], clock_s)
        window_s = values["satellites.window"]
        self._jobs.run(
            lambda: located(frames, trails, self._orbits, self._catalogue, prior, window_s),
            # a defect loses these frames' trails
            lambda o: self._finish(o.value or Located(stamp=frames[-1][0], trails=trails, why=o.trouble)),
        )

    def _finish(self, found: Located) -> None:
        self._newest = found
        self._made.append(found)
        if (fix := found.fix) is not None:
            utc_unix_s = float(found.trails[-1].utc_unix_s[0])
            self._place = gnss_place(utc_unix_s, fix.latitude, fix.longitude, fix.covariance[:2, :2])

    # what it is good for ----------------------------------------------------------------------------------------------

    @property
    def located(self) -> bool:
        """Whether a place was found."""
        return self._place is not None

    def at(self, utc_unix_s: float) -> Place | None:
        """The place of the instrument at a time, while it stands where its satellites were seen; None without one."""
        place = self._place
        if place is None or abs(utc_unix_s - place.utc_unix_s) > self._settings.values["satellites.window"]:
            return None
        return replace(place, utc_unix_s=utc_unix_s)

    def teaching(self, utc_unix_s: float) -> Place | None:
        """The place with an error for one frame of those that it teaches by; None without one, or when it has taught."""
        place = self.at(utc_unix_s)
        if place is None or self._taught == TEACHES:
            return None
        self._taught += 1
        return replace(place, covariance=place.covariance * TEACHES)

    def report(self) -> Diagnosis:
        """Make the diagnostic `Satellites`."""
        found = self._newest
        if found is None:
            return Diagnosis(
                Level.WARN, "no frame with trails yet: set the detector's parameter trails, and wait for dusk"
            )
        said = [s for s in (found.left_out, self._orbits.trouble) if s]
        values: dict[str, object] = {"trails": len(found.trails), "frames that it taught by": self._taught}
        if found.fix is None:
            return Diagnosis(Level.WARN, "; ".join([found.why, *said]), values)
        fix, sigma = found.fix, np.sqrt(np.diag(found.fix.covariance))
        ages = [o.age_days(float(t.utc_unix_s[0])) for o, t in zip(fix.named, found.trails, strict=True) if o]
        values |= {
            "trails used": int(fix.adjustment.used.sum()),
            "satellites": fix.satellites,
            "oldest elements (days)": max(ages),
            "east (m, 1 sigma)": float(sigma[0]),
            "north (m, 1 sigma)": float(sigma[1]),
            "height (m)": fix.height_m,
            "height (m, 1 sigma)": float(sigma[2]),
            "clock offset (s)": fix.clock_s,
            "clock offset (s, 1 sigma)": fix.clock_stddev_s,
        }
        return Diagnosis(Level.WARN if said else Level.OK, "; ".join([fix.text, *said]), values)


def located(
    frames: Sequence[Frame],
    before: tuple[SatelliteTrail, ...],
    stored: StoredOrbits,
    stars_of_sky: catalogue.Catalogue,
    prior: KnownBefore,
    window_s: float,
) -> Located:
    """The place by the trails of frames, and by those before that are not older than window_s."""
    trails, left_out = list(before), ""
    for _, stars, answer, found in frames:
        try:
            sky = FrameSky.of(stars, answer, stars_of_sky)
            more, why = sky.sighted(sky.doubted(found, stars_of_sky))
        except StarposError as error:
            left_out = str(error)
        else:
            trails += more
            left_out = why or left_out
    begin = max((float(t.utc_unix_s[0]) for t in trails), default=0.0) - window_s
    kept = tuple(replace(t, track=k) for k, t in enumerate(t for t in trails if t.utc_unix_s[0] >= begin))
    made = Located(stamp=frames[-1][0], trails=kept, left_out=left_out)
    if not kept:
        return replace(made, why="no trail shows an end of its exposure")
    try:
        usable, _ = chosen(stored.read(), min(float(t.utc_unix_s.min()) for t in kept))
        return replace(made, fix=locate(kept, usable, prior))
    except SatelliteError as error:
        return replace(made, why=str(error))
