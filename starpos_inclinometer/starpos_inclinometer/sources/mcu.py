# SPDX-License-Identifier: Apache-2.0
"""The source `serial`: tilts from the microcontroller's lines, and the commands that it gets."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import TIME_UNKNOWN, Reading
from starpos_inclinometer.clock import ArrivalFilter, Moment
from starpos_inclinometer.sources import mcu_protocol
from starpos_inclinometer.sources.mcu_protocol import (
    Continuity,
    Gate,
    Identity,
    Reason,
    Refusal,
    SensorKind,
    mcu_follows,
)
from starpos_inclinometer.sources.serial_link import SerialLink, port_refusal
from starpos_inclinometer.sources.source import Arrival, Counts, LinkSource, Surroundings
from starpos_inclinometer.sources.tilts import (
    BoardSensor,
    Sca100t,
    Sca100tCalibration,
    Scl3300,
    noise_floor_rad,
)

# 8N1: a start bit, eight of data, a stop bit.
BITS_PER_BYTE = 10
# 0.05 deg: of the SCA100T ten times the noise, of the SCL3300 six times.
NEAR_CODES = {SensorKind.SCA100T: 11_000, SensorKind.SCL3300: 2_330}
# Below this determinant of the cross-axis matrix the two axes are not independent.
SMALLEST_DETERMINANT = 0.5


def calibration(values: Mapping[str, Any]) -> Sca100tCalibration:
    """Make the calibration of the sensor from the parameters."""
    return Sca100tCalibration(
        offset_volts=values["offset_volts"],
        sensitivity_volts_per_g=values["sensitivity"],
        divider=values["divider"],
        reference_volts=values["reference_volts"],
        temperature_reference_c=values["temperature.reference"],
        offset_per_c=(values["temperature.offset_x"], values["temperature.offset_y"]),
        sensitivity_per_c=(values["temperature.sensitivity_x"], values["temperature.sensitivity_y"]),
    )


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
        self._gate = Gate(self._follows, NEAR_CODES[SensorKind.SCA100T])
        self._continuity = Continuity()

    @property
    def counts(self) -> Counts:
        parser, gate, continuity = self._parser, self._gate, self._continuity
        return Counts(
            good=parser.good,
            crc_errors=parser.crc_errors,
            malformed=parser.malformed,
            garbage_bytes=parser.garbage_bytes,
            lost=continuity.lost,
            duplicates=gate.duplicates,
            restarts=continuity.restarts,
            implausible=gate.rejected,
        )

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
        rejected = self._gate.rejected
        believed = [
            Arrival(self._continuity.follow(a.sample), a.moment, a.identity)
            for a in self._gate.admit(arrival)
        ]
        if self._gate.rejected != rejected or any(a.sample.restarted for a in believed):
            # After a reset the MCU runs at its default rate, perhaps with another firmware; samples that do not fit may
            # come from an unseen reset.
            self._ask = True
        return believed

    def _follows(self, a: Arrival, b: Arrival) -> bool:
        return mcu_follows(a, b, 1000 / self.identity.rate_hz if self.identity else None)


class McuTilts:
    """Converts believed samples to readings."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._sca100t = Sca100t()
        self._sensors: dict[int, BoardSensor] = {
            SensorKind.SCA100T: self._sca100t,
            SensorKind.SCL3300: Scl3300(),
        }
        # The sensor of the unit that was last heard.
        self.sensor: BoardSensor = self._sca100t
        self.arrivals = ArrivalFilter()
        self._line_s = mcu_protocol.SAMPLE_LINE * BITS_PER_BYTE / values["baud"]
        self._delay_ms = 0
        # The samples that came before the identity were the first after a gap.
        self._gap = False
        self._rate_hz = 0
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        self._sca100t.calibration = calibration(values)
        for sensor in self._sensors.values():
            sensor.cross_axis = tuple(values["cross_axis"])
            sensor.noise_floor_rad = noise_floor_rad(values)
        self._latency_s = values["latency"]

    def read(self, arrivals: list[Arrival]) -> list[Reading]:
        """Convert the arrivals that an `McuDecoder` believed, in order.

        Until the unit has named its sensor, the meaning of its codes is unknown, and they are left out.
        """
        readings = []
        for arrival in arrivals:
            if arrival.identity is None:
                sample = arrival.sample
                self._gap |= bool(sample.lost) or sample.restarted or sample.resumed
            else:
                readings.append(self._reading(arrival))
        return readings

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
            self.arrivals.restart()

    def _reading(self, arrival: Arrival) -> Reading:
        sample, moment = arrival.sample, arrival.moment
        self._follow(arrival.identity)
        sample, self._gap = replace(sample, resumed=sample.resumed or self._gap), False
        if sample.restarted or sample.resumed:
            self.arrivals.restart()
        known_s = self.arrivals.delay(sample.milliseconds, moment.monotonic_s)
        late_s = known_s or 0.0
        stamp_ns = moment.stamp_ns(late_s + self._sample_to_arrival_s())
        reading = self.sensor.measure(sample, moment.monotonic_s - late_s, stamp_ns)
        return reading if known_s is not None else replace(reading, flags=reading.flags | TIME_UNKNOWN)


class McuSource(LinkSource):
    """The starpos microcontroller on a serial port; see `McuTilts`."""

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        self.name = values["port"]
        self._decoder = McuDecoder(values["rate"])
        self._link = SerialLink(values["port"], values["baud"], self._decoder, host.clock, host.wake)
        self._tilts = McuTilts(values)

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
        self._tilts.configure(values)
        self._decoder.wanted_rate_hz = values["rate"]

    def fetch(self) -> list[Reading]:
        return self._tilts.read(self._link.fetch())

    def _complaint(self) -> str:
        if not self._decoder.refused:
            return ""
        return f"the microcontroller refused {self._decoder.wanted_rate_hz} Hz: set another `rate`."

    def _values(self) -> Mapping[str, object]:
        identity, tilts = self._decoder.identity, self._tilts
        return {
            "clock rate error (ppm)": tilts.arrivals.rate_ppm,
            "noise x, y (arcsec)": noise_text(tilts.sensor.noise.sigma),
            "sensor temperature (deg C)": tilts.sensor.temperature.celsius(math.nan),
            "firmware": f"{identity.firmware >> 8}.{identity.firmware & 255}" if identity else "unknown",
            "sensor": SensorKind(identity.kind).name if identity else "unknown",
            "unit": f"{identity.unit:08X}" if identity else "unknown",
        }
