# SPDX-License-Identifier: Apache-2.0
"""A recorded night through a session, as the nodes solve it when `replay` plays the bag to them."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from starpos.errors import StarposError
from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.tilt_log import TiltLog
from starpos.messages.stamp import PlainHeader, PlainStamp
from starpos.messages.tilt import Reading
from starpos.recording.bag import BagReader
from starpos.recording.drivers import IMAGES, DriverMessages, Drivers
from starpos.recording.topics import CAPTURE, GNSS, IMU, INPUTS, NAV_SAT_FIX, STARS, TILT, instrument_in
from starpos.session.driver import Heard, JobsInTurn, Log, Now, Sent
from starpos.session.frames import Output
from starpos.session.session import SolverSession
from starpos.session.settings import Settings


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
        now_ns, messages = 0, self._drivers.begin()
        with BagReader(path, typed=True) as bag:
            topics = INPUTS if self.session.gnss is None else INPUTS | GNSS
            chosen = instrument_in(bag, path, namespace, topics, (STARS,), self._drivers.remaps)
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

    def play_lists(self, camera: Camera, stars: Sequence[Stars], tilts: TiltLog) -> Iterator[Output]:
        """Yield what the solver publishes of lists of stars with times, and of tilts, each at its own time."""
        self.session.instrument.use_known(camera)
        messages: list[tuple[float, Any]] = [
            (unix_s, _tilt_message(tilts, k)) for k, unix_s in enumerate(tilts.utc_unix_s.tolist())
        ]
        messages += [((s.mid_unix_s or 0.0) + (s.exposure_s or 0.0) / 2, s) for s in stars]
        now = Now.in_data(0.0)
        for unix_s, message in sorted(messages, key=lambda m: m[0]):
            now = Now.in_data(unix_s)
            if isinstance(message, Stars):
                self.frames += 1
                stamp = PlainStamp.of_ns(round((message.mid_unix_s or 0.0) * 1e9))
                yield from self.session.receive_detected(message, PlainHeader(stamp, "camera"), now)
            else:
                yield from self._receive_tilt(message, now)
            yield from self._settled(now)
        yield from self._ended(now)

    def _taken(self, kind: str, message: Any, messages: DriverMessages, now: Now) -> list[Output]:
        """Have the session take a message, or the stars or tilt made from it."""
        session = self.session
        if kind == TILT:
            return self._receive_tilt(message, now)
        if kind == STARS:
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
        if kind == IMU:
            tilt = messages.tilt_of(message, now.unix_s or 0.0)
            return [] if tilt is None else self._receive_tilt(tilt, now)
        if kind == NAV_SAT_FIX:
            return session.receive_gnss(message, now)
        if kind == CAPTURE:
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


def _tilt_message(log: TiltLog, k: int) -> Reading:
    """The message of a reading."""
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
