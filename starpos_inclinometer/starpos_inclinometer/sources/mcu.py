# SPDX-License-Identifier: Apache-2.0
"""The source `serial`: tilts and times of pulses from the microcontroller's lines, and the commands that it gets.

The host's clock is good enough to say which second a receiver's pulse begins. Between two pulses the board's clock
counts, at the rate that the last two have shown: so an edge has the receiver's time, whatever the serial line and the
host's clock add.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rclpy.time import Time

from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import TIME_UNKNOWN, Reading
from starpos_inclinometer.clock import ArrivalFilter, Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import (
    Continuity,
    Gate,
    Identity,
    Input,
    Pulse,
    Reason,
    Refusal,
    SensorKind,
    mcu_follows,
)
from starpos_inclinometer.sources.serial_link import SerialLink, port_refusal
from starpos_inclinometer.sources.source import Arrival, Health, Surroundings
from starpos_inclinometer.sources.tilts import (
    BoardSensor,
    Sca100t,
    Scl3300,
)
from starpos_interfaces import msg

# Error of a time through the serial line: an adapter's latency timer of 16 ms, evenly distributed.
LINE_STDDEV_S = 0.016 / 12**0.5
# Error of one by the receiver's second: the handler's latency, and a resonator's drift within a second.
SECOND_STDDEV_S = 2e-5
# A pulse that the host's clock sees further than this from a whole second has no number.
MAX_OFF_S = 0.3
# A ceramic resonator is off by less.
MAX_RATE_ERROR = 0.01
# The board's clock is not trusted longer than this after a pulse.
MAX_AGE_S = 2.5
QUEUE = 256


class PulseTimes:
    """Dates the edges of one board: their stamps are the host's time, or UTC by the receiver's second (disciplined)."""

    def __init__(self) -> None:
        self.dated = self.undated = 0
        # The state of the receiver's second, for a person to read.
        self.second = "no pulse yet"
        self._queue: deque[msg.Pulse] = deque(maxlen=QUEUE)
        self._sequences: dict[int, tuple[int, int]] = {}
        # (device s, UTC s) of the last two pulses that fit each other.
        self._seconds: deque[tuple[float, int]] = deque(maxlen=2)

    def restart(self) -> None:
        """Forget the receiver's pulses, because the board's clock was reset."""
        self._seconds.clear()

    def fetch(self) -> list[msg.Pulse]:
        """Return the edges that were dated since the last call, in order."""
        dated = list(self._queue)
        self._queue.clear()
        return dated

    def date(self, pulse: Pulse, moment: Moment, edge_s: float | None) -> None:
        """Date an edge whose line came at a moment; edge_s: when it was, on the monotonic clock, by the lines alone."""
        sequence = self._continued(pulse)
        device_s = pulse.milliseconds * 1e-3 + pulse.microseconds * 1e-6
        if edge_s is None:
            self.undated += 1
            return
        edge_s += pulse.microseconds * 1e-6
        host_ns = moment.host_ns - round((moment.monotonic_s - edge_s) * 1e9)
        if pulse.input == Input.PPS:
            self._follow(device_s, host_ns)
        utc_s = self._by_second(device_s)
        stamp_ns = host_ns if utc_s is None else utc_s[0] * 10**9 + round(utc_s[1] * 1e9)
        self.dated += 1
        dated = msg.Pulse(
            input=pulse.input,
            rising=pulse.rising,
            sequence=sequence,
            bounces=pulse.bounces,
            device_time=device_s,
            stamp_stddev=LINE_STDDEV_S if utc_s is None else SECOND_STDDEV_S,
            disciplined=utc_s is not None,
        )
        dated.header.stamp = Time(nanoseconds=max(stamp_ns, 0)).to_msg()
        self._queue.append(dated)

    def _continued(self, pulse: Pulse) -> int:
        """Number of the edge, counted on over wraps; after a reset of the board it jumps, as for lost edges."""
        raw, sequence = self._sequences.get(pulse.input, (pulse.number - 1, -1))
        sequence = (sequence + ((pulse.number - raw) & 0xFF or 0x100)) & 0xFFFFFFFF
        self._sequences[pulse.input] = (pulse.number, sequence)
        return sequence

    def _follow(self, device_s: float, host_ns: int) -> None:
        """Take a pulse of the receiver as the begin of the second that the host's clock says."""
        second = (host_ns + 5 * 10**8) // 10**9
        off_s = (host_ns - second * 10**9) * 1e-9
        if abs(off_s) > MAX_OFF_S:
            self._seconds.clear()
            self.second = (
                f"the host's clock is {off_s:+.2f} s off the receiver's pulses, or more: set it, to know which second "
                "each begins"
            )
            return
        if self._seconds:
            before_s, before = self._seconds[-1]
            if not _agree(device_s - before_s, second - before):
                # Either may be wrong; the next one decides.
                self._seconds.clear()
        self._seconds.append((device_s, second))
        self.second = f"kept; the host's clock is off by {off_s * 1e3:+.0f} ms, the line's latency included"

    def _by_second(self, device_s: float) -> tuple[int, float] | None:
        """UTC of a time of the board, whole seconds and the rest; None without two pulses just before it."""
        if len(self._seconds) < 2:
            return None
        (first_s, first), (last_s, last) = self._seconds
        if not -1 <= device_s - last_s <= MAX_AGE_S:
            return None
        return last, (device_s - last_s) * (last - first) / (last_s - first_s)


