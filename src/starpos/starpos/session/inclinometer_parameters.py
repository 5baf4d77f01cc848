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
        "Frame of the tilts: S, the sensor's X', Y', Z'. With source imu: the IMU's own axes.",
        read_only=True,
        form=FRAME_NAME,
    ),
    Parameter(
        "noise_stddev",
        math.nan,
        "Lower bound of the white noise of one sample on one axis. Unset takes the samples' "
        "scatter, or 0.0035 deg until there are enough samples. If too large, fixes claim errors "
        "that are too large.",
        unit="deg",
        minimum=1e-6,
        maximum=10.0,
    ),
    Parameter(
        "latency",
        math.nan,
        "Time from the middle of a sample to the first byte of its line, or to its stamp with "
        "source imu. Unset takes what the microcontroller reports, and 0 for other sources. It "
        "matters only while the tilt changes.",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    ),
)
IMU = (
    Parameter(
        "imu.average",
        0.5,
        "Time over which sources imu and iio average accelerations to one tilt. If short, tilts are "
        "noisy; if long, they come late.",
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
        "Largest relative difference of the acceleration from 9.81 m/s2 at rest; beyond it there is "
        "no tilt. If too small, an uncalibrated accelerometer gives no tilt; if too large, driving "
        "counts as leaning.",
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
