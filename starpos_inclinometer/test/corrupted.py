# SPDX-License-Identifier: Apache-2.0
"""Streams of the microcontroller's lines with errors in them, by the million."""

import numpy as np

from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_testing import emulator

RATE_HZ = 50
HEX = np.frombuffer(b"0123456789ABCDEF", np.uint8)
IDENTITY = emulator.identity_line(RATE_HZ, 14)


def lines(n, rng, first=0):
    """n lines of an instrument at rest at RATE_HZ, (n, SAMPLE_LINE) bytes."""
    codes = 0x812345 + rng.normal(0, 770, (n, 2)).round().astype(int)
    made = (
        emulator.sample_line(first + k, 1000 * (first + k) // RATE_HZ, x, y, 175, 0)
        for k, (x, y) in enumerate(codes.tolist())
    )
    return np.frombuffer(b"".join(made), np.uint8).reshape(n, mcu_protocol.SAMPLE_LINE)


def flipped(sent, rng, share):
    """The lines with this share of their bits flipped."""
    chosen = rng.integers(0, 1 << 32, (*sent.shape, 8), np.uint32) < share * 2**32
    return sent ^ np.packbits(chosen, axis=-1)[..., 0]


def forged(sent, rng):
    """The lines with 2 to 6 of their digits replaced and the right checksum of that: what a checksum lets pass."""
    digits = np.flatnonzero(np.isin(sent[0], HEX))[:-4]
    made = []
    for line in sent.copy():
        where = rng.choice(digits, rng.integers(2, 7), replace=False)
        line[where] = rng.choice(HEX, len(where))
        made.append(mcu_protocol.frame(line[1:-7].tobytes()))
    return np.frombuffer(b"".join(made), np.uint8).reshape(sent.shape)


def as_sent(sample):
    """The line of a sample that was believed."""
    return emulator.sample_line(
        sample.sequence, sample.milliseconds, sample.x, sample.y, sample.temperature, sample.status
    )


def decode(decoder, received, first=0):
    """All that is believed of lines (n, bytes) that come at RATE_HZ, a second of them at a time."""
    for begin in range(0, len(received), RATE_HZ):
        part = received[begin : begin + RATE_HZ]
        moment = Moment((first + begin + len(part)) / RATE_HZ, 0)
        for arrival in decoder.decode(part.tobytes(), moment):
            yield arrival.sample
        if decoder.command() == mcu_protocol.identify_command():
            decoder.decode(IDENTITY, moment)
