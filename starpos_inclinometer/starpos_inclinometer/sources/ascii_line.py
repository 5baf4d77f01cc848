# SPDX-License-Identifier: Apache-2.0
"""The source `ascii`: digital tiltmeters that send lines of text, which a regular expression describes."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from decimal import Decimal
from typing import Any

import numpy as np

from starpos.instrument.inclinometer import elevations
from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import GAP, TIME_UNKNOWN, Reading
from starpos.units import ARCSEC
from starpos_inclinometer.clock import ArrivalFilter, Moment, PaceWatch
from starpos_inclinometer.sources.mcu_protocol import Gate, clocks_agree
from starpos_inclinometer.sources.serial_link import SerialLink, port_refusal
from starpos_inclinometer.sources.source import Arrival, Counts, Surroundings
from starpos_inclinometer.sources.tilts import SensorTilts

# In bytes.
MAX_LINE = 256
NEAR_RAD = math.radians(0.05)
AXES = ("x", "y", "z")
NEEDED = {"x", "y"}
# Angles from 0 to 360 deg are unwrapped; a rounded 360 is one.
FULL_CIRCLE = 2 * math.pi + 1e-9
OPTIONAL = {"z", "temperature", "sequence", "milliseconds", "seconds"}
ANGLES_RAD = {
    "deg": math.radians(1),
    "arcmin": math.radians(1 / 60),
    "arcsec": ARCSEC,
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
}
# An accelerometer measures the sine of the tilt.
SINES = {"g": 1.0, "mg": 1e-3, "percent_g": 1e-2}
UNITS = (*ANGLES_RAD, *SINES)
MAX_REQUEST = 256
_END = re.compile(rb"[\r\n]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """Content of one line: elevations and the step of the last digit in rad; None where the line says nothing."""

    x: float
    y: float
    z: float | None
    step: float
    # NaN if the line does not hold it; not compared, because NaN is not equal to itself.
    temperature_c: float = field(compare=False)
    sequence: int | None
    # Time of the device's clock, 32 bits.
    milliseconds: int | None
    # Distinguishes two equal lines of a device without sequence and clock from a line that came twice.
    number: int = 0
    # Samples lost just before this one.
    lost: int = 0
    # True: it does not continue the lines before.
    broken: bool = False


def pattern_error(pattern: str) -> str | None:
    """Say in a sentence why a pattern cannot be used; None if it can."""
    try:
        groups = set(re.compile(pattern).groupindex)
    except (re.error, OverflowError, RecursionError) as error:
        return f"ascii.pattern is no regular expression ({error}): write it as Python's re wants it."
    if not groups >= NEEDED:
        return "ascii.pattern needs the named groups x and y, such as (?P<x>[-+.0-9]+),(?P<y>[-+.0-9]+)."
    if unknown := groups - NEEDED - OPTIONAL:
        return (
            f"ascii.pattern has a group {sorted(unknown)[0]}: there are x, y, {', '.join(sorted(OPTIONAL))}."
        )
    if groups >= {"milliseconds", "seconds"}:
        return "ascii.pattern has both milliseconds and seconds: keep one."
    return None


class LineDecoder:
    """Turns a device's text into the samples that are believed.

    values: the node's parameters. `ascii.pattern` must match a whole line without the blanks around it.
    """

    answered = False
    hint = "check `baud` and `ascii.pattern`, and that this is the inclinometer."

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.period_s = self.command_period_s = values["ascii.period"]
        self._pattern = re.compile(values["ascii.pattern"])
        self._unit, self._resolution = values["ascii.unit"], values["ascii.resolution"]
        self._request = values["ascii.request"].encode()
        self._lines = TextLines()
        self.counts = self._lines.counts
        self._gate = Gate(_follows, NEAR_RAD, self.counts)
        self._last: Line | None = None
        self._broken = False

    def resume(self) -> None:
        self._lines.forget()
        self._gate.reset()
        self._broken = self._last is not None

    def command(self) -> bytes:
        return self._request

    def decode(self, data: bytes, moment: Moment) -> list[Arrival]:
        believed = []
        for text in self._lines.split(data):
            line = self._parse(text)
            if line is None:
                self.counts.malformed += 1
                continue
            self.counts.good += 1
            believed += [
                Arrival(self._continued(a.sample), a.moment) for a in self._gate.admit(Arrival(line, moment))
            ]
        return believed

    def _parse(self, text: str) -> Line | None:
        match = self._pattern.fullmatch(text)
        if match is None:
            return None
        said = {name: value for name, value in match.groupdict().items() if value}
        # float() would accept an underscore.
        if any("_" in value for value in said.values()):
            return None
        try:
            angles, steps = zip(
                *(self._angle(said[axis]) for axis in AXES if axis in said or axis in NEEDED), strict=True
            )
            temperature = float(said.get("temperature", "nan"))
            sequence = int(said["sequence"]) if "sequence" in said else None
            milliseconds = float(said["milliseconds"]) if "milliseconds" in said else None
            if "seconds" in said:
                milliseconds = 1e3 * float(said["seconds"])
            if milliseconds is not None:
                milliseconds = round(milliseconds) & 0xFFFFFFFF
        except (ValueError, OverflowError, ArithmeticError, KeyError):
            return None
        # NaN is not smaller
        if not all(abs(angle) <= FULL_CIRCLE for angle in angles) or math.isinf(temperature):
            return None
        x, y, *z = elevations(np.array(angles)).tolist()
        number = self.counts.good if sequence is None and milliseconds is None else 0
        return Line(
            x=x,
            y=y,
            z=z[0] if z else None,
            step=max(steps),
            temperature_c=temperature,
            sequence=sequence,
            milliseconds=milliseconds,
            number=number,
        )

    def _angle(self, text: str) -> tuple[float, float]:
        """Convert a value and the step of its last digit to rad."""
        value, step = float(text), self._resolution
        if math.isnan(step):
            step = 10.0 ** int(Decimal(text).as_tuple().exponent)
        if self._unit in ANGLES_RAD:
            return value * ANGLES_RAD[self._unit], step * ANGLES_RAD[self._unit]
        sine = min(max(value * SINES[self._unit], -1.0), 1.0) if math.isfinite(value) else math.nan
        angle = math.asin(sine)
        return angle, step * SINES[self._unit] / max(math.cos(angle), 0.1)

    def _continued(self, line: Line) -> Line:
        last, self._last = self._last, line
        broken, self._broken = self._broken, False
        if last is None or last.sequence is None or line.sequence is None:
            return replace(line, broken=broken)
        ahead = line.sequence - last.sequence
        if ahead < 1:
            # The device was reset, or its number wrapped.
            return replace(line, broken=True)
        self.counts.lost += ahead - 1
        return replace(line, lost=ahead - 1, broken=broken)


class TextLines:
    """Collects lines of at most MAX_LINE bytes, ended by CR or LF or both, from chunks of bytes."""

    def __init__(self) -> None:
        self.counts = Counts()
        self._rest = b""
        self._overlong = False

    def split(self, data: bytes) -> list[str]:
        """Return the lines that end in `data`, stripped of blanks; empty and overlong lines are left out."""
        *ended, rest = _END.split(self._rest + data)
        lines = []
        for line in ended:
            if self._overlong or len(line) > MAX_LINE:
                self.counts.garbage_bytes += len(line)
                self._overlong = False
            elif text := line.decode("latin-1").strip():
                lines.append(text)
        if self._overlong or len(rest) > MAX_LINE:
            self.counts.garbage_bytes += len(rest)
            self._overlong = True
            rest = b""
        self._rest = rest
        return lines

    def forget(self) -> None:
        """Drop a half-received line, because the next bytes come from another connection."""
        self.counts.garbage_bytes += len(self._rest)
        self._rest = b""
        # The first bytes may be the rest of a line.
        self._overlong = True


def _follows(a: Arrival, b: Arrival) -> bool:
    """Whether the second line may follow the first, judged by number and time."""
    first, second = a.sample, b.sample
    if None not in (first.sequence, second.sequence) and second.sequence <= first.sequence:
        return False
    if None in (first.milliseconds, second.milliseconds):
        return True
    elapsed = (second.milliseconds - first.milliseconds) & 0xFFFFFFFF
    return elapsed > 0 and clocks_agree(elapsed, a, b)


class AsciiSource(SerialLink[LineDecoder]):
    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        super().__init__(host, values, LineDecoder(values))
        self._filter, self._pace = ArrivalFilter(), PaceWatch()
        self._tilts, self._sequence = SensorTilts(), -1
        self.configure(values)

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        request = values["ascii.request"]
        if not request.isascii() or len(request) > MAX_REQUEST:
            return f"ascii.request must be at most {MAX_REQUEST} ASCII characters."
        return port_refusal(values) or pattern_error(values["ascii.pattern"])

    def configure(self, values: Mapping[str, Any]) -> None:
        range_deg = values["ascii.range"]
        self._tilts.range_rad = math.pi / 2 if math.isnan(range_deg) else math.radians(range_deg)
        self._tilts.stuck = values["ascii.stuck_samples"]
        self._tilts.configure(values)
        self._latency_s = 0.0 if math.isnan(values["latency"]) else values["latency"]

    def fetch(self) -> list[Reading]:
        return [self._reading(arrival) for arrival in self.arrivals()]

    def _reading(self, arrival: Arrival) -> Reading:
        line, moment = arrival.sample, arrival.moment
        late_s: float | None
        if line.milliseconds is None:
            late_s = 0.0 if self._pace.on_time(moment.monotonic_s) else None
        else:
            if line.broken:
                self._filter.restart()
            late_s = self._filter.delay(line.milliseconds, moment.monotonic_s)
        angles = (line.x, line.y) if line.z is None else (line.x, line.y, line.z)
        self._sequence = (self._sequence + 1 + line.lost) & 0xFFFFFFFF
        return self._tilts.reading(
            angles,
            (line.step,) * len(angles),
            time_s=moment.monotonic_s - (late_s or 0.0),
            stamp_ns=moment.stamp_ns((late_s or 0.0) + self._latency_s),
            sequence=self._sequence,
            temperature_c=line.temperature_c,
            flags=(GAP if line.lost or line.broken else 0) | (TIME_UNKNOWN if late_s is None else 0),
        )

    def _shown(self) -> Mapping[str, object]:
        return {
            "clock rate error (ppm)": self._filter.rate_ppm,
            "noise by axis (arcsec)": noise_text(self._tilts.noise.sigma),
        }
