# SPDX-License-Identifier: Apache-2.0
"""Table of docs/navigation.md: how well place and heading are known under way, and whether their claims hold.

`benchmark_navigation.py [--voyages N] [--seconds S]`.  Voyages of starpos_testing.voyages with odometry or a log (none
for the drone), a frame every 2 s.  Means of the last quarter: error of the place, 1 sigma an axis as claimed, NEES of the
place (2 where claims hold), error of the heading; CPU time of a voyage without identification.
"""

import argparse
import time

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.navigation.imu import ImuModel
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import Voyage, navigate
from starpos.units import ARCSEC
from starpos_testing.voyages import CAMERA_TO_BODY, INDUSTRIAL, TACTICAL, MadeVoyage, made

EARTH_M = 6.37e6
GRADES = {"industrial": INDUSTRIAL, "tactical": TACTICAL}
CADENCE_S, RATE_HZ = 2.0, 50.0


def navigated(record: MadeVoyage, vehicle: str, model: ImuModel) -> Voyage:
    """The answer for a voyage whose mount is known to 1 deg."""
    vessel = Vessel(
        vehicle=vehicle,
        model=model,
        camera_to_body=CAMERA_TO_BODY,
        mount_stddev=np.radians(1.0),
        atmosphere=Atmosphere(pressure_pa=0.0),
        clock_stddev_s=1e-3,
    )
    return navigate(record.frames, record.imu, None if vehicle == "drone" else record.velocity, vessel)


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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--voyages", type=int, default=8, help="of each kind")
    parser.add_argument("--seconds", type=float, default=1200.0)
    args = parser.parse_args()
    print(
        "| vehicle | IMU | error m | claimed m | NEES | heading arcsec | CPU s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        sep="\n",
    )
    for vehicle in ("rover", "ship", "drone", "parked"):
        for grade, model in GRADES.items():
            found, spent = [], 0.0
            for seed in range(args.voyages):
                record = made(
                    vehicle, args.seconds, 1000 + seed, model=model, rate_hz=RATE_HZ, cadence_s=CADENCE_S
                )
                begin = time.process_time()
                found.append(scores(record, navigated(record, vehicle, model)))
                spent += time.process_time() - begin
            error, claimed, nees, heading = np.mean(found, axis=0)
            print(
                f"| {vehicle} | {grade} | {error:.0f} | {claimed:.0f} | {nees:.2f} | {heading:.0f} "
                f"| {spent / args.voyages:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
