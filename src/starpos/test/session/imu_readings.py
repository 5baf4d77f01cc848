# SPDX-License-Identifier: Apache-2.0
"""Messages of a gyro without ROS."""

from types import SimpleNamespace


def reading(unix_s, rate, measured=True):
    ns = round(unix_s * 1e9)
    stamp = SimpleNamespace(sec=ns // 10**9, nanosec=ns % 10**9)
    x, y, z = map(float, rate)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp),
        angular_velocity=SimpleNamespace(x=x, y=y, z=z),
        angular_velocity_covariance=[0.0 if measured else -1.0] + [0.0] * 8,
    )
