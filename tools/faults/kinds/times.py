# SPDX-License-Identifier: Apache-2.0
"""Frames, stamps and clocks that are not in their order."""

from accelerated import World
from std_srvs.srv import Trigger

from kinds.registry import kind, shift, some_time


def send_as_exposed(w: World, shot):
    """Send the tilts during the exposure and the stars after it: that order distinguishes them if times repeat."""
    w.tick()
    w.tilts(shot)
    w.spin(0.02)
    w.stars(shot)
    w.spin(0.02)


@kind(3)
def frames_doubled(w: World):
    """A star list twice."""
    shot = w.shot()
    w.send(shot)
    w.stars(shot)


@kind(3)
def frames_out_of_order(w: World):
    """Two to four frames in any order."""
    shots = [w.shot() for _ in range(w.rng.integers(2, 5))]
    for k in w.rng.permutation(len(shots)):
        w.send(shots[k])


@kind(2)
def frames_late(w: World):
    """A frame after the next one to ten."""
    late = w.shot()
    w.tilts(late)
    w.remember(late.stars)
    for _ in range(w.rng.integers(1, 10)):
        w.good()
    w.stars(late)


@kind(2)
def frames_missing(w: World):
    """Tilts without their frame."""
    for _ in range(w.rng.integers(1, 4)):
        w.tilts(w.shot())


@kind(3)
def frames_from_the_future(w: World):
    """Stamps 2 s to 11 days ahead of /clock, with tilts there or without."""
    shot, ahead = w.shot(), some_time(w)
    shift([shot.stars], ahead)
    if w.rng.random() < 0.5:
        shift(shot.tilts, ahead)
    w.send(shot)


@kind(3)
def stamps_of_another_time(w: World):
    """Stamps of one frame and its tilts 2 s to 1 h early."""
    shot = w.shot()
    shift([shot.stars, *shot.tilts], -some_time(w, 2, 3600))
    send_as_exposed(w, shot)


@kind(1)
def clock_set(w: World):
    """The whole instrument's clock, /clock too, is set by 2 s to 1 h, ahead or back, for 2 to 8 frames."""
    off = some_time(w, 2, 3600) * w.rng.choice([-1, 1])
    w.clock_off_s = off
    for _ in range(w.rng.integers(2, 9)):
        shot = w.shot()
        shift([shot.stars, *shot.tilts], off)
        send_as_exposed(w, shot)
    w.clock_off_s = 0.0


@kind(0.3)
def clock_set_and_instrument_turned(w: World):
    """A clock that is set, as above, and the instrument is turned before it is right again; then solver/reset."""
    off = some_time(w, 2, 3600) * w.rng.choice([-1, 1])
    w.clock_off_s = off
    for k in range(8):
        shot = w.shot()
        shift([shot.stars, *shot.tilts], off)
        send_as_exposed(w, shot)
        if k == 3:
            w.turn()
    w.clock_off_s = 0.0
    w.graph.call(Trigger, "solver/reset", Trigger.Request())


@kind(2)
def clock_topic_jumps(w: World):
    """/clock alone jumps by up to 11 days, or to 0, ahead or back, while a frame comes."""
    shot = w.shot()
    w.tick(w.rng.choice([0.0, w.now_s + some_time(w), w.now_s - some_time(w)]))
    w.spin(0.01)
    w.graph.info.publish(shot.info)
    w.tilts(shot)
    w.stars(shot)
    w.spin(0.02)


@kind(1)
def stamps_missing_or_broken(w: World):
    """Stamps of 0, before 1970, of 2037, or with 4 s of nanoseconds."""
    shot = w.shot()
    sec, nanosec = [(0, 0), (-5, 0), (2114380800, 0), (shot.stars.header.stamp.sec, 4_000_000_000)][
        w.rng.integers(4)
    ]
    shot.stars.header.stamp.sec, shot.stars.header.stamp.nanosec = sec, nanosec
    w.send(shot)
