# SPDX-License-Identifier: Apache-2.0
"""Buffered reading of an Industrial I/O device: whole scans from /dev, with the kernel's own time stamps.

The layout of a scan, and the order of the settings, follow the kernel's document "Industrial IIO device "
    "buffers".
"""

import contextlib
import os
import re
import select
from dataclasses import dataclass
from pathlib import Path

from starpos_inclinometer.sources.iio_device import DeviceError, IioDevice

# The kernel stamps with the clock that the host's moments have, so that a step of UTC does not matter.
CLOCK = "monotonic"
STAMP = "in_timestamp"
# Scans that the kernel keeps while this process is busy: 1 s at 100 Hz.
LENGTH = 128
READ_BYTES = 65536
_TYPE = re.compile(r"(be|le):([su])(\d+)/(\d+)(?:>>(\d+))?")


@dataclass(frozen=True, kw_only=True)
class Element:
    """One number of a scan: its place in the order, and how its bytes become a number."""

    name: str
    index: int
    little_endian: bool
    signed: bool
    bits: int
    size: int
    shift: int

    def number(self, data: bytes) -> int:
        value = int.from_bytes(data, "little" if self.little_endian else "big") >> self.shift
        value &= (1 << self.bits) - 1
        return value - (1 << self.bits) if self.signed and value >> (self.bits - 1) else value


def element(name: str, index: int, text: str) -> Element:
    """Read the text of a `_type` attribute, such as le:s12/16>>4; DeviceError for another form."""
    match = _TYPE.fullmatch(text.strip())
    if match is None or int(match[4]) % 8:
        raise DeviceError(
            f"{name} is stored as {text.strip()!r}, a format that is not known: unset `iio.trigger`."
        )
    order, sign, bits, storage, shift = match.groups()
    return Element(
        name=name,
        index=index,
        little_endian=order == "le",
        signed=sign == "s",
        bits=int(bits),
        size=int(storage) // 8,
        shift=int(shift or 0),
    )


class ScanLayout:
    """Where each element of a scan lies: in the order of their indices, each aligned to its own size."""

    def __init__(self, elements: list[Element]) -> None:
        self._at: dict[str, tuple[int, Element]] = {}
        end = 0
        for e in sorted(elements, key=lambda e: e.index):
            begin = -(-end // e.size) * e.size
            self._at[e.name] = (begin, e)
            end = begin + e.size
        largest = max(e.size for e in elements)
        self.size = -(-end // largest) * largest

    def numbers(self, scan: bytes) -> dict[str, int]:
        return {name: e.number(scan[at : at + e.size]) for name, (at, e) in self._at.items()}


@dataclass(frozen=True, slots=True)
class Scan:
    """Raw values as `IioDevice.read_raw` gives them, and when the kernel took them (monotonic s)."""

    raw: tuple[float, ...]
    time_s: float


class Buffer:
    """The buffer of a device, paced by a trigger; closed it is switched off again.

    trigger: its name, such as adxl355-dev0.
    nodes: the folder of the character devices.
    """

    def __init__(self, device: IioDevice, trigger: str, nodes: Path = Path("/dev")) -> None:
        self._folder = device.folder
        self._channels = [*device.channels, *([device.temperature] if device.temperature else [])]
        self._rest = b""
        names = [c.name for c in self._channels] + [STAMP]
        elements = self._folder / "scan_elements"
        if not elements.is_dir():
            raise DeviceError(
                f"{self._folder} ({device.model}) has no buffer: unset `iio.trigger` to poll it."
            )
        try:
            self._write("buffer/enable", "0")
            self._write("trigger/current_trigger", trigger)
            self._write("current_timestamp_clock", CLOCK)
            for path in elements.glob("*_en"):
                path.write_text("1" if path.name.removesuffix("_en") in names else "0")
            self._layout = ScanLayout([self._element(elements, name) for name in names])
            self._write("buffer/length", str(LENGTH))
            self._write("buffer/enable", "1")
            self._file = os.open(nodes / self._folder.name, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise DeviceError(
                f"the buffer of {self._folder} cannot be started ({error.strerror}: {error.filename}): check "
                f"`iio.trigger` ({trigger}) and the right to write there; it is retried."
            ) from None

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the whole scans that have come, after waiting for the first one; OSError when the device went away."""
        ready, _, _ = select.select([self._file], [], [], timeout_s)
        if not ready:
            return []
        data = os.read(self._file, READ_BYTES)
        if not data:
            raise OSError(f"{self._folder} sends no more")
        data = self._rest + data
        size = self._layout.size
        whole = len(data) // size * size
        self._rest = data[whole:]
        return [self._scan(data[at : at + size]) for at in range(0, whole, size)]

    def close(self) -> None:
        os.close(self._file)
        # A device that is gone needs no end.
        with contextlib.suppress(OSError):
            self._write("buffer/enable", "0")

    def _scan(self, data: bytes) -> Scan:
        numbers = self._layout.numbers(data)
        return Scan(tuple(float(numbers[c.name]) for c in self._channels), numbers[STAMP] * 1e-9)

    def _write(self, attribute: str, text: str) -> None:
        (self._folder / attribute).write_text(f"{text}\n")

    def _element(self, elements: Path, name: str) -> Element:
        index = int((elements / f"{name}_index").read_text())
        return element(name, index, (elements / f"{name}_type").read_text())
