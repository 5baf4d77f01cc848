# SPDX-License-Identifier: Apache-2.0
"""The source `iio`: inclinometers and accelerometers that Linux's own drivers read."""

import errno
import math
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from starpos.instrument import sensors
from starpos.instrument.tilt_log import noise_text
from starpos.messages.tilt import Felt, ImuTilts
from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources.iio_device import (
    FAILED_READS,
    INCLINATION,
    Buffer,
    DeviceError,
    IioDevice,
    find,
    set_sampling_frequency,
)
from starpos_inclinometer.sources.source import (
    Arrival,
    Counts,
    Health,
    Phase,
    Reading,
    Surroundings,
    TiltSource,
)
from starpos_inclinometer.sources.tilts import Angles, AngleTilts

# A device that came back is read again within a second.
RETRY_S = 0.4
# How soon a stop or silence is noticed.
WAIT_S = 0.1
PATIENCE_S = 1.0
# If reading the channels takes longer, this process stood still in between.
SLOW_S = 0.1
QUEUE = 1024
RATE_WINDOW_S = 5.0


class IioLink:
    """Reads raw values in a thread until `stop`; finds the device again when it comes back."""

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        self._root, self._wanted = Path(values["iio.root"]), values["iio.device"].strip()
        self._trigger, self._sampling_hz = values["iio.trigger"].strip(), values["iio.sampling_frequency"]
        self.rate_hz = values["rate"]
        self._clock, self._wake = host.clock, host.wake
        # Arrivals of raw values; `identity` is the device, None if the time of the values is unknown.
        self._queue: deque[tuple[IioDevice, Arrival]] = deque(maxlen=QUEUE)
        self._recent: deque[float] = deque(maxlen=QUEUE)
        self._good = self._failed = 0
        self.connections = 0
        self._phase, self._sentence = Phase.ABSENT, "the device has not been looked for yet"
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="iio", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def take(self) -> list[tuple[IioDevice, Arrival]]:
        taken = []
        with self._lock:
            while self._queue:
                taken.append(self._queue.popleft())
        return taken

    def state(self) -> tuple[Phase, str, float, Counts]:
        """Phase, sentence, readings a second, counts."""
        with self._lock:
            now_s = self._clock.monotonic_s()
            recent = [t for t in self._recent if now_s - t < RATE_WINDOW_S]
            span = recent[-1] - recent[0] if len(recent) > 1 else 0.0
            rate_hz = (len(recent) - 1) / span if span > 0 else 0.0
            return self._phase, self._sentence, rate_hz, Counts(good=self._good, malformed=self._failed)

    # All that follows runs in the thread.

    def _run(self) -> None:
        while not self._stop.is_set():
            opened = False
            try:
                device = find(self._root, self._wanted)
                if not math.isnan(self._sampling_hz):
                    device = set_sampling_frequency(device, self._sampling_hz)
                self.connections += 1
                opened = True
                if self._trigger:
                    self._follow_buffer(device)
                else:
                    self._poll(device)
            except DeviceError as error:
                self._enter(Phase.ABSENT, str(error))
            except OSError as error:
                why = (
                    f"{device.folder} ({device.model}) went away"
                    if opened
                    else f"{self._root} cannot be read"
                )
                self._enter(Phase.ABSENT, f"{why} ({error.strerror or error}): it is retried.")
            self._clock.read()
            self._stop.wait(RETRY_S)

    def _poll(self, device: IioDevice) -> None:
        """Read the device at the rate until the link is stopped; OSError when it went away."""
        good_s = due_s = self._clock.monotonic_s()
        while not self._stop.is_set():
            # A device that samples more slowly would be read twice.
            rate_hz = min(self.rate_hz, device.sampling_hz) if device.sampling_hz > 0 else self.rate_hz
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
                        f"another program reads the buffer of {device.folder}: end that one, or set `iio.trigger`."
                    ) from None
                if error.errno not in FAILED_READS:
                    raise
                self._fail(good_s, before, f"the driver of {device.folder} cannot read it ({error.strerror})")
                continue
            took_s = self._clock.monotonic_s() - before.monotonic_s
            good_s = before.monotonic_s
            middle = Moment(before.monotonic_s + took_s / 2, before.host_ns + round(took_s * 5e8))
            self._admit(device, [Arrival(raw, middle, device if took_s < SLOW_S else None)])

    def _follow_buffer(self, device: IioDevice) -> None:
        """Read the device's buffer until the link is stopped; OSError when the device went away."""
        buffer = Buffer(device, self._trigger)
        try:
            good_s = self._clock.monotonic_s()
            while not self._stop.is_set():
                scans = buffer.read(WAIT_S)
                now = self._clock.read()
                if not scans:
                    self._fail(good_s, now, f"the buffer of {device.folder} is silent: check `iio.trigger`")
                    if not device.folder.exists():
                        raise OSError(errno.ENODEV, "it is gone")
                    continue
                good_s = now.monotonic_s
                moments = [
                    Moment(s.time_s, now.host_ns - round((now.monotonic_s - s.time_s) * 1e9)) for s in scans
                ]
                self._admit(device, [Arrival(s.raw, m, device) for s, m in zip(scans, moments, strict=True)])
        finally:
            buffer.close()

    def _fail(self, good_s: float, now: Moment, sentence: str) -> None:
        with self._lock:
            self._failed += 1
        if now.monotonic_s - good_s > PATIENCE_S:
            self._enter(Phase.GARBLED, f"{sentence}; it is retried.")

    def _admit(self, device: IioDevice, arrivals: list[Arrival]) -> None:
        with self._lock:
            self._good += len(arrivals)
            self._queue.extend((device, arrival) for arrival in arrivals)
            self._recent.extend(arrival.moment.monotonic_s for arrival in arrivals)
        self._enter(Phase.RECEIVING, f"receiving from {device.model} ({device.folder.name})")
        self._wake()

    def _enter(self, phase: Phase, sentence: str) -> None:
        with self._lock:
            changed = (phase, sentence) != (self._phase, self._sentence)
            self._phase, self._sentence = phase, sentence
        if changed:
            self._wake()


