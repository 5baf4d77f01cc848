# SPDX-License-Identifier: Apache-2.0
"""The newest part of a voyage that is under way: readings, frames and velocities as they come."""

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Sequence
from operator import attrgetter

import numpy as np

from starpos.errors import VoyageError
from starpos.navigation.preintegration import thinned
from starpos.navigation.records import FASTEST, GAP, MAX_SIGMA, MIN_SIGMA, ImuLog, VelocityLog
from starpos.navigation.sightings import FrameUnderWay
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import Voyage, adjust_voyage

# an IMU that is silent for longer, or whose clock goes back by more, begins a new voyage
LONGEST_GAP_S, BACK_S = 30.0, 1.0
# of frames with stars, whatever their stamps
MAX_FRAMES = 100_000
_time = attrgetter("utc_unix_s")
# no vehicle turns or is pushed as much, rad/s and m/s2
MAX_RATE, MAX_FORCE = 100.0, 1000.0


class RecentReadings:
    """Rows of utc_unix_s, gyro (3), force (3) in the order of time, a block of them for each `close`."""

    def __init__(self) -> None:
        self.last_s = -np.inf
        self._usual_s = np.inf
        self._open: list[tuple[float, ...]] = []
        self._blocks: deque[tuple[np.ndarray, ImuLog]] = deque()

    def append(self, row: tuple[float, ...]) -> None:
        """Append a reading; VoyageError in a sentence if it cannot be used."""
        # sums, because they are NaN where one is
        if not (sum(map(abs, row[1:4])) < MAX_RATE and sum(map(abs, row[4:])) < MAX_FORCE):
            raise VoyageError(
                "an inertial reading is NaN, or beyond 100 rad/s or 1000 m/s2: it is left out; check the IMU and its "
                "units"
            )
        if row[0] <= self.last_s:
            raise VoyageError("an inertial reading is not later than the one before: it is left out")
        self._open.append(row)
        self.last_s = row[0]

    def close(self) -> None:
        """Make a block of the readings since the last call, if there are any."""
        if not self._open:
            return
        before = self._blocks[-1][0][-1, 0] if self._blocks else None
        block = np.array(self._open)
        self._open = []
        t = block[:, 0]
        apart = np.diff(t, prepend=t[0] if before is None else before)
        if len(t) > 2:
            self._usual_s = float(np.median(apart[1:]))
        elif apart[-1] > 0:
            self._usual_s = min(self._usual_s, float(apart[-1]))
        usual = min(self._usual_s, float(apart.max()))
        length = np.where((apart > GAP * usual) | (apart <= 0), usual, apart)
        log = ImuLog(utc_unix_s=t, length_s=length, gyro=block[:, 1:4], force=block[:, 4:])
        self._blocks.append((block, thinned(log)))

    def forget(self, before_s: float) -> None:
        """Leave out the blocks that end before a time."""
        while self._blocks and self._blocks[0][0][-1, 0] < before_s:
            self._blocks.popleft()

    def since(self, utc_unix_s: float) -> ImuLog:
        """The readings of the blocks that end after a time, joined to fewer."""
        logs = []
        for block, log in reversed(self._blocks):
            if block[-1, 0] <= utc_unix_s:
                break
            logs.append(log)
        logs.reverse()
        return ImuLog(
            utc_unix_s=np.concatenate([log.utc_unix_s for log in logs]),
            length_s=np.concatenate([log.length_s for log in logs]),
            gyro=np.concatenate([log.gyro for log in logs]),
            force=np.concatenate([log.force for log in logs]),
        )

    @property
    def closed_s(self) -> float:
        """Time of the last reading of the last block."""
        return float(self._blocks[-1][0][-1, 0])

    @property
    def first_s(self) -> float:
        """Time of the first reading of the first block."""
        return float(self._blocks[0][0][0, 0])

    def blocks(self) -> list[np.ndarray]:
        """Rows (N, 7) as they came."""
        return [block for block, _ in self._blocks]


class Recent:
    """Collects what comes and forgets what is older than a window.

    frames: in the order of time.  velocities: utc_unix_s, three of m/s, and their sigma.
    """

    def __init__(self) -> None:
        self.readings = RecentReadings()
        self.frames: list[FrameUnderWay] = []
        self.velocities: deque[tuple[float, ...]] = deque()

    def add_frame(self, frame: FrameUnderWay) -> None:
        """Take a frame, whenever it comes; VoyageError for a second one of its time."""
        k = bisect_left(self.frames, frame.utc_unix_s, key=_time)
        if k < len(self.frames) and self.frames[k].utc_unix_s == frame.utc_unix_s:
            raise VoyageError("two attitudes have one stamp: the second one is left out")
        insort(self.frames, frame, key=_time)
        del self.frames[:-MAX_FRAMES]

    def add_velocity(self, utc_unix_s: float, velocity: Sequence[float], sigma: float) -> None:
        """Take a velocity in m/s along the body's axes; VoyageError in a sentence if it cannot be used."""
        if not sum(map(abs, velocity)) < FASTEST:
            raise VoyageError(
                f"a velocity is NaN or beyond {FASTEST:g} m/s: it is left out; give m/s along the body's axes"
            )
        if not MIN_SIGMA <= sigma <= MAX_SIGMA:
            raise VoyageError(
                f"a velocity's sigma is {sigma:g} m/s, not between {MIN_SIGMA:g} and {MAX_SIGMA:g}: "
                f"state each axis's sigma, or zeros for velocity_stddev"
            )
        if self.velocities and utc_unix_s <= self.velocities[-1][0]:
            raise VoyageError("a velocity is not later than the one before: it is left out")
        self.velocities.append((utc_unix_s, *velocity, sigma))

    def forget(self, before_s: float) -> None:
        """Leave out what is older."""
        self.readings.forget(before_s)
        del self.frames[: bisect_left(self.frames, before_s, key=_time)]
        while self.velocities and self.velocities[0][0] < before_s:
            self.velocities.popleft()

    @property
    def newest_frame_s(self) -> float:
        """Time of the newest frame that readings have come up to; -inf without one."""
        k = bisect_left(self.frames, self.readings.last_s, key=_time)
        return self.frames[k - 1].utc_unix_s if k else -np.inf

    def job(self, vessel: Vessel) -> Callable[[], Voyage]:
        """What adjusts all of it as it is now; it raises VoyageError or FixError where there is no voyage."""
        blocks, frames, velocities = self.readings.blocks(), tuple(self.frames), np.array(self.velocities)

        def adjusted() -> Voyage:
            rows, log = np.concatenate(blocks), None
            imu = thinned(ImuLog.of(rows[:, 0], rows[:, 1:4], rows[:, 4:]))
            if len(velocities):
                t, velocity, sigma = velocities[:, 0], velocities[:, 1:4], velocities[:, 4]
                log = VelocityLog(utc_unix_s=t, velocity=velocity, sigma=sigma)
            return adjust_voyage(frames, imu, log, vessel)

        return adjusted
