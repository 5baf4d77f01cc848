# SPDX-License-Identifier: Apache-2.0
"""Folders as Linux's Industrial I/O shows its devices, and the pipe that stands for a buffer."""

import os
import struct


def plug(root, number=0, **attributes):
    """A device's folder; attributes are files, `__` in their names a slash."""
    device = root / f"iio:device{number}"
    device.mkdir(parents=True, exist_ok=True)
    for name, text in attributes.items():
        path = device / name.replace("__", "/")
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"{text}\n")
    return device


def scl3300(root, number=0, raw=(546, -273, 15760), **more):
    angles = {f"in_incli_{axis}_raw": value for axis, value in zip("xyz", raw, strict=True)}
    accelerations = {f"in_accel_{axis}_raw": 0 for axis in "xyz"}
    return plug(
        root,
        number,
        name="scl3300",
        in_incli_scale=0.005495,
        in_accel_scale=0.000167,
        in_temp_raw=5540,
        **angles,
        **accelerations,
        **more,
    )


def adxl355(root, number=0, raw=(-13421, 26828, 254288), **more):
    """Device as the kernel's adxl355 describes itself, with a buffer."""
    types = {"x": (0, "be:s20/32>>12"), "y": (1, "be:s20/32>>12"), "z": (2, "be:s20/32>>12")}
    scans = {f"scan_elements__in_accel_{axis}_index": i for axis, (i, _) in types.items()}
    scans |= {f"scan_elements__in_accel_{axis}_type": t for axis, (_, t) in types.items()}
    scans |= {f"scan_elements__in_accel_{axis}_en": 0 for axis in types}
    values = {f"in_accel_{axis}_raw": value for axis, value in zip("xyz", raw, strict=True)}
    return plug(
        root,
        number,
        name="adxl355",
        in_accel_scale=0.000038245,
        in_temp_raw=1885,
        in_temp_scale=-110.497238,
        in_temp_offset=-2111.25,
        sampling_frequency=4000,
        scan_elements__in_temp_en=0,
        scan_elements__in_temp_index=3,
        scan_elements__in_temp_type="be:u12/16>>0",
        scan_elements__in_timestamp_en=0,
        scan_elements__in_timestamp_index=4,
        scan_elements__in_timestamp_type="le:s64/64>>0",
        buffer__enable=0,
        buffer__length=2,
        trigger__current_trigger="",
        current_timestamp_clock="realtime",
        **values,
        **scans,
        **more,
    )


def scan(x, y, z, temperature, stamp_ns):
    """A scan of the ADXL355 as its kernel driver stores it: 20 bits left in 32, big-endian, padded to 8 bytes."""
    head = b"".join(struct.pack(">i", value << 12) for value in (x, y, z)) + struct.pack(">H", temperature)
    return head + b"\xaa" * 2 + struct.pack("<q", stamp_ns)


def node(folder, name="iio:device0"):
    """A pipe in the place of the character device; returns the end to write to."""
    os.mkfifo(folder / name)
    reader = os.open(folder / name, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(folder / name, os.O_WRONLY)
    os.close(reader)
    return writer
