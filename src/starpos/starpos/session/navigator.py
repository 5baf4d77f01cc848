# SPDX-License-Identifier: Apache-2.0
"""The navigator's decisions: when the newest part of a voyage is adjusted, how it is carried on, what is published.  A
state machine without a clock or a thread of its own, as session.py is for frames: its driver passes each message with
its time of arrival; it returns what to publish.  The adjustment is a job; until its outcome comes the IMU carries the
last one on.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from starpos.earth.gravity import enu_at
from starpos.earth.place import Place
from starpos.earth.vertical import Geodetic
from starpos.errors import GnssError, VoyageError
from starpos.files import path_of
from starpos.fix.attitude import Attitude
from starpos.instrument.instrument import Instrument
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_attitude
from starpos.navigation.equations import PLACE
from starpos.navigation.estimate import Estimate, VoyageFix, observability
from starpos.navigation.recent import BACK_S, LONGEST_GAP_S, Recent
from starpos.navigation.records import ImuModel, read_imu_model
from starpos.navigation.sightings import PlacelessFrame, SunFrame, body_attitude
from starpos.navigation.vessel import PARKED, Vessel
from starpos.navigation.voyage import MIN_FRAMES, Voyage
from starpos.session.driver import Changes, Diagnosis, Driver, Jobs, Level, Now, Outcome, refusing
from starpos.session.gnss import OLDEST_S, ComparedPlaces, contradiction
from starpos.session.reports import AHEAD_S
from starpos.session.settings import MIN_CLOCK_S, NodeSettings

# of a stated altitude: the vehicle goes up and down by more than its file says
MIN_HEIGHT_STDDEV_M = 10.0
ANY_INSTRUMENT = Instrument(1000.0, clock_stddev_s=MIN_CLOCK_S)


class NavigatorSettings(NodeSettings):
    """The parameters of the navigator."""

    readers: ClassVar[Mapping[str, Callable[[str], Any]]] = {
        **NodeSettings.readers,
        "imu_model": lambda name: read_imu_model(path_of(name)),
    }

    @property
    def vessel(self) -> Vessel:
        """Instrument and vehicle."""
        values, known = self.values, self._known or ANY_INSTRUMENT
        clock = values["clock_stddev"]
        height = values["altitude"]
        stated = (
            {}
            if np.isnan(height)
            else {"height_m": height, "height_stddev_m": max(values["altitude_stddev"], MIN_HEIGHT_STDDEV_M)}
        )
        return Vessel(
            vehicle=values["vehicle"] or None,
            model=self._files["imu_model"] or ImuModel(),
            camera_to_body=np.asarray(known.link_to_camera, float).T,
            mount_stddev=float(np.radians(values["mount_stddev"])),
            atmosphere=self.atmosphere,
            clock_stddev_s=known.clock_stddev_s if np.isnan(clock) else clock,
            drift_stddev=values["drift_stddev"],
            **stated,
        )


# minimum length of the window before it is adjusted, s, and minimum frames per second of the period
SHORTEST_S, FRAMES_PER_S = 10.0, 30.0
# 1 sigma beyond which a position counts as unknown, m an axis
WIDE_M = 1000.0
STARTING = "no frame with stars yet"
APART = "all frames with stars are stamped later than the IMU's readings: set their clocks by one source"


@dataclass(frozen=True, eq=False, kw_only=True)
class Navigated:
    """An output at one time: a fix, the place on the ellipsoid, where it lies from the origin; None without support.

    displacement (3,): m east, north, up of the first place that was known to WIDE_M, along the axes there; and its
    covariance (3, 3).
    at_place: heading, pitch and roll at a known place, while there is no fix; None where no place is known.
    """

    utc_unix_s: float
    fix: VoyageFix | None = None
    ground: Geodetic | None = None
    displacement: tuple[np.ndarray, np.ndarray] | None = None
    at_place: Attitude | None = None


class NavigatorSession:
    """Messages of an IMU, a camera's attitudes and velocities to places under way; jobs: runs the adjustment."""

    def __init__(self, settings: NavigatorSettings, jobs: Jobs, driver: Driver) -> None:
        self.counts = {"adjustments": 0, "fixes": 0}
        self._settings, self._values = settings, settings.values
        self._driver = driver
        self._jobs = jobs
        self._changes = Changes(driver)
        self.reset()

    def reset(self) -> None:
        """Begin a new voyage."""
        self._recent = Recent()
        self._estimate: Estimate | None = None
        # a frame with the Sun that the estimate is made of: then its place is a given one
        self._sun: SunFrame | None = None
        # of its place, 1 sigma, and what would improve it
        self._sigma_m, self._missing = math.inf, ""
        self._origin: np.ndarray | None = None
        self._trouble = STARTING
        self._faults: tuple[str, ...] = ()
        self._next_s = self._adjusted_s = -math.inf
        # of the newest frame that the estimate is made of
        self._seen_s = -math.inf
        self._gnss = ComparedPlaces()
        self._jobs.disown()

    def parameters_set(self) -> None:
        """Adjust anew with other parameters as soon as may be."""
        self._adjusted_s = -math.inf

    # inputs ----------------------------------------------------------------------------------------------------------

    def receive_imu(self, message: Any, now: Now) -> list[Navigated]:
        """Take a sensor_msgs/Imu; returns an output where one is due."""
        w, f, stamp = message.angular_velocity, message.linear_acceleration, message.header.stamp
        row = (stamp.sec + stamp.nanosec * 1e-9, w.x, w.y, w.z, f.x, f.y, f.z)
        due = False
        with refusing(self._driver, "imu/data"):
            if (
                message.angular_velocity_covariance[0] == -1
                or message.linear_acceleration_covariance[0] == -1
            ):
                raise VoyageError(
                    "the IMU says by a covariance of -1 that it measures no rates or no accelerations: use "
                    "one that does"
                )
            self._checked(row[0], now, "an inertial reading")
            self._begin_anew(row[0])
            self._recent.readings.append(row)
            due = row[0] >= self._next_s
        return self._tick(row[0]) if due else []

    def receive_attitude(self, message: Any, now: Now) -> list[Navigated]:
        """Take a starpos_interfaces/Attitude."""
        with refusing(self._driver, "attitude"):
            attitude = message_to_attitude(message)
            time_s = self._checked(attitude.utc_unix_s, now, "an attitude")
            # If the user sets clock_stddev, it replaces the error that the camera's host states.
            if not np.isnan(self._values["clock_stddev"]):
                attitude = replace(attitude, clock_stddev_s=0.0)
            by_sun, place = attitude.ray is not None, None
            if by_sun or self._estimate is None or self._stars_missing:
                place = self._place_at(time_s)
            if by_sun and place is None:
                raise VoyageError(
                    "the Sun gives a heading only at a known place: set site.latitude and site.longitude, or gnss.use "
                    "and send gnss/fix"
                )
            frame = SunFrame.of(attitude, place) if by_sun and place else PlacelessFrame.of(attitude)
            self._recent.add_frame(frame)
            if place is not None and isinstance(frame, PlacelessFrame):
                # the heading at a known place, while there is no fix
                found = body_attitude(frame, place, self._settings.vessel)
                return [Navigated(utc_unix_s=frame.utc_unix_s, at_place=found)]
        return []

    def _place_at(self, utc_unix_s: float) -> Place | None:
        """The known place at a time; None without one."""
        if self._settings.site is not None or not self._values["gnss.use"]:
            return self._settings.site
        try:
            gnss = self._gnss.at(utc_unix_s)
        except GnssError as e:
            self._driver.refuse("gnss/fix", str(e))
            return None
        return None if gnss is None else gnss.deflected(self._settings.vertical)

    def receive_velocity(self, message: Any, now: Now, name: str) -> list[Navigated]:
        """Take a nav_msgs/Odometry or a geometry_msgs/TwistWithCovarianceStamped, from the topic of that name."""
        v = message.twist.twist.linear
        variance = np.asarray(message.twist.covariance, float)[[0, 7, 14]]
        with refusing(self._driver, name):
            time_s = self._checked(stamp_to_unix(message.header.stamp), now, "a velocity")
            if not variance.min() >= 0:
                raise VoyageError(
                    "a velocity's variance is NaN or below 0: state it, or zeros for velocity_stddev"
                )
            # an axis without a stated variance moves as little as the others, or is not measured
            sigma = math.sqrt(variance.max()) or self._values["velocity_stddev"]
            self._recent.add_velocity(time_s, (v.x, v.y, v.z), sigma)
        return []

    def receive_gnss(self, message: Any, now: Now) -> list[Navigated]:
        """Take a sensor_msgs/NavSatFix of satellites: it is compared, not fused."""
        self._gnss.receive(message, now)
        self._driver.came("gnss/fix")
        return []

    def _checked(self, unix_s: float | None, now: Now, what: str) -> float:
        """The time of a message; VoyageError without one, or for one in the future."""
        if not unix_s:
            raise VoyageError(f"{what} has no time stamp: set header.stamp to when it was measured")
        if now.ahead_s(unix_s) > AHEAD_S:
            raise VoyageError(
                f"{what} is stamped {now.ahead_s(unix_s):.3g} s in the future: set the clocks of camera, IMU and "
                "navigator by one source"
            )
        return unix_s

    def _begin_anew(self, time_s: float) -> None:
        """Begin a new voyage where an IMU was away or its clock was set: what happened meanwhile is not known."""
        away_s = time_s - self._recent.readings.last_s
        if math.isfinite(away_s) and (away_s > LONGEST_GAP_S or away_s < -BACK_S):
            self._driver.warning(
                f"the IMU's stamps {'jump by' if away_s > 0 else 'go back by'} {abs(away_s):.3g} s: begun anew"
            )
            self.reset()

    # work ------------------------------------------------------------------------------------------------------------

    def _tick(self, time_s: float) -> list[Navigated]:
        rate = self._values["rate"]
        # at round times, whatever the rate of the readings
        self._next_s = (math.floor(time_s * rate + 1e-3) + 1) / rate
        recent = self._recent
        recent.readings.close()
        recent.forget(time_s - self._values["window"])
        if self._estimate is not None:
            self._estimate = self._carried_on(self._estimate)
        self._adjust(time_s)
        return [self._output(time_s)]

    def _adjust(self, time_s: float) -> None:
        """Begin an adjustment if one is due."""
        recent, values = self._recent, self._values
        period_s = max(values["adjust_period"], len(recent.frames) / FRAMES_PER_S)
        if self._jobs.busy or time_s < self._adjusted_s + period_s or recent.newest_frame_s <= self._seen_s:
            return
        inside = [f for f in recent.frames if f.utc_unix_s <= time_s]
        if len(inside) < MIN_FRAMES or time_s - recent.readings.first_s < SHORTEST_S:
            return
        self._adjusted_s = time_s
        vessel = self._settings.vessel
        sun = next((f for f in reversed(inside) if isinstance(f, SunFrame)), None)
        self._jobs.run(recent.job(vessel), lambda made: self._adjusted(made, sun))

    def _adjusted(self, made: Outcome, sun: SunFrame | None) -> None:
        self.counts["adjustments"] += 1
        self._trouble, self._faults = made.trouble, ()
        if made.trouble:
            self._estimate = None
            self._changes.say(made.trouble, good=False)
            return
        found: Voyage = made.value
        self._faults, self._sun = found.faults, sun
        self._seen_s = found.last.utc_unix_s
        is_measured = bool(self._recent.velocities) or self._values["vehicle"] == PARKED
        self._sigma_m, self._missing = observability(found.last, is_measured)
        self._estimate = self._carried_on(found.last)
        self._changes.say("fixes are coming" if sun is None else "headings by the Sun are coming", good=True)

    def _carried_on(self, estimate: Estimate) -> Estimate:
        """An estimate at the last output's time."""
        readings = self._recent.readings
        if readings.closed_s <= estimate.utc_unix_s:
            return estimate
        return estimate.carried_on(readings.since(estimate.utc_unix_s), readings.closed_s)

    # outputs ---------------------------------------------------------------------------------------------------------

    @property
    def _stars_missing(self) -> bool:
        return self._recent.readings.last_s - self._seen_s > self._values["stars_timeout"]

    def _output(self, time_s: float) -> Navigated:
        estimate = self._estimate
        if estimate is None or self._stars_missing:
            return Navigated(utc_unix_s=time_s)
        if self._sun is not None:
            return Navigated(utc_unix_s=time_s, at_place=self._sun.heading_by(estimate.fix.link))
        self.counts["fixes"] += 1
        return Navigated(
            utc_unix_s=time_s,
            fix=estimate.fix,
            ground=estimate.fix.on_ground(self._settings.vertical),
            displacement=self._displacement(estimate),
        )

    def _displacement(self, estimate: Estimate) -> tuple[np.ndarray, np.ndarray] | None:
        """Where an estimate lies from the first place that was known well enough, with covariance; None before it."""
        place = estimate.motion.place[0]
        if self._origin is None and self._sigma_m < WIDE_M:
            self._origin = place
        if self._origin is None:
            return None
        axes = enu_at(self._origin)
        return axes @ (place - self._origin), axes @ estimate.covariance[PLACE, PLACE] @ axes.T

    def _why_old(self, since_s: float) -> str:
        """Say why the newest frame that is adjusted is so old."""
        if self._recent.readings.last_s - self._recent.newest_frame_s > self._values["stars_timeout"]:
            return f"no frame with stars for {since_s:.0f} s: no fix"
        return (
            f"the newest adjustment ends {since_s:.0f} s ago, for it takes longer than the frames take to come: no fix; "
            "shorten window, or play a recording at its own rate"
        )

    def report(self) -> Diagnosis:
        """Make the diagnostic `Navigation`: what is known, what is missing, how good it is."""
        estimate, recent = self._estimate, self._recent
        values: dict[str, object] = {
            **self.counts,
            "frames in the window": len(recent.frames),
            "velocities in the window": len(recent.velocities),
        }
        if estimate is None:
            apart = len(recent.frames) >= MIN_FRAMES and recent.newest_frame_s == -math.inf
            return Diagnosis(Level.WARN, APART if apart else self._trouble, values)
        since_s = recent.readings.last_s - self._seen_s
        speed = float(np.sqrt(np.trace(estimate.fix.velocity_covariance) / 3))
        heading_deg = math.degrees(math.sqrt(estimate.fix.covariance[2, 2]))
        values |= {
            "place (m, 1 sigma an axis)": self._sigma_m,
            "heading (deg, 1 sigma)": heading_deg,
            "velocity (m/s, 1 sigma an axis)": speed,
            "time since the newest frame that is adjusted (s)": since_s,
        }
        if self._stars_missing:
            return Diagnosis(Level.WARN, self._why_old(since_s), values)
        faults = list(self._faults)
        if self._sun is not None:
            heading_deg = math.degrees(self._sun.heading_by(estimate.fix.link).angles_covariance[0, 0] ** 0.5)
            values["heading (deg, 1 sigma)"] = heading_deg
            sentence = "; ".join([f"by the Sun, at a given place: heading to {heading_deg:.3g} deg", *faults])
            return Diagnosis(Level.WARN if faults else Level.OK, sentence, values)
        gnss = self._gnss.newest
        if gnss is not None and abs(estimate.utc_unix_s - gnss.utc_unix_s) < OLDEST_S:
            fix = estimate.fix
            moving = float(np.linalg.norm(fix.velocity))
            apart_m, wrong = contradiction(
                gnss, fix.on_ground(self._settings.vertical), fix.utc_unix_s, moving
            )
            values["GNSS from here (m)"] = apart_m
            faults += [wrong] if wrong else []
        said = [f"place to {self._sigma_m:.3g} m", *([self._missing] if self._missing else [])]
        level = Level.WARN if self._sigma_m > WIDE_M or faults else Level.OK
        return Diagnosis(level, "; ".join([*said, *faults]), values)
