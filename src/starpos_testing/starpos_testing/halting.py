# SPDX-License-Identifier: Apache-2.0
"""Ways of rovers that halt, and of ones that only seem to: what `voyages.made` records as `drive`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

STEP_S = 0.05
SPEED, TURNING = 0.8, 2 * np.pi / 150
# of the ground under the wheels: leans, 1 sigma, and range of lengths
LEAN, SHORTEST_M, LONGEST_M = np.radians(4), 8.0, 40.0
# slip of the wheels to the side, 1 sigma, and range of durations, s
SLIP, SLIP_S = 0.05, (4, 30)
FERRY_SPEED = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Drive:
    """A way as functions of time in s.

    displacement: (N, 3) m east, north, up.  angles: roll, pitch, yaw (N, 3) rad.  moving (N,): 0 where the wheels stand,
    1 where they drive.
    """

    displacement: Callable[[np.ndarray], np.ndarray]
    angles: Callable[[np.ndarray], np.ndarray]
    moving: Callable[[np.ndarray], np.ndarray]


def smooth(t, begin_s, length_s):
    """From 0 to 1 in so long a time, with a steady acceleration at both ends."""
    s = np.clip((t - begin_s) / length_s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s * s)


def spells(rng, seconds, driven_s, stood_s):
    """Begin and end (S, 2) of standstills, s, with drives in between, both drawn from the given ranges."""
    at, found = rng.uniform(5, 60), []
    while at < seconds:
        end = at + rng.uniform(*stood_s)
        found.append((at, end))
        at = end + rng.uniform(*driven_s)
    return np.array(found)


def halting(driven_s=(100, 240), stood_s=(20, 40), ground=LEAN, sway=None):
    """A rover that curves over uneven ground and stands now and then: a function of seconds and generator.

    sway: it turns once in its first drive, and then keeps to a course, 1 sigma in rad.
    """

    def drive(seconds, rng):
        grid = _grid(seconds)
        stops = spells(rng, seconds, driven_s, stood_s)
        driving = 1 - sum(smooth(grid, a - 1.5, 1.5) - smooth(grid, b, 1.5) for a, b in stops)
        speed = SPEED * driving * (1 + 0.5 * np.sin(2 * np.pi * grid / 90))
        way = _sum(driving)
        if sway is None:
            bend = way * TURNING * rng.uniform(0.5, 1.5) + np.sin(2 * np.pi * way / rng.uniform(100, 300))
        else:
            rate, phase = 2 * np.pi / rng.uniform(50, 200, 5), rng.uniform(0, 2 * np.pi, 5)
            bend = sway * np.sqrt(2 / 5) * np.sin(np.multiply.outer(way, rate) + phase).sum(-1)
            bend += 2 * np.pi * smooth(way, 10, 80)
        yaw = rng.uniform(0, 2 * np.pi) + bend
        return _on_ground(rng, grid, speed, yaw, ground, SLIP)

    return drive


def even(leg_s=(60, 120), turn_s=8.0, speed=SPEED, shaking_turns=False):
    """A rover that never stands: straight legs at a steady speed on an even floor, with turns between.

    shaking_turns: only turns shake it, so that a leg is as quiet as a standstill.
    """

    def drive(seconds, rng):
        grid = _grid(seconds)
        yaw, turning, at = rng.uniform(0, 2 * np.pi) + 0 * grid, 0 * grid, 0.0
        while at < seconds:
            at += rng.uniform(*leg_s)
            yaw += rng.choice([-1, 1]) * rng.uniform(1, 2.5) * smooth(grid, at, turn_s)
            turning += (grid > at) & (grid < at + turn_s)
            at += turn_s
        way = _on_ground(rng, grid, speed + 0 * grid, yaw, 0.0, 0.0)
        moving = turning if shaking_turns else 0 * grid
        return Drive(displacement=way.displacement, angles=way.angles, moving=_steps(grid, moving))

    return drive


def on_carriers(velocity, begin_s=12.0, jolt_s=2.0):
    """A rover that in every second of its stops is carried at a velocity (3,), m/s east, north, up, and back in another.

    As by a lift or a platform: they jolt when they begin and end, and between go as quietly as the rover stands.
    """

    def drive(seconds, rng):
        way = halting(stood_s=(40, 60), sway=0.1)(seconds, rng)
        grid = _grid(seconds)
        standing = way.moving(grid) == 0
        speed, jolts, sign = 0 * grid, 0 * grid, 1.0
        for at in begin_s + grid[1:][np.diff(standing.astype(int)) == 1][::2]:
            end = at + rng.uniform(14, 20)
            speed += sign * (smooth(grid, at, jolt_s) - smooth(grid, end, jolt_s))
            jolts += sum((grid > begin) & (grid < begin + jolt_s) for begin in (at, end))
            sign = -sign
        way = _carried(way, grid, np.outer(speed, velocity))
        return replace(way, moving=_steps(grid, way.moving(grid) + jolts))

    return drive


def on_a_ferry(speed=FERRY_SPEED):
    """A rover that drives about and stands, with its whole ground carried away from the middle of the voyage on.

    The ferry gathers way in a minute, and moves without a tremor and on an even keel.
    """

    def drive(seconds, rng):
        grid, course = _grid(seconds), rng.uniform(0, 2 * np.pi)
        carried = speed * np.outer(smooth(grid, seconds / 2, 60), [np.cos(course), np.sin(course), 0.0])
        return _carried(halting()(seconds, rng), grid, carried)

    return drive


def idling(drive):
    """Ways of a drive, with its wheels shaking on where they stand."""
    return lambda seconds, rng: replace(drive(seconds, rng), moving=lambda t: 1.0 + 0 * t)


def _grid(seconds):
    return np.arange(-1.0, seconds + 1.0, STEP_S)


def _sum(rate):
    return np.append(0.0, np.cumsum((rate[1:] + rate[:-1]) / 2 * STEP_S))


def _steps(grid, values):
    return lambda t: (np.interp(t, grid, values) > 1e-3).astype(float)


def _on_ground(rng, grid, speed, yaw, ground, slip):
    """A Drive with this speed and course over ground that leans, with wheels that slip."""
    way = _sum(speed)
    rate, phase = 2 * np.pi / rng.uniform(SHORTEST_M, LONGEST_M, (2, 5)), rng.uniform(0, 2 * np.pi, (2, 5))
    lean = ground * np.sqrt(2 / 5) * np.sin(np.multiply.outer(way, rate) + phase).sum(-1)
    angles = CubicSpline(grid, np.column_stack([lean, yaw]))
    rate, phase = 2 * np.pi / rng.uniform(*SLIP_S, 5), rng.uniform(0, 2 * np.pi, 5)
    slip = (
        slip
        * np.sqrt(2 / 5)
        * np.sin(np.multiply.outer(grid, rate) + phase).sum(-1)
        * np.minimum(speed / SPEED, 1)
    )
    east, north = speed * np.cos(yaw) - slip * np.sin(yaw), speed * np.sin(yaw) + slip * np.cos(yaw)
    track = [CubicSpline(grid, part).antiderivative() for part in (east, north)]
    return Drive(
        displacement=lambda t: np.stack([track[0](t), track[1](t), 0 * t], -1),
        angles=angles,
        moving=_steps(grid, speed),
    )


def _carried(way, grid, velocity):
    """A Drive on ground that itself moves, at velocities (G, 3) on a grid of times."""
    more = CubicSpline(grid, velocity).antiderivative()
    return replace(way, displacement=lambda t: way.displacement(t) + more(t))
