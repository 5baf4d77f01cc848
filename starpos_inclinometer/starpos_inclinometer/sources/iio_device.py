# SPDX-License-Identifier: Apache-2.0
"""A sensor that Linux's Industrial I/O drives, by its channels in sysfs.

Source: Documentation/ABI/testing/sysfs-bus-iio.
"""

import errno
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.instrument.inclinometer import elevations
from starpos.units import STANDARD_GRAVITY

# What is looked for, the better first: a sensor that measures angles has calibrated and filtered them itself.
INCLINATION, ACCELERATION = "incli", "accel"
AXES = ("x", "y", "z")
# The kernel's sca3300 states accelerations in g, where the ABI has m/s2, and gives its temperature no scale
# (as of Linux 6.12); T = -273 + TEMP / 18.9 deg C is the data sheet's (Doc. 3165 Rev. 3, 2.4).
IN_G = {"sca3300", "scl3300"}
SHEET_TEMPERATURES = dict.fromkeys(IN_G, (1000 / 18.9, -273 * 18.9))
# A read that the driver refuses although the device is there, such as one whose checksum was wrong.
FAILED_READS = {errno.EIO, errno.EINVAL, errno.EAGAIN, errno.ETIMEDOUT, errno.EREMOTEIO, errno.EPROTO}


class DeviceError(Exception):
    """No device can be used; the text is a sentence that says why."""


@dataclass(frozen=True)
class Channel:
    """One quantity of a device: value = (raw + offset) scale, in the ABI's unit (deg, m/s2, thousandths of a deg C)."""

    name: str
    scale: float
    offset: float

    def value(self, raw: float) -> float:
        return (raw + self.offset) * self.scale


@dataclass(frozen=True, kw_only=True)
class IioDevice:
    """A device as it was found.

    folder: its own in sysfs.  kind: INCLINATION or ACCELERATION.
    channels: of x and y, and z where it is measured; of ACCELERATION always three.
    """

    folder: Path
    model: str
    kind: str
    channels: tuple[Channel, ...]
    temperature: Channel | None
    # NaN where the device does not say.
    sampling_hz: float

    def read_raw(self) -> tuple[float, ...]:
        """Read the channels, the temperature last; OSError, or ValueError for text that is no number."""
        channels = self.channels if self.temperature is None else (*self.channels, self.temperature)
        return tuple(_number(self.folder / f"{c.name}_raw") for c in channels)

    def temperature_c(self, raw: tuple[float, ...]) -> float:
        """Temperature in deg C from what `read_raw` gave; NaN where the device has none."""
        if self.temperature is None:
            return math.nan
        return self.temperature.value(raw[len(self.channels)]) / 1000

    def angles(self, raw: tuple[float, ...]) -> tuple[float, ...]:
        """Elevations of the axes, rad, of an INCLINATION; ValueError for angles beyond a full circle."""
        degrees = [c.value(r) for c, r in zip(self.channels, raw, strict=False)]
        if not all(abs(d) <= 360 for d in degrees):
            raise ValueError(f"an inclination of {max(degrees, key=abs):.0f} deg")
        return tuple(elevations(np.radians(degrees)).tolist())

    @property
    def step_rad(self) -> float:
        step = max(abs(c.scale) for c in self.channels)
        return math.radians(step) if self.kind == INCLINATION else step * self._unit / STANDARD_GRAVITY

    def force(self, raw: tuple[float, ...]) -> tuple[float, float, float]:
        """Specific force, m/s2, of an ACCELERATION."""
        x, y, z = (self._unit * c.value(r) for c, r in zip(self.channels, raw, strict=False))
        return x, y, z

    @property
    def _unit(self) -> float:
        return STANDARD_GRAVITY if self.model in IN_G else 1.0


