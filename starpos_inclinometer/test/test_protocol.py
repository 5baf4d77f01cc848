# SPDX-License-Identifier: Apache-2.0
"""The protocol against published check values, and the parser against everything a line can do to it."""

import re
from binascii import crc_hqx
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import Identity, LineParser, Reason, Refusal, Sample
from starpos_inclinometer.sources.source import Counts
from starpos_testing import emulator

PROTOCOL = Path(__file__).parent.parent / "PROTOCOL.md"


def lines(n, start=0):
    return [
        emulator.sample_line(start + i, 100 * (start + i), 0x800000 + 37 * i, 0x7F0000 + i, 0xAF, 0)
        for i in range(n)
    ]


def crc_as_avr_libc_documents_it(data, crc=0):
    """The C of _crc_xmodem_update's documentation, in Python."""
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def test_checksum_gives_the_published_check_values():
    # CRC-16/XMODEM
    assert mcu_protocol.checksum(b"123456789") == 0x31C3
    # CRC-16/CCITT-FALSE (IBM-3740): same polynomial, other start.
    assert crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    for text in (b"", b"T", b"T,0012,0000070A,800000,A8C9C5,AF,00", bytes(range(256))):
        assert mcu_protocol.checksum(text) == crc_as_avr_libc_documents_it(text)


def test_the_documents_example_is_a_line_of_this_protocol():
    example = re.search(r"\$T,[0-9A-F,]+\*[0-9A-F]{4}", PROTOCOL.read_text())[0].encode() + b"\r\n"
    (sample,) = LineParser().parse(example)
    assert sample == Sample(
        sequence=0x12, milliseconds=0x70A, x=0x800000, y=0xA8C9C5, temperature=0xAF, status=0
    )
    assert example == emulator.sample_line(0x12, 0x70A, 0x800000, 0xA8C9C5, 0xAF, 0)
    assert len(example) == mcu_protocol.SAMPLE_LINE


def test_messages_round_trip():
    identity = Identity(version=1, firmware=0x0102, unit=0xDEADBEEF, rate_hz=10, delay_ms=20)
    stream = emulator.identity_line(**asdict(identity)) + lines(1)[0] + emulator.refusal_line(Reason.UNKNOWN)
    messages = LineParser().parse(stream)
    assert messages == [
        identity,
        Sample(sequence=0, milliseconds=0, x=0x800000, y=0x7F0000, temperature=0xAF, status=0),
        Refusal(Reason.UNKNOWN),
    ]
    assert max(map(len, stream.splitlines(keepends=True))) <= mcu_protocol.MAX_LINE


def test_chunks_of_any_size_give_the_same_samples():
    stream = b"".join(lines(50))
    whole = LineParser().parse(stream)
    assert len(whole) == 50
    for size in (1, 2, 7, 42, 43, 44, 1000):
        parser = LineParser()
        pieces = [m for i in range(0, len(stream), size) for m in parser.parse(stream[i : i + size])]
        assert pieces == whole
        assert parser.counts == Counts(good=50)


def test_resynchronises_after_garbage_and_counts_it():
    parser = LineParser()
    a, b, c = lines(3)
    garbage = b"\x00\xff$T,00*\r\n$$$*"
    assert [m.sequence for m in parser.parse(garbage + a + garbage + b[:20] + c)] == [0, 2]
    assert (parser.counts.good, parser.counts.garbage_bytes) == (2, 2 * len(garbage) + 20)


def test_a_stray_start_does_not_cost_the_line_after_it():
    line = lines(1)[0]
    parser = LineParser()
    assert parser.parse(b"$" + b"x" * 30 + line[:30]) == []
    assert len(parser.parse(line[30:])) == 1


def test_memory_stays_bounded_whatever_comes():
    parser = LineParser()
    for chunk in (b"$" * 10_000, b"$" + b"A" * 10_000, b"x" * 10_000, b"$T,"):
        assert parser.parse(chunk) == []
        assert len(parser._rest) < mcu_protocol.MAX_LINE
    assert [m.sequence for m in parser.parse(lines(1)[0])] == [0]


def test_wrong_checksum_and_unknown_line_are_counted_and_dropped():
    parser = LineParser()
    line = lines(1)[0]
    assert parser.parse(line.replace(b"800000", b"800001")) == []
    assert parser.parse(mcu_protocol.frame(b"Z,01") + mcu_protocol.frame(b"T,1,2,3")) == []
    assert (parser.counts.good, parser.counts.crc_errors, parser.counts.malformed) == (0, 1, 2)


@pytest.mark.parametrize(
    "body",
    [
        # The first sample has number 0.
        b"T,0001,0000070A,800000,A8C9C5,AF,08",
        # No such rate.
        b"I,01,0100,00000000,00,0014",
        b"I,01,0100,00000000,33,0014",
        # At 50 Hz a line is not 256 ms late.
        b"I,01,0100,00000000,32,0100",
    ],
)
def test_right_checksum_but_impossible_fields_are_no_message(body):
    parser = LineParser()
    assert parser.parse(mcu_protocol.frame(body)) == [] and parser.counts.malformed == 1


def test_random_bytes_never_raise_and_give_nothing():
    rng = np.random.default_rng(1)
    parser = LineParser()
    alphabet = np.frombuffer(b"$*,\r\nTINR0123456789ABCDEF", np.uint8)
    for data in (rng.integers(0, 256, 100_000, np.uint8), rng.choice(alphabet, 100_000)):
        for chunk in np.array_split(data, 777):
            assert parser.parse(chunk.tobytes()) == []
    assert parser.counts.garbage_bytes > 190_000


@pytest.mark.parametrize("share", [0.001, 0.01, 0.05])
def test_flipped_bits_never_make_a_wrong_sample(share):
    rng = np.random.default_rng(2)
    sent = lines(10_000)
    truth = dict(enumerate(sent))
    data = np.frombuffer(b"".join(sent), np.uint8)
    flips = np.packbits(rng.random((len(data), 8)) < share, axis=1)[:, 0]
    parser = LineParser()
    samples = parser.parse((data ^ flips).tobytes())
    for s in samples:
        line = emulator.sample_line(s.sequence, s.milliseconds, s.x, s.y, s.temperature, s.status)
        assert line == truth[s.sequence]
    clean = sum(not line.any() for line in flips.reshape(len(sent), -1))
    assert clean <= len(samples) <= clean + 3
    assert parser.counts.crc_errors > 0


def test_every_single_and_double_bit_error_in_a_line_is_found():
    line = lines(1, start=1234)[0]
    bits = range(8 * len(line))
    for i in bits:
        for j in (*bits[:i:17], None):
            bad = bytearray(line)
            bad[i // 8] ^= 1 << i % 8
            if j is not None:
                bad[j // 8] ^= 1 << j % 8
            assert LineParser().parse(bytes(bad)) == []


def test_commands():
    assert mcu_protocol.identify_command() == emulator.frame(b"Q")
    assert mcu_protocol.rate_command(50) == emulator.frame(b"R,32")
