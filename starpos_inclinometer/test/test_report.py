# SPDX-License-Identifier: Apache-2.0
"""What a health and the samples' flags become in /diagnostics; samples to readings over resets and other rates."""

import math

import numpy as np
import pytest
from reader import mcu_source

from starpos.messages.tilt import GAP, OUT_OF_RANGE, SATURATED, STUCK
from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import Moment, Step
from starpos_inclinometer.node import Reporter
from starpos_inclinometer.sources.mcu import McuDecoder
from starpos_inclinometer.sources.mcu_protocol import Identity, Sample, frame
from starpos_inclinometer.sources.source import Arrival, Counts, Health, Phase
from starpos_testing.emulator import Mcu

VALUES = defaults_of("inclinometer")


def health(phase=Phase.RECEIVING, **more):
    return Health(phase=phase, sentence="as it is", **more)


@pytest.mark.parametrize(
    ("state", "step", "flags", "level", "text"),
    [
        (health(), None, [0, GAP], 0, "as it is"),
        (health(Phase.ABSENT), None, [], 2, "as it is"),
        (health(Phase.SILENT), None, [STUCK], 2, "as it is"),
        (health(Phase.GARBLED), None, [], 2, "as it is"),
        (health(Phase.MOVING), None, [], 1, "as it is"),
        (health(), None, [0, STUCK, 0], 2, "stuck"),
        (health(), None, [SATURATED | OUT_OF_RANGE], 1, "beyond the sensor's range"),
        (health(), None, [OUT_OF_RANGE], 1, "beyond the sensor's range"),
        (health(complaint="refused"), None, [0], 1, "refused"),
        (health(), Step(2.0, 80.0), [0], 1, "+2.000 s"),
        (health(), Step(2.0, 60.0), [0], 0, "as it is"),
        (health(counts=Counts(good=90, crc_errors=5, lost=5)), None, [0], 1, "10 of 100"),
        (health(counts=Counts(good=97, crc_errors=3)), None, [0], 0, "as it is"),
    ],
)
def test_the_worst_is_told(state, step, flags, level, text):
    reporter = Reporter()
    for f in flags:
        reporter.count(f)
    status = reporter.report(state, step, 100.0)
    assert (status.level, text in status.message) == (level, True), status.message
    assert status.values["samples since the last report"] == len(flags)


def test_each_report_counts_what_came_since_the_one_before():
    reporter = Reporter()
    for f in (STUCK, STUCK | SATURATED, 0):
        reporter.count(f)
    counts = Counts(good=50, crc_errors=50)
    first = reporter.report(health(counts=counts), None, 0.0).values
    assert [first[f"of these {n}"] for n in ("stuck", "saturated", "out of range")] == [2, 1, 0]
    second = reporter.report(health(counts=counts), None, 1.0)
    assert second.level == 0 and second.values["of these stuck"] == 0


def test_a_rate_that_the_microcontroller_refuses_is_told():
    source = mcu_source(VALUES | {"rate": 50})
    assert source.health().complaint == ""
    source._decoder.decode(frame(b"N,03"), Moment(0.0, 0))
    assert "refused 50 Hz" in source.health().complaint


def arrival(k, at_s, identity=None, **more):
    sample = Sample(
        sequence=k,
        milliseconds=20 * k,
        x=0x800000 + 37 * k % 1009,
        y=0x800000 + k,
        temperature=175,
        status=0,
        **more,
    )
    return Arrival(sample, Moment(at_s, round(at_s * 1e9)), identity)


def identity(rate_hz, delay_ms=14):
    return Identity(version=1, firmware=0x0100, unit=7, rate_hz=rate_hz, delay_ms=delay_ms)


def test_another_rate_is_another_noise():
    tilts = mcu_source(VALUES)
    tilts.read([arrival(k, 0.02 * k, identity(50)) for k in range(500)])
    assert tilts.sensor.noise.sigma is not None
    tilts.read([arrival(500, 10.0, identity(50))])
    assert tilts.sensor.noise.sigma is not None
    tilts.read([arrival(501, 10.1, identity(10))])
    assert tilts.sensor.noise.sigma is None


def played(rates_hz, at_once):
    """(stamp less the truth of each sample, s), of a decoder and an emulated MCU that is set to one rate after another.

    at_once: the samples are taken when all are there, not each as it comes.
    """
    mcu = Mcu(rate_hz=10, noise_rad=0.0035, seed=1)
    decoder, tilts = McuDecoder(10), mcu_source(VALUES)
    now_s, waiting, errors, arrivals = 0.0, mcu.reset(0.0), [], []
    for rate_hz in rates_hz:
        decoder.wanted_rate_hz = rate_hz
        for _ in range(12):
            arrivals += decoder.decode(waiting, Moment(now_s, round(now_s * 1e9)))
            waiting = mcu.receive(decoder.command())
            arrivals += decoder.decode(waiting, Moment(now_s, round(now_s * 1e9)))
            now_s = mcu.due
            waiting = mcu.sample()
            if not at_once:
                errors += _errors(tilts, arrivals)
                arrivals = []
    return errors + _errors(tilts, arrivals)


def _errors(tilts, arrivals):
    """The emulated MCU was started at 0 and its clock is right: its milliseconds are the truth."""
    readings = tilts.read(arrivals)
    return [r.stamp_ns * 1e-9 - a.sample.milliseconds * 1e-3 for r, a in zip(readings, arrivals, strict=True)]


@pytest.mark.parametrize("at_once", [False, True])
def test_a_change_of_rate_moves_no_stamp(at_once):
    """At 1 Hz a line leaves 0.45 s later after its sample than at 10 Hz: that is the rate's, not lateness."""
    errors = played((10, 1, 50, 5, 1, 10), at_once)
    assert len(errors) >= 66
    assert np.abs(errors).max() < 2e-3


def test_samples_before_the_microcontroller_has_said_its_rate_move_none_after():
    """It had another rate from before, and the sensor is unknown: they are left out, and the losses are counted."""
    tilts = mcu_source(VALUES)
    assert tilts.read([arrival(k, 0.02 * k + 0.014, lost=k == 0) for k in range(5)]) == []
    later = tilts.read([arrival(k, 0.02 * k + 0.014, identity(50)) for k in range(5, 20)])
    line_s = 430 / 38400
    assert [bool(r.flags & GAP) for r in later] == [True] + [False] * 14
    assert [r.stamp_ns * 1e-9 + line_s for r in later] == pytest.approx(
        [0.02 * k for k in range(5, 20)], abs=1e-6
    )


def test_after_a_reset_or_a_new_connection_the_clocks_are_related_anew():
    """The MCU's milliseconds go on by chance where they were, 1 s off: that is no lateness."""
    tilts = mcu_source(VALUES)
    tilts.read([arrival(k, 0.02 * k, identity(50)) for k in range(500)])
    (reading,) = tilts.read([arrival(500, 11.0, identity(50), broken=True)])
    assert 11.0 - reading.stamp_ns * 1e-9 == pytest.approx(0.014 + 43 * 10 / 38400, abs=1e-6)


def test_the_latency_is_the_devices_or_the_parameters():
    for latency, delay_ms, expected in ((math.nan, 14, 0.014), (math.nan, 9, 0.009), (0.1, 14, 0.1)):
        tilts = mcu_source(VALUES | {"latency": latency})
        (reading,) = tilts.read([arrival(0, 5.0, identity(50, delay_ms))])
        assert 5.0 - reading.stamp_ns * 1e-9 == pytest.approx(expected + 430 / 38400, abs=1e-6)
