# SPDX-License-Identifier: Apache-2.0
"""What a session knows of its instrument by GNSS, and whether it believes GNSS: frame by frame, in order of time.

A GNSS place that is spoofed or wrong, suddenly or slowly, is detected by copies of the filter: one is made every
COPY_INTERVAL_S seconds, and kept for LONGEST_S. A copy has one more unknown, an error of GNSS that began when it was
made, as a step or growing evenly. If GNSS is good, that error is 0 within its covariance, which includes all errors of
the stars' place; a likelihood ratio decides (Willsky and Jones, IEEE Trans. Automatic Control 21(1), 1976, 108, from
memory). So a slow drag shows although each of its frames agrees with the one before, and although the filter that learns
has followed it.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from starpos.averaging.poses import slip_s
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.fix.fix import Fix
from starpos.frozen import ArrayRows, joined
from starpos.gnss.filter import (
    GnssFrame,
    Innovation,
    begun,
    chi2,
    corrected,
    innovation,
    is_linear,
    place_of_stars,
    stddev_rad,
    updated,
)
from starpos.gnss.states import Ageing, Learned, aged, at_temperature, prior
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument

# Interval at which the filter is copied, and time for which each copy is kept, s.
COPY_INTERVAL_S, LONGEST_S = 110.0, 3000.0
# Time from which the growing error is counted, and its unit, s.
GROWS_AFTER_S, UNIT_S = 240.0, 600.0
# 1 sigma of an unknown error, as an angle at the Earth's centre: 600 km.
NOTHING_RAD = 0.1
OFFSETS = 4
# Minimum information (1/rad2) on the error of GNSS: an error of 1 rad, the whole Earth, would be 1 sigma.
MIN_INFORMATION = 1.0


@dataclass(frozen=True, eq=False)
class OnsetFilters(ArrayRows):
    """W filters, each with n states and then the error of GNSS: east, north of a step, and of a growth in UNIT_S.

    before (W,): the Learned that each was copied from.  since (W,): time of the copy.  frames (W,): number used since.
    """

    before: np.ndarray
    since: np.ndarray
    frames: np.ndarray
    state: np.ndarray
    covariance: np.ndarray

    @classmethod
    def copied(cls, learned: Learned) -> "OnsetFilters":
        """One filter, a copy of the present one."""
        n = len(learned.state)
        state, covariance = np.zeros((1, n + OFFSETS)), np.zeros((1, n + OFFSETS, n + OFFSETS))
        state[0, :n], covariance[0, :n, :n] = learned.state, learned.covariance
        covariance[0, n:, n:] = np.eye(OFFSETS) * NOTHING_RAD**2
        before, since = np.array([learned], object), np.array([learned.utc_unix_s])
        return cls(before, since, np.zeros(1, int), state, covariance)

    def due(self, utc_unix_s: float) -> bool:
        """Whether another copy should be made."""
        return not len(self.since) or utc_unix_s - self.since[-1] >= COPY_INTERVAL_S

    def aged(self, by: Ageing) -> "OnsetFilters":
        """These filters with the process noise of the time that passed."""
        state, covariance = by.of(self.state, self.covariance)
        return replace(self, state=state, covariance=covariance)

    def updated(self, seen: Innovation, about: np.ndarray, utc_unix_s: float) -> "OnsetFilters":
        """These filters updated with a frame's GNSS place; its innovation is linear about the states (n,)."""
        n, grown = len(about), (utc_unix_s - self.since) / UNIT_S
        rows = np.empty((len(self.since), 2, n + OFFSETS))
        rows[:, :, :n] = seen.rows
        rows[:, :, n : n + 2] = -np.eye(2)
        rows[:, :, n + 2 :] = -np.eye(2) * grown[:, None, None]
        left = np.concatenate([about - self.state[:, :n], -self.state[:, n:]], 1)
        value = seen.value + np.einsum("wij,wj->wi", rows, left)
        state, covariance = corrected(self.state, self.covariance, rows, seen.noise, value)
        return replace(self, state=state, covariance=covariance, frames=self.frames + 1)

    def evidence(self, utc_unix_s: float) -> np.ndarray:
        """Evidence of each filter (W,) that GNSS is wrong: the larger chi-square (2 dof) of step and growth."""
        n = self.state.shape[1] - OFFSETS
        weight = np.linalg.inv(self.covariance[:, n:, n:])
        pull = np.einsum("wij,wj->wi", weight, self.state[:, n:])
        # the prior's weight is taken off: only measurements count
        weight = weight - np.eye(OFFSETS) / NOTHING_RAD**2
        step = _chi2(weight[:, :2, :2], pull[:, :2])
        growth = _chi2(weight[:, 2:, 2:], pull[:, 2:])
        old = utc_unix_s - self.since >= GROWS_AFTER_S
        return np.where(self.frames > 0, np.where(old, np.maximum(step, growth), step), 0.0)


