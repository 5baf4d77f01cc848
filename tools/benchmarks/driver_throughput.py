# SPDX-License-Identifier: Apache-2.0
"""CPU time per sample of the inclinometer's driver, from bytes to readings, a line at a time as they come."""

import time
from collections.abc import Iterator

from table import Cost, Row

from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import HostClock, Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.ascii_line import LineDecoder
from starpos_inclinometer.sources.mcu import McuDecoder, McuSource
from starpos_inclinometer.sources.source import Surroundings
from starpos_testing.emulator import Mcu

RATE_HZ = 50
COMPENSATED = {
    "cross_axis": (1.0, 0.01, -0.01, 1.0),
    "temperature.offset_x": (1e-4, 1e-6, 1e-8),
    "temperature.sensitivity_y": (1e-4, 1e-6, 1e-8),
}


def each(samples: int) -> Iterator[tuple[str, float]]:
    """What is measured, and its CPU time a sample in us."""
    values = defaults_of("inclinometer")
    yield "serial, as it is", serial(samples, values)
    yield "serial, compensated", serial(samples, values | COMPENSATED)
    yield "ascii, lines alone", ascii_lines(samples, values)


def rows(options) -> Iterator[Row]:
    """The rows of bench.py."""
    for what, us in each(5_000):
        yield Row(
            f"inclinometer, a sample, {what}",
            Cost(us / 1000),
            f"real time at {RATE_HZ} Hz",
            Cost(1000 / RATE_HZ),
        )


def serial(samples: int, values) -> float:
    """Measure the CPU time per sample, us."""
    mcu = Mcu(lambda now: (0.1, -0.2), rate_hz=RATE_HZ, seed=1)
    identity = mcu.reset(0.0)
    lines = [mcu.sample() for _ in range(samples)]
    decoder, tilts = McuDecoder(RATE_HZ), McuSource(Surroundings(None, HostClock(), lambda: None), values)
    decoder.decode(identity, Moment(0.0, 0))
    readings, began_s = 0, time.process_time()
    for k, line in enumerate(lines):
        arrivals = decoder.decode(line, Moment(k / RATE_HZ, k * 10**9 // RATE_HZ))
        readings += len(tilts.read(arrivals))
    took_s = time.process_time() - began_s
    assert readings == samples and isinstance(decoder.identity, mcu_protocol.Identity)
    return 1e6 * took_s / samples


def ascii_lines(samples: int, values: dict) -> float:
    """Measure the CPU time per line, from bytes to a believed sample, us."""
    decoder = LineDecoder(values)
    lines = [b"%.3f,%.3f\r\n" % (3 + k % 7 * 1e-3, -11 - k % 5 * 1e-3) for k in range(samples)]
    began_s = time.process_time()
    believed = sum(len(decoder.decode(line, Moment(k / RATE_HZ, 0))) for k, line in enumerate(lines))
    took_s = time.process_time() - began_s
    assert believed == samples
    return 1e6 * took_s / samples
