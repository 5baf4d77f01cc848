# SPDX-License-Identifier: Apache-2.0
"""Half a million bytes of everything a line may bring, through decoder, clock and sensor; and memory that stays."""

import gc
import math
import random
import tracemalloc

import numpy as np
from corrupted import IDENTITY, RATE_HZ, as_sent, lines
from reader import mcu_source

from starpos.parameters.table import defaults_of
from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.ascii_line import LineDecoder
from starpos_inclinometer.sources.mcu import McuDecoder

VALUES = defaults_of("inclinometer")
# Bytes of each kind.
PART = 170_000


class Host:
    """All of the driver behind the port, fed in chunks of any size."""

    def __init__(self):
        self.decoder = McuDecoder(RATE_HZ)
        self.tilts = mcu_source(VALUES)
        self.samples = []
        self.now_s = 0.0
        self.take(IDENTITY)

    def take(self, data):
        moment = Moment(self.now_s, 1_700_000_000_000_000_000 + round(self.now_s * 1e9))
        arrivals = self.decoder.decode(data, moment)
        self.samples += [a.sample for a in arrivals]
        for reading in self.tilts.read(arrivals):
            assert all(map(math.isfinite, (reading.x, reading.y, *reading.covariance)))
            xx, xy, yx, yy = reading.covariance
            assert xx > 0 and yy > 0 and xx * yy > xy * yx and reading.stamp_ns > 0

    def feed(self, data, rng, seconds):
        begin, self_s = 0, self.now_s
        while begin < len(data):
            chunk = data[begin : begin + rng.randrange(1, 200)]
            begin += len(chunk)
            self.now_s = self_s + seconds * begin / len(data)
            self.take(chunk)
            if self.decoder.command() == mcu_protocol.identify_command():
                self.take(b"\r\n" + IDENTITY)


def mutated(line, rng):
    """A line with bytes changed, inserted, removed, doubled or swapped."""
    line = bytearray(line)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(line)) if line else 0
        kind = rng.randrange(5)
        if kind == 0 and line:
            line[at] = rng.randrange(256)
        elif kind == 1:
            line[at:at] = rng.randbytes(rng.randrange(1, 4))
        elif kind == 2:
            del line[at : at + rng.randrange(1, 8)]
        elif kind == 3:
            line += line[at:]
        else:
            line = line[at:] + line[:at]
    return bytes(line)


def nonsense(rng):
    """A line of right form and checksum whose fields are anything."""
    h = rng.randbytes(14).hex().upper()
    body = rng.choice(
        (
            f"T,{h[:4]},{h[4:12]},{h[12:18]},{h[18:24]},{h[24:26]},{h[26:28]}",
            f"I,01,0100,00000007,{h[:2]},{h[2:6]}",
            f"N,{h[:2]}",
            f"T,{h[:4]},{h[4:12]}",
            h[: rng.randrange(1, 28)],
        )
    )
    return mcu_protocol.frame(body.encode())


def test_half_a_million_fuzzed_bytes_raise_nothing_and_none_is_believed():
    rng, host = random.Random(1), Host()
    sent = lines(3 * PART // mcu_protocol.SAMPLE_LINE, np.random.default_rng(1))
    said = set(map(bytes, sent))
    whole = [bytes(line) for line in sent]
    third = len(whole) // 3
    spoiled = {
        "random bytes": lambda line: line + rng.randbytes(len(line)),
        "mutations": lambda line: mutated(line, rng) if rng.random() < 0.5 else line,
        "nonsense": lambda line: line + (nonsense(rng) if rng.random() < 0.3 else b""),
    }
    fed = 0
    for k, (kind, spoil) in enumerate(spoiled.items()):
        stream = b"".join(map(spoil, whole[k * third : (k + 1) * third]))
        fed += len(stream)
        before = len(host.samples)
        host.feed(stream, rng, third / RATE_HZ)
        got = host.samples[before:]
        wrong = [s for s in got if as_sent(s) not in said]
        assert wrong == [], kind
        assert len(got) > 0.4 * third, kind
    assert fed > 500_000
    assert host.decoder.counts.restarts == 0


def test_half_a_million_random_bytes_alone_are_nothing():
    rng = np.random.default_rng(2)
    alphabet = np.frombuffer(b"$$$*,\r\nTIN0123456789ABCDEF", np.uint8)
    for stream in (rng.integers(0, 256, 250_000, np.uint8), rng.choice(alphabet, 250_000)):
        host = Host()
        host.feed(stream.tobytes(), random.Random(3), 100.0)
        assert host.samples == []


def grown(feed, rounds):
    """Bytes by which Python's memory grows from one half of a number of rounds to the other."""
    sizes = []
    feed(0)
    # what is there before is looked through once
    gc.collect()
    gc.freeze()
    tracemalloc.start()
    try:
        for k in range(1, rounds + 1):
            feed(k)
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
        gc.unfreeze()
    return max(sizes[rounds // 2 :]) - max(sizes[: rounds // 2])


def test_the_drivers_memory_does_not_grow():
    """A leak of five bytes a sample would show: 8 rounds of 1000 samples, a third of the lines spoiled."""
    rng, host = random.Random(4), Host()
    per_round = 1000

    def feed(k):
        sent = lines(per_round, np.random.default_rng(k), per_round * k)
        stream = b"".join(mutated(line, rng) if rng.random() < 0.3 else bytes(line) for line in sent)
        host.feed(stream, rng, per_round / RATE_HZ)
        host.samples.clear()

    assert grown(feed, 8) < 5 * 4 * per_round


def test_the_ascii_decoders_memory_does_not_grow():
    decoder = LineDecoder(VALUES)
    rng = random.Random(5)

    def feed(k):
        for i in range(2000):
            line = b"1.%03d,-2.%03d\r\n" % (rng.randrange(20), rng.randrange(20))
            if rng.random() < 0.3:
                line = mutated(line, rng)
            decoder.decode(line, Moment(200.0 * k + 0.1 * i, 0))

    assert grown(feed, 6) < 5 * 3 * 2000