def _chi2(weight: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """pull^T weight^-1 pull for each (2, 2) weight, 0 where it holds no information."""
    informative = np.linalg.eigvalsh(weight)[:, 0] > MIN_INFORMATION
    safe = np.where(informative[:, None, None], weight, np.eye(2))
    return np.where(
        informative, np.einsum("wi,wi->w", pull, np.linalg.solve(safe, pull[..., None])[..., 0]), 0.0
    )


# Chi-square (two degrees of freedom) above which a frame is doubtful, and above which it is an alarm. One test of a good
# GNSS exceeds them once in 1000 and once in 3.3 million times. A frame has one test of its own and up to two of each copy
# of the filter (about 28 of them, see watch.py); the largest decides. tools/benchmarks/gnss_false_alarms.py measures how
# often that maximum exceeds them.
DOUBT, ALARM = 13.8, 30.0
# GNSS is used again once it has agreed for this time, over this number of frames, within this chi-square
BACK_S, BACK_FRAMES, BACK = 600.0, 10, 7.4
# a place wider than this (1 sigma, m) is not used: the filter is not linear over it
WIDEST_M = 50_000.0
# the place of a lean at which A3 was not learned may be bent by this share of its least sigma
MAX_BENT = 0.3
NOISE_SIGMA = 2.0
# fewer poses are not believed more than a GNSS that contradicts them
BELIEVED_POSES = 4
# before A3 is known: maximum number of frames of a pose that teach, and of all that are kept
FEW_OF_POSE, MAX_HELD = 12, 200
# a place further off, in sigma, is another one, with a deflection of its own
ELSEWHERE_SIGMA = 3.0
COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


class GnssStatus(str, Enum):
    """The guard's verdict on a GNSS place."""

    LEARNING = "learning"
    AGREES = "agrees"
    DOUBTFUL = "doubtful"
    DISAGREES = "disagrees"

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, eq=False, kw_only=True)
class GnssCheck:
    """What the guard says of a GNSS fix: a status, and how far it is from the stars' place.

    place: GNSS's.
    distance_m, bearing_deg: of the GNSS place from the stars' place.  sigma_m: 1 sigma of the distance.
    All three are NaN where the stars give no place yet.
    frames, poses: from how many was learned what counts.
    """

    status: GnssStatus
    place: Place
    distance_m: float = math.nan
    bearing_deg: float = math.nan
    sigma_m: float = math.nan
    frames: int = 0
    poses: int = 0

    @property
    def sentence(self) -> str:
        """Sentence that says the same."""
        if math.isnan(self.distance_m) and self.status == GnssStatus.DISAGREES:
            return "the stars give no place at this frame: GNSS is not believed, since an earlier one"
        if math.isnan(self.distance_m):
            return "A3 is learned from GNSS: the stars give no place of their own yet"
        where = COMPASS[round(self.bearing_deg / 45) % 8]
        off, sigma = _length_text(self.distance_m), _length_text(self.sigma_m)
        sentence = f"GNSS is {off} {where} of where the stars put us ({sigma})"
        return sentence + (": it is not believed" if self.status == GnssStatus.DISAGREES else "")


def _length_text(metres: float) -> str:
    return f"{metres:.0f} m" if metres < 1000 else f"{metres / 1000:.2g} km"


def _readings_of(tilt: Tilt) -> frozenset[float]:
    """The times of a tilt's readings; where they are not known, its own."""
    return frozenset(tilt.times or (tilt.utc_unix_s,))


