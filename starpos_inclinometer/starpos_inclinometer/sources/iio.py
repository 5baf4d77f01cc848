# SPDX-License-Identifier: Apache-2.0
"""The source `iio`: inclinometers and accelerometers that Linux's own drivers read."""

import errno
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from starpos.instrument import sensors
from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import GAP, TIME_UNKNOWN, Acceleration, ImuTilts, Reading
from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources.iio_device import (
    FAILED_READS,
    INCLINATION,
    DeviceError,
    IioDevice,
    find,
    set_sampling_frequency,
)
from starpos_inclinometer.sources.source import Arrival, Health, Link, Phase, Surroundings
from starpos_inclinometer.sources.tilts import SensorTilts

PATIENCE_S = 1.0
# If reading the channels takes longer, this process stood still in between.
SLOW_S = 0.1


class IioSource(Link):
    """An inclinometer or accelerometer of Linux's Industrial I/O; `identity` of an arrival is the device."""

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        self._root, self._wanted = Path(values["iio.root"]), values["iio.device"].strip()
        super().__init__(host, self._wanted or values["iio.root"])
        self._sampling_hz = values["iio.sampling_frequency"]
        self.angles, self.forces = SensorTilts(), ImuTilts(values)
        self.unusable = 0
        self.device: IioDevice | None = None
        self._sequence = -1
        self.configure(values)

    def _serve(self) -> None:
        device = None
        try:
            device = find(self._root, self._wanted)
            if not math.isnan(self._sampling_hz):
                device = set_sampling_frequency(device, self._sampling_hz)
            self._connections += 1
            self._poll(device)
        except DeviceError as error:
            self._enter(Phase.ABSENT, str(error))
        except OSError as error:
            why = f"{device.folder} ({device.model}) went away" if device else f"{self._root} cannot be read"
            self._enter(Phase.ABSENT, f"{why} ({error.strerror or error}): it is retried.")

    def _poll(self, device: IioDevice) -> None:
        """Read the device at the rate until the link is stopped; OSError when it went away."""
        good_s = due_s = self._clock.monotonic_s()
        while not self._stop.is_set():
            # A device that samples more slowly would be read twice.
            rate_hz = min(self._rate_hz, device.sampling_hz) if device.sampling_hz > 0 else self._rate_hz
            now_s = self._clock.monotonic_s()
            due_s = max(due_s + 1 / rate_hz, now_s)
            if self._stop.wait(due_s - now_s):
                return
            before = self._clock.read()
            try:
                raw = device.read_raw()
            except ValueError:
                self._fail(good_s, before, f"{device.folder} shows no numbers")
                continue
            except OSError as error:
                if error.errno == errno.EBUSY:
                    raise DeviceError(
                        f"another program reads the buffer of {device.folder}: end that one."
                    ) from None
                if error.errno not in FAILED_READS:
                    raise
                self._fail(good_s, before, f"the driver of {device.folder} cannot read it ({error.strerror})")
                continue
            took_s = self._clock.monotonic_s() - before.monotonic_s
            good_s = before.monotonic_s
            middle = Moment(before.monotonic_s + took_s / 2, before.host_ns + round(took_s * 5e8))
            with self._lock:
                self._counts.good += 1
            arrival = Arrival(raw, middle, device, dated=took_s < SLOW_S)
            sentence = f"receiving from {device.model} ({device.folder.name})"
            self._admit([arrival], [middle.monotonic_s], sentence)

    def _fail(self, good_s: float, now: Moment, sentence: str) -> None:
        with self._lock:
            self._counts.malformed += 1
        if now.monotonic_s - good_s > PATIENCE_S:
            self._enter(Phase.GARBLED, f"{sentence}; it is retried.")

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        if values["iio.root"].strip():
            return None
        return "parameter iio.root must name the folder of the devices, such as /sys/bus/iio/devices; it is empty."

    def configure(self, values: Mapping[str, Any]) -> None:
        self._parameters = values
        self._rate_hz = values["rate"]
        self.angles.stuck = values["iio.stuck_samples"]
        self.angles.configure(values)
        self._latency_s = 0.0 if math.isnan(values["latency"]) else values["latency"]
        self.forces.configure(values)

    def fetch(self) -> list[Reading]:
        read = (self.read(arrival) for arrival in self.arrivals())
        return [reading for reading in read if reading is not None]

    def read(self, arrival: Arrival) -> Reading | None:
        """Convert one reading; None while accelerations are being averaged, or if it gives no tilt."""
        device, raw, moment = arrival.identity, arrival.sample, arrival.moment
        flags = 0 if arrival.dated else TIME_UNKNOWN
        if device is not self.device:
            flags |= self._begin(device)
        if device.kind != INCLINATION:
            if not arrival.dated:
                return None
            force = Acceleration(moment.host_ns, device.force(raw), 0.0, (0.0, 0.0, 0.0))
            return self.forces.include(force, device.temperature_c(raw), device.step_rad)
        try:
            angles = device.angles(raw)
        except ValueError:
            self.unusable += 1
            return None
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        return self.angles.reading(
            angles,
            (device.step_rad,) * len(angles),
            time_s=moment.monotonic_s,
            stamp_ns=moment.stamp_ns(self._latency_s),
            sequence=self._sequence,
            temperature_c=device.temperature_c(raw),
            flags=flags,
        )

    def _begin(self, device: IioDevice) -> int:
        """Begin with another device, whose noise is its own; return the flag of its first reading."""
        flags = 0
        if self.device is not None:
            flags = GAP
            self.forces.restart()
        self.device = device
        preset = sensors.presets().get(device.model)
        self.angles = SensorTilts(preset.noise_rad, preset.range_rad) if preset else SensorTilts()
        self.configure(self._parameters)
        return flags

    def health(self) -> Health:
        health, unrest = super().health(), self.forces.unrest
        if health.phase is not Phase.RECEIVING or not unrest:
            return health
        sentence = f"the accelerometer is not at rest: {unrest}; tilts come when it is."
        return replace(health, phase=Phase.MOVING, sentence=sentence)

    def _shown(self) -> Mapping[str, object]:
        device = self.device
        return {
            "driver": device.model if device else "unknown",
            "the solver's inclinometer.model": _preset(device),
            "sampling frequency (Hz)": device.sampling_hz if device else math.nan,
            "unusable readings": self.unusable,
            "noise by axis (arcsec)": noise_text(self.angles.noise.sigma or self.forces.noise),
        }


def _preset(device: IioDevice | None) -> str:
    if device is None:
        return "unknown"
    return device.model if device.model in sensors.presets() else f"none of that name ({device.model})"