class IioTilts:
    """Converts raw values of a device to readings."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.angles, self.forces = AngleTilts(), ImuTilts(values)
        self.unusable = 0
        self.device: IioDevice | None = None
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        self._values = values
        preset = sensors.PRESETS.get(self.device.model) if self.device else None
        if preset:
            self.angles.usual_noise = preset.noise_rad
        self.angles.configure(
            values,
            stuck_samples=values["iio.stuck_samples"],
            range_rad=preset.range_rad if preset else math.pi / 2,
        )
        self.forces.configure(values)

    def read(self, device: IioDevice, arrival: Arrival) -> Reading | None:
        """Convert one reading; None while accelerations are being averaged, or if it gives no tilt."""
        broken = self.device is not None and device is not self.device
        if device is not self.device:
            self.device = device
            self.configure(self._values)
        raw, moment = arrival.sample, arrival.moment
        if device.kind != INCLINATION:
            if arrival.identity is None:
                return None
            felt = Felt(moment.host_ns, device.force(raw), 0.0, (0.0, 0.0, 0.0))
            return self.forces.add(felt, device.temperature_c(raw), device.step_rad)
        try:
            angles = device.angles(raw)
        except ValueError:
            self.unusable += 1
            return None
        measured = Angles(angles, device.step_rad, device.temperature_c(raw), broken=broken)
        return self.angles.reading(measured, moment, None if arrival.identity is None else 0.0)


class IioSource(TiltSource):
    """An inclinometer or accelerometer of Linux's Industrial I/O."""

    def __init__(self, host: Surroundings, values: Mapping[str, Any]) -> None:
        self.name = values["iio.device"].strip() or values["iio.root"]
        self._clock = host.clock
        self._link, self._tilts = IioLink(host, values), IioTilts(values)

    @staticmethod
    def refusal(values: Mapping[str, Any]) -> str | None:
        if values["iio.root"].strip():
            return None
        return "parameter iio.root must name the folder of the devices, such as /sys/bus/iio/devices; it is empty."

    def start(self) -> None:
        self._link.start()

    def stop(self) -> None:
        self._link.stop()

    def configure(self, values: Mapping[str, Any]) -> None:
        self._link.rate_hz = values["rate"]
        self._tilts.configure(values)

    def take(self) -> list[Reading]:
        read = (self._tilts.read(device, arrival) for device, arrival in self._link.take())
        return [reading for reading in read if reading is not None]

    def health(self) -> Health:
        phase, sentence, rate_hz, counts = self._link.state()
        tilts, device = self._tilts, self._tilts.device
        if phase is Phase.RECEIVING and tilts.forces.unrest:
            phase = Phase.MOVING
            sentence = f"the accelerometer is not at rest: {tilts.forces.unrest}; tilts come when it is."
        noise = tilts.angles.noise.sigma or tilts.forces.noise
        values = {
            "openings": self._link.connections,
            "driver": device.model if device else "unknown",
            "the solver's inclinometer.model": _preset(device),
            "sampling frequency (Hz)": device.sampling_hz if device else math.nan,
            "unusable readings": tilts.unusable,
            "noise by axis (arcsec)": noise_text(noise),
        }
        return Health(
            phase=phase,
            sentence=sentence,
            rate_hz=rate_hz,
            counts=counts,
            step=self._clock.step,
            values=values,
        )


def _preset(device: IioDevice | None) -> str:
    if device is None:
        return "unknown"
    return device.model if device.model in sensors.PRESETS else f"none of that name ({device.model})"
