# SPDX-License-Identifier: Apache-2.0
"""Tilts that are late, missing or wrong."""

import math
from copy import deepcopy

from accelerated import CADENCE_S, World

from kinds.registry import HOSTILE, kind, shift, some_time
from starpos_interfaces.msg import Tilt
from starpos_testing.graph.shots import EXPOSURE_S


@kind(3)
def tilts_late(w: World):
    """All tilts, or some, after their frame; within its patience or not."""
    shot, some = w.shot(), int(w.rng.integers(0, 5))
    w.tick()
    early, shot.tilts = shot.tilts[:some], shot.tilts[some:]
    for tilt in early:
        w.graph.tilt.publish(tilt)
    w.stars(shot)
    w.spin(w.rng.uniform(0, 0.3))
    w.tilts(shot)


@kind(2)
def tilts_doubled(w: World):
    """Every tilt twice or three times."""
    shot = w.shot()
    shot.tilts = [t for t in shot.tilts for _ in range(w.rng.integers(2, 4))]
    w.send(shot)


@kind(2)
def tilts_out_of_order(w: World):
    """The tilts of an exposure in any order."""
    shot = w.shot()
    shot.tilts = [shot.tilts[k] for k in w.rng.permutation(len(shot.tilts))]
    w.send(shot)


@kind(1.5)
def tilts_from_the_future(w: World):
    """Tilts 3 s to 11 days ahead; when their time has come the instrument has been turned."""
    shot = w.shot()
    shift(shot.tilts, some_time(w))
    w.send(shot)
    # These are the times of the next frames.
    for ahead in range(4, 9):
        early = w.shot()
        w.now_s -= 0.8
        shift(early.tilts, 0.8 * ahead)
        w.tilts(early)
    # The solver reads the tilts before their time comes, also here, where a second takes 50 ms.
    w.until_read()
    w.turn()


@kind(0.2)
def tilts_of_a_clock_ahead(w: World):
    """The inclinometer's clock is 4 to 10 s ahead, steadily, while the instrument is turned now and then."""
    # further than a clock that ticks once a frame can be behind
    frames = int(w.rng.integers(5, 13))
    for k in range(frames + 4):
        if k % 4 == 2:
            w.turn()
        shot = w.shot()
        early = deepcopy(shot.tilts)
        shift(early, CADENCE_S * frames)
        w.tick()
        for tilt in early:
            w.graph.tilt.publish(tilt)
        w.stars(shot)
        # the solver has read them before their time comes, also here, where a second takes 50 ms
        w.until_answered(shot)


@kind(2)
def tilts_missing(w: World):
    """Some or all tilts of an exposure are missing."""
    shot = w.shot()
    shot.tilts = [t for t in shot.tilts if w.rng.random() < 0.4]
    w.send(shot)


@kind(3)
def tilts_not_numbers(w: World):
    """NaN, infinity, 1e300, 0 or -1 for some number of some or all tilts."""
    shot, value = w.shot(), float(w.rng.choice(HOSTILE))
    name = w.rng.choice(["x", "y", "covariance", "temperature"])
    bad = shot.tilts if not math.isfinite(value) or name == "covariance" else shot.tilts[:1]
    for tilt in bad:
        if name == "covariance":
            tilt.covariance[w.rng.integers(4)] = value
        else:
            setattr(tilt, name, value)
    w.send(shot)


@kind(2)
def tilts_with_any_flags(w: World):
    """Random flags on random tilts, whose values are then anything."""
    shot = w.shot()
    for tilt in shot.tilts:
        if w.rng.random() < 0.5:
            tilt.flags = int(w.rng.choice([Tilt.OUT_OF_RANGE, Tilt.STUCK, Tilt.SATURATED, 7, 15, 255]))
            tilt.x = w.rng.uniform(-0.5, 0.5)
    w.send(shot)


@kind(2)
def tilts_with_a_leap(w: World):
    """One reading of five off by up to 20 deg."""
    shot = w.shot()
    shot.tilts[w.rng.integers(5)].x += math.radians(some_time(w, 0.01, 20))
    w.send(shot)


@kind(1)
def tilts_of_a_moving_instrument(w: World):
    """A drift of 0.02 to 5 deg during the exposure."""
    shot, rate = w.shot(), math.radians(some_time(w, 0.02, 5)) / EXPOSURE_S
    for k, tilt in enumerate(shot.tilts):
        tilt.y += rate * EXPOSURE_S * k / len(shot.tilts)
    w.send(shot)