def _agree(device_s: float, seconds: int) -> bool:
    return seconds > 0 and abs(device_s - seconds) <= MAX_RATE_ERROR * seconds


# 8N1: a start bit, eight of data, a stop bit.
BITS_PER_BYTE = 10
# 0.05 deg: of the SCA100T ten times the noise, of the SCL3300 six times.
NEAR_CODES = {SensorKind.SCA100T: 11_000, SensorKind.SCL3300: 2_330}
# Below this determinant of the cross-axis matrix the two axes are not independent.
SMALLEST_DETERMINANT = 0.5


class McuDecoder:
    """Turns the MCU's bytes into the samples that are believed, and asks the MCU for the wanted rate."""

    # As PROTOCOL.md says.
    command_period_s = 1.0
    hint = "check the baud rate, and that this is the inclinometer."

    def __init__(self, rate_hz: int) -> None:
        self.wanted_rate_hz = rate_hz
        self.identity: Identity | None = None
        self.answered = False
        # Whether to ask the MCU for its identity and rate.
        self._ask = True
        self._refused_rate: int | None = None
        self._parser = mcu_protocol.LineParser()
        self.counts = self._parser.counts
        self._gate = Gate(self._follows, NEAR_CODES[SensorKind.SCA100T], self.counts)
        self._continuity = Continuity(self.counts)

    @property
    def period_s(self) -> float:
        return 1 / (self.identity.rate_hz if self.identity else self.wanted_rate_hz)

    @property
    def refused(self) -> bool:
        """Whether the MCU refused the rate that is wanted."""
        return self._refused_rate == self.wanted_rate_hz

    def resume(self) -> None:
        self.identity = None
        self._ask = True
        self._refused_rate = None
        self._parser.forget()
        self._gate.reset()
        self._continuity.resume()

    def decode(self, data: bytes, moment: Moment) -> list[Arrival]:
        believed = []
        self.answered = False
        for message in self._parser.parse(data):
            if isinstance(message, mcu_protocol.Sample):
                believed += self._admit(Arrival(message, moment, self.identity))
                continue
            if isinstance(message, Pulse):
                believed.append(Arrival(message, moment, self.identity))
                continue
            self.answered = True
            if isinstance(message, Identity):
                self.identity = message
                self._gate.tolerance = NEAR_CODES[SensorKind(message.kind)]
                self._ask = False
            elif isinstance(message, Refusal) and message.reason == Reason.OUT_OF_RANGE:
                self._refused_rate = self.wanted_rate_hz
        return believed

    def command(self) -> bytes:
        if self._ask or self.identity is None:
            return mcu_protocol.identify_command()
        if self.identity.rate_hz != self.wanted_rate_hz and not self.refused:
            return mcu_protocol.rate_command(self.wanted_rate_hz)
        return b""

    def _admit(self, arrival: Arrival) -> list[Arrival]:
        doubts = self.counts.implausible + self.counts.restarts
        believed = [
            Arrival(self._continuity.follow(a.sample), a.moment, a.identity)
            for a in self._gate.admit(arrival)
        ]
        if self.counts.implausible + self.counts.restarts != doubts:
            # After a reset the MCU runs at its default rate, perhaps with another firmware; samples that do not fit may
            # come from an unseen reset.
            self._ask = True
        return believed

    def _follows(self, a: Arrival, b: Arrival) -> bool:
        return mcu_follows(a, b, 1000 / self.identity.rate_hz if self.identity else None)


