# SPDX-License-Identifier: Apache-2.0
"""Drives on which nothing goes as the filter assumes: the claim holds, a good GNSS is believed, and nothing ends it."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest

from starpos.earth.vertical import Deflection
from starpos.fix.solution import Solution, Status
from starpos.frames.frame import no_stars
from starpos.gnss.filter import place_of_stars
from starpos.gnss.solving import watched
from starpos.gnss.watch import GnssStatus, GnssWatch
from starpos_testing.gnss_drives import GnssDrive

UNKNOWN = Deflection(stddev_arcsec=6.0)
BEGIN_S, THEN_S = 1.7e9, 1200.0
DRIVE = GnssDrive(stops=20)
CROWDED = GnssDrive(stops=14, frames=10, cadence_s=3.0)


@dataclass(frozen=True)
class Driven:
    """What was said of each frame with GNSS, (s, status); error and claim of each place, (s, NEES, sigma m)."""

    said: list
    places: np.ndarray
    watch: GnssWatch

    def count(self, status):
        return Counter(told for _, told in self.said)[status]

    def first(self, status):
        return next((at for at, told in self.said if told == status), np.inf)

    def nees(self, since_s=THEN_S):
        return self.places[self.places[:, 0] >= since_s, 1]


def driven(
    drive,
    seed,
    change=lambda k, sighting, gnss: (sighting, gnss),
    astray=lambda t: np.zeros(2),
    at=None,
):
    """Drive; change: of a frame by its number.  at: latitude, longitude of the start, deg."""
    rng = np.random.default_rng(seed)
    watch, said, places = GnssWatch(drive.instrument, UNKNOWN), [], []
    for k, moment in enumerate(drive.moments(rng if at is None else Beginning(rng, at), astray)):
        sighting, gnss = change(k, moment.sighting, moment.gnss)
        seconds = sighting.utc_unix_s - BEGIN_S
        watch.advance(sighting)
        check = None if gnss is None else watch.judge(sighting, gnss)
        if watch.tells_place(sighting):
            place = place_of_stars(sighting, watch.learned, UNKNOWN)
            off = place.offset_m(*moment.place)
            nees = off @ np.linalg.solve(place.covariance, off)
            places.append((seconds, nees, np.sqrt(np.trace(place.covariance) / 2)))
        if check is not None:
            said.append((seconds, check.status))
            watch.learn(sighting, gnss, check)
    return Driven(said, np.array(places).reshape(-1, 3), watch)


class Beginning:
    """A generator of random numbers whose first two are a place."""

    def __init__(self, rng, place):
        self._rng, self._place = rng, list(place)

    def uniform(self, *args):
        return self._place.pop(0) if self._place else self._rng.uniform(*args)

    def __getattr__(self, name):
        return getattr(self._rng, name)


def one_reading_for_many(times_known):
    """Frames that come faster than readings: ten of them share one, as `TiltLog.average` gives it to each."""
    tilts = {}

    def change(k, sighting, gnss):
        tilt = tilts.setdefault(k // 10, sighting.tilt)
        shared = replace(tilt, times=(tilt.utc_unix_s,)) if times_known else tilt
        return replace(sighting, tilt=shared), gnss

    return change


@pytest.mark.parametrize("times_known", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_reading_that_many_frames_share_is_one_measurement_and_no_alarm(seed, times_known):
    """Its noise once counted in each of them: 59 to 137 of 250 frames denied a good GNSS."""
    told = driven(CROWDED, seed, one_reading_for_many(times_known))
    assert told.count(GnssStatus.DISAGREES) == 0 and told.count(GnssStatus.DOUBTFUL) < 10
    assert told.nees(600.0).mean() < 4


def test_frames_that_share_a_reading_show_a_jump_all_the_same():
    jump = driven(CROWDED, 2, one_reading_for_many(True), lambda t: np.array([0.0, 3000.0]) * (t > 1000))
    assert 1000 < jump.first(GnssStatus.DISAGREES) < 1300


def scaled(by):
    return lambda k, sighting, gnss: (sighting, replace(gnss, covariance=gnss.covariance * by))


def frozen():
    """A receiver that repeats its place from THEN_S on, with new stamps."""
    last = []

    def change(k, sighting, gnss):
        if sighting.utc_unix_s - BEGIN_S < THEN_S or not last:
            last[:] = [gnss]
        return sighting, replace(last[0], utc_unix_s=gnss.utc_unix_s)

    return change


def other_hemisphere(since_s):
    """A latitude that loses its sign at a time."""

    def change(k, sighting, gnss):
        if sighting.utc_unix_s - BEGIN_S < since_s:
            return sighting, gnss
        return sighting, replace(gnss, latitude=-gnss.latitude, plumb=(-gnss.latitude, gnss.longitude))

    return change


def twice():
    """Each frame comes twice: the second is the first one again."""
    before = {}

    def change(k, sighting, gnss):
        return before.setdefault(k // 2, (sighting, gnss))

    return change


def stepping(by_s):
    """The clock of all is set by some seconds at THEN_S."""

    def change(k, sighting, gnss):
        if sighting.utc_unix_s - BEGIN_S < THEN_S:
            return sighting, gnss
        at = sighting.utc_unix_s + by_s
        tilt = replace(sighting.tilt, utc_unix_s=at)
        return replace(sighting, utc_unix_s=at, tilt=tilt), replace(gnss, utc_unix_s=at)

    return change


def gone_cold(k, sighting, gnss):
    """GNSS comes with every seventh frame only, without a temperature then."""
    tilt = replace(sighting.tilt, temperature_c=np.nan)
    return (sighting, None) if k % 7 else (replace(sighting, tilt=tilt), gnss)


# name: what happens; whether GNSS is denied at last
ODD = {
    "an error stated ten thousand times too small": (scaled(1e-8), False),
    "an error stated a thousand times too large": (scaled(1e6), False),
    "a place that freezes": (frozen(), True),
    "a latitude that loses its sign": (other_hemisphere(THEN_S), True),
    "a clock that goes back by an hour": (stepping(-3600.0), False),
    "a clock that goes on by a day": (stepping(86400.0), False),
    "seldom, and never with a temperature": (gone_cold, False),
}


@pytest.mark.parametrize("name", ODD)
def test_a_claim_holds_and_gnss_is_denied_only_where_it_errs(name):
    change, denied = ODD[name]
    for seed in (1, 2):
        told = driven(DRIVE, seed, change)
        assert (told.count(GnssStatus.DISAGREES) > 0) == denied
        assert told.first(GnssStatus.DISAGREES) >= THEN_S
        assert told.nees(-np.inf).size > 20 and told.places[-15:, 1].mean() < 4


def test_a_frame_that_comes_twice_teaches_once():
    told = driven(replace(DRIVE, stops=8), 1, twice())
    assert told.watch.learned.frames == len(told.said) / 2
    assert told.count(GnssStatus.DISAGREES) == 0


@pytest.mark.parametrize("at", [(89.9, 10.0), (-89.95, 170.0), (10.0, 179.99), (-20.0, -179.99)])
def test_near_a_pole_and_across_the_date_line_the_place_goes_on(at):
    told = driven(DRIVE, 1, lambda k, sighting, gnss: (sighting, gnss if k < 40 else None), at=at)
    assert told.count(GnssStatus.DISAGREES) == 0 and told.nees().size == 30 and told.nees().mean() < 4


COLD_STARTS = [(3000.0, 60.0), (3000.0, 300.0), (30_000.0, 60.0), (30_000.0, 300.0)]


@pytest.mark.parametrize(("off_m", "until_s"), COLD_STARTS)
def test_a_receiver_that_begins_far_off_is_forgotten_not_believed_for_ever(off_m, until_s):
    """It states 2.5 m at its first stops: good places later were denied for the whole drive, by one as far off."""
    for seed in (1, 3):
        told = driven(DRIVE, seed, astray=lambda t: np.array([off_m, 0.0]) * (t < until_s))
        assert 0 < told.count(GnssStatus.DISAGREES) <= 3 and told.said[-1][1] == GnssStatus.AGREES
        assert told.nees().size == 30 and told.nees().mean() < 4


def test_a_gnss_of_the_other_hemisphere_never_leaves_a_place_behind():
    told = driven(replace(DRIVE, stops=12), 2, other_hemisphere(0.0))
    # alarms go on, and hardly a frame has a place, which would be thousands of km off
    assert told.count(GnssStatus.DISAGREES) > 8 and len(told.places) <= 3


@pytest.mark.parametrize("begin_s", [400.0, 800.0])
def test_four_poses_are_believed_more_than_a_gnss_that_jumps(begin_s):
    told = driven(DRIVE, 2, astray=lambda t: np.array([2000.0, 0.0]) * (t > begin_s))
    assert begin_s < told.first(GnssStatus.DISAGREES) < begin_s + 100
    assert told.said[-1][1] == GnssStatus.DISAGREES and told.nees().mean() < 4


def test_an_instrument_that_never_moved_denies_a_gnss_that_jumps():
    parked = GnssDrive(stops=1, frames=40)
    told = driven(parked, 1, astray=lambda t: np.array([30_000.0, 0.0]) * (t > 150))
    assert told.first(GnssStatus.DISAGREES) < 180 and told.said[-1][1] == GnssStatus.DISAGREES
    assert told.nees(0.0).mean() < 4


def with_third(sighting):
    up = sighting.tilt.up
    return replace(sighting, tilt=replace(sighting.tilt, theta_z=float(np.arcsin(up[2]))))


@pytest.mark.parametrize(
    "third", [lambda k: k >= 4, lambda k: k != 40], ids=["from a frame on", "but at one"]
)
def test_a_third_axis_that_comes_or_goes_within_a_pose_is_another_inclinometer(third):
    """It begins anew in the middle of a pose, of which no frame is held: that was an IndexError."""
    told = driven(replace(DRIVE, stops=24), 1, lambda k, s, gnss: (with_third(s) if third(k) else s, gnss))
    assert told.watch.learned.axes == 3 and told.count(GnssStatus.DISAGREES) == 0
    assert told.places[-9:, 1].mean() < 4


def test_what_is_not_believed_stays_so_at_a_frame_without_a_fix():
    """Clouds once took the alarm away: the frame's status was 'learning', and its diagnostic good."""
    moments = list(
        replace(DRIVE, stops=14).moments(
            np.random.default_rng(2), lambda t: np.array([0.0, 2000.0]) * (t > THEN_S)
        )
    )
    watch = GnssWatch(DRIVE.instrument, UNKNOWN)
    stars = no_stars(100, 100)
    lost = Solution.failed(stars, Status.NOT_IDENTIFIED, "clouds")

    def cloudy():
        return watched(None, stars, lost, moments[-1].gnss, watch).compared

    assert cloudy().status == GnssStatus.LEARNING and "learned from GNSS" in cloudy().sentence
    for moment in moments:
        watch.advance(moment.sighting)
        watch.learn(moment.sighting, moment.gnss, watch.judge(moment.sighting, moment.gnss))
    assert watch.disagrees and cloudy().status == GnssStatus.DISAGREES
    assert "not believed" in cloudy().sentence and watched(None, stars, lost, None, watch).compared is None