def find(root: Path, wanted: str) -> IioDevice:
    """Find the device by its name or number; '' takes the only one there is.  DeviceError says what is there instead."""
    found = []
    for folder in sorted(root.glob("iio:device*")):
        try:
            found.append(_describe(folder))
        except (OSError, ValueError):
            # It is being added or removed.
            continue
    named = [d for d in found if _is_called(d, wanted)] if wanted else [d for d in found if d.channels]
    there = ", ".join(f"{d.folder.name} ({d.model})" for d in found) or "none"
    if not named:
        which = f"no device {wanted!r}" if wanted else "no inclinometer or accelerometer"
        raise DeviceError(
            f"{which} is in {root} (devices there: {there}): load its driver, or set `iio.device`; it is retried."
        )
    if len(named) > 1:
        raise DeviceError(
            f"several devices fit ({there}): set `iio.device` to one's number, such as iio:device0."
        )
    (device,) = named
    if not device.channels:
        raise DeviceError(
            f"{device.folder} ({device.model}) has no inclinations of x and y and no accelerations of x, y and z with "
            "a scale: name another `iio.device`."
        )
    return device


def set_sampling_frequency(device: IioDevice, hertz: float) -> IioDevice:
    """Set the device's sampling frequency; DeviceError with those it has."""
    path = _sampling(device.folder, device.kind)
    if path is None:
        raise DeviceError(f"{device.folder} has no sampling frequency: unset `iio.sampling_frequency`.")
    try:
        path.write_text(f"{hertz:g}\n")
    except OSError as error:
        has = path.with_name(path.name + "_available")
        offers = " ".join(has.read_text().split()) if has.exists() else "others"
        raise DeviceError(
            f"{path} refused {hertz:g} Hz ({error.strerror}): the device offers {offers}; the user needs the right to "
            "write it."
        ) from None
    return replace(device, sampling_hz=_number(path))


def _describe(folder: Path) -> IioDevice:
    model = (folder / "name").read_text().strip().lower()
    for kind, least in ((INCLINATION, 2), (ACCELERATION, 3)):
        shared = (f"in_{kind}_", "in_", "")
        channels = [c for axis in AXES if (c := _channel(folder, f"in_{kind}_{axis}", *shared)) is not None]
        in_order = [c.name[-1] for c in channels] == list(AXES[: len(channels)])
        if len(channels) >= least and in_order:
            break
    else:
        kind, channels = ACCELERATION, []
    sampling = _sampling(folder, kind)
    return IioDevice(
        folder=folder,
        model=model,
        kind=kind,
        channels=tuple(channels),
        temperature=_temperature(folder, model),
        sampling_hz=math.nan if sampling is None else _number(sampling),
    )


def _channel(folder: Path, name: str, *shared: str) -> Channel | None:
    """Find a channel whose values have a unit: its own, or one that channels share; without a scale it is unknown."""
    if not (folder / f"{name}_raw").exists():
        return None
    scale, offset = (_first(folder, name, what, *shared) for what in ("scale", "offset"))
    return None if not scale else Channel(name, scale, offset or 0.0)


def _temperature(folder: Path, model: str) -> Channel | None:
    for name in ("in_temp", "in_temp0"):
        if channel := _channel(folder, name, "in_temp_"):
            return channel
        if model in SHEET_TEMPERATURES and (folder / f"{name}_raw").exists():
            return Channel(name, *SHEET_TEMPERATURES[model])
    return None


def _sampling(folder: Path, kind: str) -> Path | None:
    names = ("sampling_frequency", f"in_{kind}_sampling_frequency")
    return next((folder / n for n in names if (folder / n).exists()), None)


def _first(folder: Path, channel: str, what: str, *shared: str) -> float | None:
    """Read an attribute of the channel, or the first that channels share, by how their names begin; None without any."""
    for begin in (f"{channel}_", *shared):
        if (folder / (begin + what)).exists():
            return _number(folder / (begin + what))
    return None


def _number(path: Path) -> float:
    value = float(path.read_text())
    if not math.isfinite(value):
        raise ValueError(f"{path} holds {value}")
    return value


def _is_called(device: IioDevice, wanted: str) -> bool:
    number = device.folder.name.removeprefix("iio:device")
    return wanted.lower() in (device.model, device.folder.name, number)
