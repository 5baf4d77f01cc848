# SPDX-License-Identifier: Apache-2.0
"""Places by satellites: what they cost, and how their errors and claims grow with the age of the elements.

    python tools/benchmarks/benchmark_satellites.py cost [--trails 1000] [--satellites 12000] [--seed 1]
    python tools/benchmarks/benchmark_satellites.py ages [--nights 12] [--seed 1]

`cost` prints the CPU time of naming and adjusting the trails of one evening.  `ages` prints a table: for each age of the
elements the error of the place (rms a component), the claim, and how many of the trails were named.  All is drawn: two
thirds of the satellites are of a constellation that manoeuvres, and each is off its elements as its class states. Which
end of a trail came first is unknown, as on a frame. Elements older than their class allows are not used.
"""

import argparse
import math
import sys
import time

import numpy as np

from starpos.earth.gravity import itrs_place
from starpos.errors import SatelliteError
from starpos.rotation import normalised
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import CLASSES, Orbit
from starpos.satellites.locating import locate
from starpos.satellites.naming import OrbitsAbove
from starpos.satellites.orbits import Moments, along_axes, observed, states
from starpos.satellites.trails import SatelliteTrail
from starpos.units import ARCSEC, DAY_S, UNIX_EPOCH_JD

BEGIN_S = 1_790_000_000.0
SIGMA, EXPOSURE_S, HEIGHT_M, LEAST = 3 * ARCSEC, 1.0, 500.0, math.sin(math.radians(25))
HEIGHT_STDDEV_M, CLOCK_STDDEV_S = 20.0, 0.002
AGES = 0.5, 1, 2, 4, 7, 10, 14, 21, 30
# mean motions a day, and inclinations, of the two kinds
KINDS = ((CLASSES["manoeuvring"], 15.06, (53.0, 53.1)), (CLASSES["passive"], 14.4, (65.0, 98.5)))


def drawn_orbits(count: int, age_days: float, rng: np.random.Generator) -> list[Orbit]:
    """Orbits of satellites with elements of that age at BEGIN_S."""
    from sgp4.api import WGS72, Satrec

    orbits = []
    epoch = BEGIN_S - age_days * DAY_S
    for k in range(count):
        errors, per_day, inclinations = KINDS[k % 3 == 2]
        record = Satrec()
        turns = rng.uniform(0, 2 * math.pi, 3)
        rate = (
            (per_day + rng.normal(0, 0.01 if errors is CLASSES["manoeuvring"] else 0.3)) * 2 * math.pi / 1440
        )
        inclination = math.radians(rng.uniform(*inclinations))
        days = epoch / DAY_S + UNIX_EPOCH_JD - 2433281.5
        record.sgp4init(
            WGS72, "i", 0, days, 1e-4, 0.0, 0.0, 5e-4, turns[0], inclination, turns[1], rate, turns[2]
        )
        orbits.append(
            Orbit(number=10_000 + k, name=errors.what, epoch_unix_s=epoch, errors=errors, record=record)
        )
    return orbits


def drawn_trails(
    orbits: list[Orbit], count: int, span_s: float, place: np.ndarray, rng: np.random.Generator
) -> list[SatelliteTrail]:
    """Trails of satellites high in the sky, evenly over a time; each satellite is off by what its class states."""
    off = rng.normal(0, 1, (len(orbits), 3))
    trails: list[SatelliteTrail] = []
    above = OrbitsAbove(orbits)
    for at in BEGIN_S + span_s * (np.arange(count) + 0.5) / count:
        high = normalised(above.at(at)[0] - place) @ normalised(place) > LEAST
        k = rng.choice(np.flatnonzero(high))
        utc = np.array([at, at + EXPOSURE_S])
        directions = directions_of([orbits[k]] * 2, utc, place, off[k])
        noise = rng.normal(0, SIGMA, (2, 3))
        trails.append(
            SatelliteTrail(
                track=len(trails),
                directions=normalised(directions + noise),
                covariance=SIGMA**2 * np.tile(np.eye(2), (2, 1, 1)),
                utc_unix_s=utc,
                turned_utc_unix_s=utc[::-1],
            )
        )
    return trails


