# SPDX-License-Identifier: Apache-2.0
"""Table of docs/navigation.md: how well place and heading are known under way, and whether their claims hold.

Voyages of
starpos_testing.voyages with odometry or a log (none for drones, and for rovers of starpos_testing.halting), a frame
every 2 s.  Means of the last quarter: error of the place, 1 sigma an axis as claimed, NEES of the place (2 where claims
hold), error of the heading; CPU time of a voyage without identification.
"""

import time
from collections.abc import Iterator

import numpy as np
from table import Cost, Row

from starpos.earth.refraction import Atmosphere
from starpos.navigation.records import ImuModel, VelocityLog
from starpos.navigation.vessel import LAWS, Vessel
from starpos.navigation.voyage import Voyage, adjust_voyage
from starpos.units import ARCSEC
from starpos_testing.halting import even, halting, idling, on_a_ferry, on_carriers
from starpos_testing.voyages import (
    CAMERA_TO_BODY,
    INDUSTRIAL,
    TACTICAL,
    MadeVoyage,
    made,
    swinging_wind,
    turbulent_wind,
    walking_wind,
)

EARTH_M = 6.37e6
GRADES = {"industrial": INDUSTRIAL, "tactical": TACTICAL}
VEHICLES = "rover", "ship", "drone", "parked"
# The wind of a drone: as its law of motion says, and as air is on a breezy night; in the other voyages it is steady.
WINDS = {
    "drone in a changing wind": walking_wind(LAWS["drone"].drift_walk),
    "drone in turbulence of 0.7 m/s": turbulent_wind(0.7),
    "drone, wind swings in 20 minutes": swinging_wind(0.3, 1200),
    "drone, wind swings in 40 minutes": swinging_wind(0.3, 2400),
}
# Drones whose wind is said to change by so much in ten minutes, m/s; the second's changes as the law has it.
# Rovers without odometry: that halt now and then, that seem to, and that halt without showing it.
COURSE = halting(sway=0.1)
DRIVES = {
    "rover that halts": COURSE,
    "rover that halts, drives running": idling(COURSE),
    "rover that halts, curving": halting(),
    "rover that halts, curving, drives running": idling(halting()),
    "rover on an even floor": even(shaking_turns=True),
    "rover on a ferry": on_a_ferry(),
    "rover in lifts": on_carriers([0.0, 0.0, 1.0]),
    "rover on platforms": on_carriers([0.1, 0.0, 0.0]),
}
CADENCE_S, RATE_HZ = 2.0, 50.0
# of a voyage in the table of bench.py
VOYAGE_S = 300.0


def navigated(record: MadeVoyage, vehicle: str, model: ImuModel, velocity: VelocityLog | None) -> Voyage:
    """The answer for a voyage whose mount is known to 1 deg."""
    vessel = Vessel(
        vehicle=vehicle,
        model=model,
        camera_to_body=CAMERA_TO_BODY,
        mount_stddev=np.radians(1.0),
        atmosphere=Atmosphere(pressure_pa=0.0),
        clock_stddev_s=1e-3,
    )
    return adjust_voyage(record.frames, record.imu, velocity, vessel)


def scores(record: MadeVoyage, voyage: Voyage) -> np.ndarray:
    """Mean over the last quarter (4,): error m, sigma m an axis, NEES, error of the heading arcsec."""
    rows = []
    for k in range(3 * len(record.frames) // 4, len(record.frames)):
        fix = voyage.fixes[k]
        off = np.array([
            (fix.longitude - record.longitude[k]) * EARTH_M * np.cos(record.latitude[k]),
            (fix.latitude - record.latitude[k]) * EARTH_M,
        ])  # fmt: skip
        claim = fix.covariance[:2, :2]
        turn = (fix.heading - record.heading[k] + np.pi) % (2 * np.pi) - np.pi
        nees = off @ np.linalg.solve(claim, off)
        rows.append([np.linalg.norm(off), np.sqrt(np.trace(claim) / 2), nees, abs(turn) / ARCSEC])
    return np.mean(rows, axis=0)


def scored(vehicle: str, grade: str, seconds: float, seed: int) -> tuple[np.ndarray, float]:
    """The scores of one voyage, and its CPU time in s."""
    model, drive = GRADES[grade], DRIVES.get(vehicle)
    about = {"model": model, "rate_hz": RATE_HZ, "cadence_s": CADENCE_S, "more_wind": WINDS.get(vehicle)}
    vehicle = vehicle.split()[0].rstrip(",")
    record = made(vehicle, seconds, 1000 + seed, drive=drive, **about)
    begin = time.process_time()
    velocity = None if vehicle == "drone" or drive is not None else record.velocity
    found = scores(record, navigated(record, vehicle, model, velocity))
    return found, time.process_time() - begin


def rows(options) -> Iterator[Row]:
    """The rows of bench.py: one voyage of each vehicle."""
    for vehicle in VEHICLES[:1] if options.quick else VEHICLES:
        _, spent_s = scored(vehicle, "industrial", VOYAGE_S, 0)
        what = f"a voyage of {VOYAGE_S:g} s, {vehicle}"
        yield Row(what, Cost(1000 * spent_s), "real time", Cost(1000 * VOYAGE_S))


def options(parser) -> None:
    parser.add_argument("--voyages", type=int, default=8, help="of each kind")
    parser.add_argument("--first", type=int, default=0, metavar="SEED", help="of the first voyage (0)")
    parser.add_argument("--seconds", type=float, default=1200.0)
    usual = tuple(dict.fromkeys([*VEHICLES, *WINDS]))
    parser.add_argument("--vehicles", nargs="+", choices=(*usual, *DRIVES), default=usual)


def run(args) -> int:
    print(
        "| vehicle | IMU | error m | claimed m | NEES | heading arcsec | CPU s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        sep="\n",
    )
    seeds = range(args.first, args.first + args.voyages)
    for vehicle in args.vehicles:
        for grade in GRADES:
            voyages = [scored(vehicle, grade, args.seconds, seed) for seed in seeds]
            error, claimed, nees, heading = np.mean([found for found, _ in voyages], axis=0)
            spent_s = np.mean([spent for _, spent in voyages])
            print(
                f"| {vehicle} | {grade} | {error:.0f} | {claimed:.0f} | {nees:.2f} | {heading:.0f} "
                f"| {spent_s:.1f} |",
                flush=True,
            )
