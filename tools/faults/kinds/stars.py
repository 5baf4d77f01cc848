# SPDX-License-Identifier: Apache-2.0
"""Star lists that are wrong."""

from copy import deepcopy

from accelerated import World

from kinds.registry import HOSTILE, INF, kind
from starpos_interfaces.msg import Star
from starpos_testing.graph.shots import SMALL


@kind(4)
def stars_not_numbers(w: World):
    """NaN, infinity, 1e300, 0 or -1 for some number of a star list."""
    shot = w.shot()
    star, value = shot.stars.stars[w.rng.integers(len(shot.stars.stars))], float(w.rng.choice(HOSTILE))
    name = w.rng.choice(["x", "y", "flux", "snr", "covariance", "exposure", "stamp_stddev", "clock_stddev"])
    if name in ("exposure", "stamp_stddev", "clock_stddev"):
        setattr(shot.stars, name, value)
    elif name == "covariance":
        star.covariance[w.rng.integers(4)] = value
    else:
        setattr(star, name, value if name in "xy" or abs(value) < 1e30 else INF)
    w.send(shot)


@kind(1)
def stars_of_another_sky(w: World):
    """As many stars as before, anywhere on the frame."""
    shot = w.shot()
    for star in shot.stars.stars:
        star.x, star.y = w.rng.uniform(0, SMALL[0] - 1), w.rng.uniform(0, SMALL[1] - 1)
    w.send(shot)


@kind(2)
def stars_mirrored(w: World):
    """Rows or columns the other way round."""
    shot, rows = w.shot(), w.rng.random() < 0.5
    for star in shot.stars.stars:
        star.x, star.y = (star.x, SMALL[1] - 1 - star.y) if rows else (SMALL[0] - 1 - star.x, star.y)
    w.send(shot)


@kind(2)
def stars_with_any_flags(w: World):
    """Random flags on all stars."""
    shot = w.shot()
    for star in shot.stars.stars:
        star.flags = int(w.rng.integers(256))
    w.send(shot)


@kind(2)
def stars_false_and_lost(w: World):
    """Up to 300 false stars among them, up to nine in ten lost."""
    shot = w.shot()
    stars = [s for s in shot.stars.stars if w.rng.random() < w.rng.uniform(0.1, 1)]
    for _ in range(w.rng.integers(300)):
        false = deepcopy(shot.stars.stars[w.rng.integers(len(shot.stars.stars))])
        false.x, false.y = w.rng.uniform(0, SMALL[0] - 1), w.rng.uniform(0, SMALL[1] - 1)
        stars.append(false)
    shot.stars.stars = sorted(stars, key=lambda s: -s.flux)
    w.send(shot)


@kind(1)
def stars_blurred(w: World):
    """Centroids off by up to 1 px where 0.02 px are claimed."""
    shot, error = w.shot(), w.rng.uniform(0.05, 1.0)
    for star in shot.stars.stars:
        star.x, star.y = star.x + w.rng.normal(0, error), star.y + w.rng.normal(0, error)
    w.send(shot)


@kind(0.3)
def stars_by_the_thousand(w: World):
    """20 000 stars, all in one place or anywhere."""
    shot, spread = w.shot(), w.rng.choice([0.0, 1.0])
    covariance = [0.01, 0.0, 0.0, 0.01]
    xy = (w.rng.uniform(0, 1, (20000, 2)) * spread + (1 - spread) * 0.5) * [SMALL[0] - 1, SMALL[1] - 1]
    shot.stars.stars = [Star(x=x, y=y, flux=9.0, snr=9.0, covariance=covariance) for x, y in xy]
    w.send(shot)


@kind(1)
def stars_none_or_few(w: World):
    """None to five stars."""
    shot = w.shot()
    shot.stars.stars = shot.stars.stars[: w.rng.integers(6)]
    w.send(shot)


@kind(2)
def stars_of_another_frame_size(w: World):
    """Width and height of anything."""
    shot = w.shot()
    sizes = [0, 1, 700, 1000, 5616, 4294967295]
    shot.stars.width, shot.stars.height = (int(v) for v in w.rng.choice(sizes, 2))
    w.send(shot)
