# SPDX-License-Identifier: Apache-2.0
"""How often the guard calls a good GNSS wrong: drives whose errors are drawn from what their sensors state.

    python tools/benchmarks/gnss_false_alarms.py [--frames 300000] [--seed 1]

Prints, for each inclinometer, the frames, those that doubt, the alarms, and the frames that these last, then the rate of
all alarms with its upper limit (95 %).  Exit status 1 where that limit is above one in 1e5 frames.
"""

import argparse
import sys
from collections import Counter

import numpy as np
from scipy import stats

from starpos.earth.vertical import Deflection
from starpos.gnss.watch import GnssStatus, GnssWatch
from starpos.instrument import sensors
from starpos_testing.gnss_drives import GnssDrive

# drives to a sensor: a rover that stops, one that takes frames faster, a good sensor, and one with an error of each pose
DRIVES = {
    "sca100t_calibrated, a stop every 2 min": GnssDrive(errors=sensors.presets()["sca100t_calibrated"]),
    "sca100t_calibrated, 30 frames a stop": GnssDrive(
        errors=sensors.presets()["sca100t_calibrated"], frames=30, cadence_s=1.0
    ),
    "nivel210": GnssDrive(errors=sensors.presets()["nivel210"], lean_deg=0.03),
    "scl3300": GnssDrive(errors=sensors.presets()["scl3300"]),
}
MOST = 1e-5


def counted(drive: GnssDrive, frames: int, rng: np.random.Generator) -> Counter:
    """Frames by status, and alarms."""
    number: Counter = Counter()
    while number["frames"] < frames:
        watch, before = GnssWatch(drive.instrument, Deflection(stddev_arcsec=drive.deflection_arcsec)), ""
        for moment in drive.moments(rng):
            watch.advance(moment.sighting)
            check = watch.judge(moment.sighting, moment.gnss)
            watch.learn(moment.sighting, moment.gnss, check)
            number["frames"] += 1
            number[check.status] += 1
            number["alarms"] += check.status == GnssStatus.DISAGREES != before
            before = check.status
    return number


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=300_000, help="frames of all together (300000)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    total: Counter = Counter()
    for k, (name, drive) in enumerate(DRIVES.items()):
        number = counted(drive, options.frames // len(DRIVES), np.random.default_rng([options.seed, k]))
        total += number
        print(
            f"{name}: {number['frames']} frames, {number['agrees']} agree, {number['doubtful']} doubt, "
            f"{number['alarms']} alarms that last {number[GnssStatus.DISAGREES]} frames",
            flush=True,
        )
    most = stats.chi2.ppf(0.95, 2 * (total["alarms"] + 1)) / 2 / total["frames"]
    print(f"{total['alarms']} alarms in {total['frames']} frames: at most {most:.1e} a frame (95 %)")
    return int(most > MOST)


if __name__ == "__main__":
    sys.exit(main())