class McuSource(SerialLink[McuDecoder]):
    """The starpos microcontroller on a serial port."""

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        super().__init__(host, values, McuDecoder(values["rate"]))
        self._sensors: dict[int, BoardSensor] = {
            SensorKind.SCA100T: Sca100t(values),
            SensorKind.SCL3300: Scl3300(values),
        }
        # The sensor of the unit that was last heard.
        self.sensor = self._sensors[SensorKind.SCA100T]
        self.filter, self.pulses = ArrivalFilter(), PulseTimes()
        self._line_s = mcu_protocol.SAMPLE_LINE * BITS_PER_BYTE / values["baud"]
        self._rate_hz = self._delay_ms = 0
        # The samples that came before the identity were the first after a gap.
        self._gap = False
        self.configure(values)

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        xx, xy, yx, yy = values["cross_axis"]
        if abs(xx * yy - xy * yx) < SMALLEST_DETERMINANT:
            return (
                "parameter cross_axis must be two different axes (xx, xy, yx, yy), such as [1, 0, 0, 1]; "
                f"{list(values['cross_axis'])} was given."
            )
        return port_refusal(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        for sensor in self._sensors.values():
            sensor.configure(values)
        self._latency_s, self._decoder.wanted_rate_hz = values["latency"], values["rate"]

    def fetch(self) -> list[Reading]:
        return self.read(self.arrivals())

    def fetch_pulses(self) -> list[msg.Pulse]:
        return self.pulses.fetch()

    def read(self, arrivals: list[Arrival]) -> list[Reading]:
        """Convert the arrivals that an `McuDecoder` believed, in order.

        Until the unit has named its sensor, the meaning of its codes is unknown, and they are left out.
        The times of pulses among them go to `pulses`.
        """
        readings = []
        for arrival in arrivals:
            if isinstance(arrival.sample, Pulse):
                self._date_pulse(arrival)
            elif arrival.identity is None:
                self._gap |= arrival.sample.lost > 0 or arrival.sample.broken
            else:
                readings.append(self._reading(arrival))
        return readings

    def _date_pulse(self, arrival: Arrival) -> None:
        """Date an edge through the clocks' relation that the samples have shown."""
        sent_s = self.filter.arrival_s(arrival.sample.milliseconds, arrival.moment.monotonic_s)
        if sent_s is not None:
            sent_s -= self._sample_to_arrival_s()
        self.pulses.date(arrival.sample, arrival.moment, sent_s)

    def _sample_to_arrival_s(self) -> float:
        """Shortest delay from the time in a line to its arrival."""
        return (self._delay_ms * 1e-3 if math.isnan(self._latency_s) else self._latency_s) + self._line_s

    def _follow(self, identity: Identity) -> None:
        """Take over the sensor, rate and delay that the MCU had reported when it sent the next sample."""
        self.sensor = self._sensors[identity.kind]
        # At a lower rate a sample is the mean of more conversions, so its noise is another.
        if identity.rate_hz != self._rate_hz:
            self._rate_hz = identity.rate_hz
            self.sensor.noise.restart()
        # From now on all lines come later, or earlier, by the difference.
        if identity.delay_ms != self._delay_ms:
            self._delay_ms = identity.delay_ms
            self.filter.restart()

    def _reading(self, arrival: Arrival) -> Reading:
        sample, moment = arrival.sample, arrival.moment
        self._follow(arrival.identity)
        sample, self._gap = replace(sample, broken=sample.broken or self._gap), False
        if sample.broken:
            self.filter.restart()
            self.pulses.restart()
        known_s = self.filter.delay(sample.milliseconds, moment.monotonic_s)
        late_s = known_s or 0.0
        stamp_ns = moment.stamp_ns(late_s + self._sample_to_arrival_s())
        reading = self.sensor.measure(sample, moment.monotonic_s - late_s, stamp_ns)
        return reading if known_s is not None else replace(reading, flags=reading.flags | TIME_UNKNOWN)

    def health(self) -> Health:
        if not self._decoder.refused:
            return super().health()
        return replace(
            super().health(),
            complaint=f"the microcontroller refused {self._decoder.wanted_rate_hz} Hz: set another `rate`.",
        )

    def _shown(self) -> Mapping[str, object]:
        identity = self._decoder.identity
        return {
            "clock rate error (ppm)": self.filter.rate_ppm,
            "noise x, y (arcsec)": noise_text(self.sensor.noise.sigma),
            "sensor temperature (deg C)": self.sensor.temperature.celsius(math.nan),
            "pulses, and without a time": f"{self.pulses.dated}, {self.pulses.undated}",
            "receiver's second": self.pulses.second,
            "firmware": f"{identity.firmware >> 8}.{identity.firmware & 255}" if identity else "unknown",
            "sensor": SensorKind(identity.kind).name if identity else "unknown",
            "unit": f"{identity.unit:08X}" if identity else "unknown",
        }
