# SPDX-License-Identifier: Apache-2.0
"""Folders as Linux's Industrial I/O shows its devices."""


def plug(root, number=0, **attributes):
    """A device's folder; attributes are files."""
    device = root / f"iio:device{number}"
    device.mkdir(parents=True, exist_ok=True)
    for name, text in attributes.items():
        (device / name).write_text(f"{text}\n")
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
    """Device as the kernel's adxl355 describes itself."""
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
        **values,
        **more,
    )
