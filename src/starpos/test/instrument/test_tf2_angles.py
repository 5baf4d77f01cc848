# SPDX-License-Identifier: Apache-2.0
"""The angles that tf2_echo prints of a camera in an IMU's frame are A3's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.instrument.instrument import Calibration


@pytest.mark.parametrize("rpy_deg", [(-90.0, 0.0, -90.0), (12.0, -34.0, 56.0), (180.0, 0.0, 90.0)])
def test_rpy_about_fixed_axes_is_a_misalignment(rpy_deg):
    # tf2's getRPY: about the fixed axes of the IMU, x first
    camera_in_imu = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()
    np.testing.assert_allclose(Calibration.of(rpy_deg).a3, camera_in_imu, atol=1e-12)
