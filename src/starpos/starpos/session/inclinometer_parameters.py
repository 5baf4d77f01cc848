# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `inclinometer` for tilts from an IMU; the parameters of other sources are with the sources."""

import math

from starpos.session.parameter import FRAME_NAME, Parameter

# the values of imu.variance
STATED, SCATTER = "stated", "scatter"
# of all sources
SHARED = (
    Parameter(
        "frame_id",
        "starpos_inclinometer_frame",
        "Frame of the tilts: S, the sensor's X', Y', Z'; of source imu, the IMU's own axes.",
        read_only=True,
        form=FRAME_NAME,
    ),
    Parameter(
        "noise_stddev",
        math.nan,
        "Lower bound of the white noise of one sample and axis; unset takes the samples' scatter, 0.0035 "
        "deg until there are enough. If too large, fixes are wider than necessary.",
        unit="deg",
        minimum=1e-6,
        maximum=10.0,
    ),
    Parameter(
        "latency",
        math.nan,
        "From the middle of a sample to the first byte of its line, of source imu to its stamp; unset takes what the "
        "microcontroller reports, 0 of other sources. Matters only while the tilt moves.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    ),
)
IMU = (
    Parameter(
        "imu.average",
        0.5,
        "Time over which accelerations are averaged to one tilt, of sources imu and iio; short ones are noisy, long "
        "ones late.",
        unit="s",
        minimum=0.02,
        maximum=60.0,
    ),
    Parameter(
        "imu.variance",
        STATED,
        "Source of the noise of an IMU's accelerations. stated: the variance in its messages, or their "
        "scatter if that is more; scatter: their scatter alone, where the driver states a placeholder. A "
        "placeholder that is too large widens fixes.",
        choices=(STATED, SCATTER),
    ),
    Parameter(
        "imu.max_force_error",
        0.05,
        "Share by which the acceleration may differ from 9.81 m/s2; beyond it is not at rest and gives no "
        "tilt. "
        "Too small refuses an uncalibrated accelerometer, too large takes driving for leaning.",
        unit="",
        minimum=0.0001,
        maximum=0.5,
    ),
    Parameter(
        "imu.max_rotation",
        2.0,
        "Rate of rotation beyond which the IMU is not at rest, its gyroscope's own offset included.",
        unit="deg/s",
        minimum=0.001,
        maximum=360.0,
    ),
)