def directions_of(
    orbits: list[Orbit], utc_unix_s: np.ndarray, place: np.ndarray, off: np.ndarray
) -> np.ndarray:
    """Directions (E, 3) among the stars; off (3,): of the satellite from its elements, in sigma of its class."""
    moments = Moments.at(utc_unix_s)
    radial, along, across = off * orbits[0].errors.sigma(orbits[0].age_days(utc_unix_s[0]))
    _, v = states(orbits, moments, np.zeros(len(orbits)))
    r, v = states(orbits, moments, along / np.linalg.norm(v, axis=1))
    axes = along_axes(r, v)
    site, _ = moments.site(place, 0.0)
    return observed(r + radial * axes[:, 0] + across * axes[:, 2], v, site, moments.velocity)[0]


def cost(options: argparse.Namespace) -> int:
    rng = np.random.default_rng(options.seed)
    place = itrs_place(math.radians(47.0), math.radians(8.0), HEIGHT_M)
    orbits = drawn_orbits(options.satellites, 1.0, rng)
    trails = drawn_trails(orbits, options.trails, 1800.0, place, rng)
    begin = time.process_time()
    fix = locate(trails, orbits, KnownBefore(HEIGHT_M, HEIGHT_STDDEV_M, CLOCK_STDDEV_S))
    seconds = time.process_time() - begin
    named = sum(orbit is not None for orbit in fix.named)
    print(f"{len(trails)} trails, {len(orbits)} elements: {seconds:.2f} s of CPU, {named} named; {fix.text}")
    return int(seconds > 10)


def ages(options: argparse.Namespace) -> int:
    print(
        "| age (days) | error (m a component, rms) | claim (m, rms) | beyond 4 sigma | trails named (%) | refused |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for age in AGES:
        errors, claims, far, named, refused = [], [], 0, [], 0
        for night in range(options.nights):
            rng = np.random.default_rng([options.seed, night, round(10 * age)])
            latitude, longitude = math.asin(rng.uniform(-0.8, 0.8)), rng.uniform(-math.pi, math.pi)
            place = itrs_place(latitude, longitude, HEIGHT_M)
            orbits = drawn_orbits(3000, age, rng)
            trails = drawn_trails(orbits, 24, 600.0, place, rng)
            usable = [o for o in orbits if age <= o.errors.max_age_days]
            try:
                fix = locate(trails, usable, KnownBefore(HEIGHT_M, HEIGHT_STDDEV_M, CLOCK_STDDEV_S))
            except SatelliteError:
                refused += 1
                continue
            east = math.remainder(fix.longitude - longitude, 2 * math.pi) * math.cos(latitude)
            off = np.array([east, fix.latitude - latitude]) * 6.371e6
            errors.append(off)
            claims.append(math.sqrt(np.trace(fix.covariance[:2, :2]) / 2))
            far += bool(off @ np.linalg.solve(fix.covariance[:2, :2], off) > 16)
            named.append(np.mean([orbit is not None for orbit in fix.named]))
        rms, claim = (math.sqrt(np.mean(np.square(x))) if x else math.nan for x in (errors, claims))
        print(
            f"| {age:g} | {rms:.0f} | {claim:.0f} | {far} | {100 * np.mean(named or [0]):.0f} | {refused} |",
            flush=True,
        )
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["cost", "ages"])
    parser.add_argument("--trails", type=int, default=1000)
    parser.add_argument("--satellites", type=int, default=12_000)
    parser.add_argument("--nights", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    return {"cost": cost, "ages": ages}[options.what](options)


if __name__ == "__main__":
    sys.exit(main())