class GnssWatch:
    """Keeps what is known of an instrument, learned from GNSS while the stars agree with it.

    Call `advance` for each frame; where there is a GNSS place, then `judge` and `learn`.
    learned: None before the first frame.
    is_learning: whether A3 is too uncertain for the linear filter. Until it is not, each frame solves anew for all frames
    held.
    """

    def __init__(self, instrument: Instrument, vertical: Vertical, learned: Learned | None = None) -> None:
        self.vertical, self._instrument = vertical, instrument
        self._pose: Fix | None = None
        self._new_pose = True
        # of the frame that taught last, and of the one that the copies have compared last
        self._readings: frozenset[float] = frozenset()
        self._compared: frozenset[float] = frozenset()
        self._begin(learned)

    def _begin(self, learned: Learned | None) -> None:
        """Begin with what is known, None of another inclinometer."""
        self.learned: Learned | None = learned
        self.is_learning, self.disagrees = learned is None, False
        self._of_pose = 0
        self._held: deque[GnssFrame] = deque(maxlen=MAX_HELD)
        # the readings of a frame that would have been an alarm, before A3 was known
        self._suspicious: frozenset[float] | None = None
        self._onsets: OnsetFilters | None = None

    def advance(self, sighting: Fix) -> None:
        """Advance to the time of a frame, seen with any A3: only the attitude of its camera counts."""
        tilt = sighting.tilt
        self._new_pose = (
            self._pose is None or slip_s(sighting.camera, self._pose.camera, sighting.latitude) is None
        )
        if self._new_pose:
            self._pose, self._of_pose = sighting, 0
        if self.learned is not None and self.learned.axes != tilt.axes:
            # another inclinometer
            self._begin(None)
        if self.learned is None:
            if self._instrument.calibration.unknown:
                return
            stddev = stddev_rad(self.vertical, sighting.latitude, sighting.longitude)
            self.learned = prior(self._instrument, tilt, stddev, sighting.utc_unix_s)
            self.is_learning = not is_linear(self.learned, tilt)
        self._age(self.learned, sighting)

    def _age(self, learned: Learned, sighting: Fix) -> Learned:
        """Bring what was learned to the time of a frame; returns it."""
        tilt = sighting.tilt
        place = place_of_stars(sighting, at_temperature(learned, tilt), self.vertical)
        at = place.latitude, place.longitude
        here, moved_m = learned.place or at, 0.0
        if self._new_pose:
            way_m = float(np.linalg.norm(place.offset_m(*here)))
            if way_m > ELSEWHERE_SIGMA * math.sqrt(np.linalg.eigvalsh(place.covariance)[-1]):
                moved_m, here = way_m, at
        learned, passed = aged(
            learned, self._instrument, self.vertical, sighting, at, moved_m, self._new_pose
        )
        self.learned = learned = replace(learned, place=here)
        if self._onsets is not None:
            self._onsets = self._onsets.aged(passed)
            # the one that may bring GNSS back has to last for all of its frames, however far they are apart
            if not self.disagrees:
                recent = sighting.utc_unix_s - self._onsets.since <= LONGEST_S
                self._onsets = self._onsets.select(recent)
        return learned

    def up_in_camera(self, tilt: Tilt) -> np.ndarray | None:
        """Up (3,) in C at a tilt by what was learned; None if nothing is known."""
        return None if self.learned is None else self.learned.rotation.T @ self.learned.up(tilt)

    def tells_place(self, sighting: Fix) -> bool:
        """Whether the stars give a place with what was learned before this frame."""
        if self.learned is None:
            return False
        place = place_of_stars(sighting, self.learned, self.vertical)
        narrow, wide = np.linalg.eigvalsh(place.covariance)
        if wide >= WIDEST_M**2:
            return False
        # a turn makes the place wide along an arc, and the bend leaves it across
        return not self._held or self._bent_m(sighting.tilt) < MAX_BENT * math.sqrt(narrow)

    def _bent_m(self, tilt: Tilt) -> float:
        """Effect on the place, beyond a linear error, of a hardly known turn of A3 about the plumb line."""
        assert self.learned is not None
        at, up = self.learned.layout, tilt.up
        off = min(float(np.linalg.norm(up - frame.sighting.tilt.up)) for frame in self._held)
        # the noise of two tilts is no lean
        leaned = max(off - NOISE_SIGMA * math.sqrt(2 * np.trace(tilt.noise)), 0.0)
        turn2 = min(float(up @ self.learned.covariance[at.a3, at.a3] @ up), 2.0)
        return turn2 / 2 * leaned * EARTH_RADIUS_M

    def judge(self, sighting: Fix, gnss: Place) -> GnssCheck:
        """Compare a GNSS place with the stars'; where they disagree, take back what GNSS taught meanwhile."""
        if self.learned is None or not self.tells_place(sighting):
            return GnssCheck(status=GnssStatus.LEARNING, place=gnss)
        seen = innovation(sighting, gnss, self.learned, self.vertical)
        single = chi2(self.learned, seen)
        if self.is_learning:
            status = self._while_starting(single, sighting.tilt)
            if status == GnssStatus.DISAGREES and self._rests_on_few(self.learned):
                return self._begin_anew(sighting, gnss)
            return self._check(status, sighting, gnss)
        if (onsets := self._onsets) is None:
            onsets = OnsetFilters.copied(self.learned)
        # while GNSS is not believed there is one filter
        elif not self.disagrees and onsets.due(sighting.utc_unix_s):
            onsets = joined([onsets, OnsetFilters.copied(self.learned)])
        # the noise of a reading that frames share counts once: as of each of them, it would look like an error of GNSS
        readings = _readings_of(sighting.tilt)
        if not readings & self._compared:
            onsets = onsets.updated(seen, self.learned.state, sighting.utc_unix_s)
            self._compared = readings
        self._onsets = onsets
        against = onsets.evidence(sighting.utc_unix_s)
        worst = max(single, float(against.max()))
        if self.disagrees and worst > BACK:
            # each contradiction begins the time anew in which GNSS has to agree
            self._onsets = OnsetFilters.copied(self.learned)
        elif self.disagrees:
            agreed_s = sighting.utc_unix_s - onsets.since[0]
            self.disagrees = bool(agreed_s < BACK_S or onsets.frames[0] < BACK_FRAMES)
        elif worst > ALARM and self._rests_on_few(self.learned):
            return self._begin_anew(sighting, gnss)
        elif worst > ALARM:
            # where the frame alone raised the alarm, this is still the likeliest moment at which the error began
            self._take_back(onsets.before[max(int(np.argmax(against)) - 1, 0)], sighting)
        if self.disagrees:
            return self._check(GnssStatus.DISAGREES, sighting, gnss)
        return self._check(GnssStatus.DOUBTFUL if worst > DOUBT else GnssStatus.AGREES, sighting, gnss)

    def _rests_on_few(self, learned: Learned) -> bool:
        """Whether A3 is known from a few poses of GNSS alone, and the present one has hardly borne it out."""
        few = learned.poses < BELIEVED_POSES and self._of_pose < BACK_FRAMES
        return few and self._instrument.calibration.unknown

    def _begin_anew(self, sighting: Fix, gnss: Place) -> GnssCheck:
        """Forget the little that GNSS taught and contradicts: a receiver that begins far off is one day right."""
        check = self._check(GnssStatus.DISAGREES, sighting, gnss)
        self._begin(None)
        return check

    def _while_starting(self, single: float, tilt: Tilt) -> GnssStatus:
        """The status while A3 is hardly known: an alarm needs two frames without a common reading of the level."""
        readings = _readings_of(tilt)
        again = self._suspicious is not None and not (readings & self._suspicious)
        if single <= ALARM:
            self._suspicious = None
            return GnssStatus.DOUBTFUL if single > DOUBT else GnssStatus.LEARNING
        if self._suspicious is None:
            self._suspicious = readings
        return GnssStatus.DISAGREES if again else GnssStatus.DOUBTFUL

    def _take_back(self, learned: Learned, sighting: Fix) -> None:
        """Return to the state one copy before the likeliest onset of the error."""
        self.disagrees, self.learned = True, learned
        self._onsets, self._new_pose = None, True
        self._onsets = OnsetFilters.copied(self._age(learned, sighting))

    def _check(self, status: GnssStatus, sighting: Fix, gnss: Place) -> GnssCheck:
        assert self.learned is not None
        place = place_of_stars(sighting, self.learned, self.vertical)
        apart = gnss.offset_m(place.latitude, place.longitude)
        distance = float(np.linalg.norm(apart))
        way = apart / max(distance, 1e-9)
        return GnssCheck(
            status=status,
            place=gnss,
            distance_m=distance,
            bearing_deg=float(np.degrees(np.arctan2(*apart)) % 360),
            sigma_m=math.sqrt(way @ (place.covariance + gnss.covariance) @ way),
        )

    def learn(self, sighting: Fix, gnss: Place, check: GnssCheck) -> None:
        """Learn from a frame if GNSS is believed, and its readings are new."""
        readings = _readings_of(sighting.tilt)
        if check.status not in (GnssStatus.LEARNING, GnssStatus.AGREES) or readings & self._readings:
            return
        self._readings = readings
        if not self.is_learning:
            assert self.learned is not None
            seen = innovation(sighting, gnss, self.learned, self.vertical)
            first = not math.isfinite(self.learned.since_unix_s)
            self.learned = replace(
                updated(self.learned, seen),
                poses=self.learned.poses + (self._of_pose == 0),
                since_unix_s=sighting.utc_unix_s if first else self.learned.since_unix_s,
            )
            self._of_pose += 1
            return
        if self._of_pose >= FEW_OF_POSE:
            return
        first = self._of_pose == 0
        up = sighting.camera.rotation.T @ gnss.zenith if first else self._held[-1].up_in_camera
        self._held.append(GnssFrame(sighting, gnss, first, up))
        self._of_pose += 1
        self.learned = begun(self._instrument, self._held, self.vertical)
        self.is_learning = not is_linear(self.learned, sighting.tilt)
        if not self.is_learning:
            self._held.clear()
