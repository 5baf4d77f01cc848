# SPDX-License-Identifier: Apache-2.0
import warnings

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument.inclinometer import Tilt, a2_matrix, sca100t_angle, sca100t_volts

DEG = np.pi / 180
NO_ERROR = np.zeros((2, 2))


def test_a2_turns_up_as_the_sensor_feels_it_into_z(rng):
    """The paper, section 4.2: a sensor whose axes rise by theta sees up at (sin theta_x, sin theta_y, rest)."""
    for _ in range(300):
        tx, ty = rng.uniform(-30, 30, 2) * DEG
        a2 = a2_matrix(tx, ty)
        np.testing.assert_allclose(a2 @ a2.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(a2) == pytest.approx(1)
        up = np.array([np.sin(tx), np.sin(ty), np.sqrt(1 - np.sin(tx) ** 2 - np.sin(ty) ** 2)])
        np.testing.assert_allclose(a2[2], up, atol=1e-15)
        assert a2[1, 0] == 0  # R2 R1: X' stays above the X axis of L


def test_a2_refuses_axes_that_cannot_be_at_right_angles():
    with pytest.raises(TiltError, match="cannot hold together"):
        a2_matrix(60 * DEG, 60 * DEG)
    with pytest.raises(TiltError):
        a2_matrix(np.nan, 0.0)


@pytest.mark.parametrize(
    ("volts", "degrees"),
    [(2.5, 0.0), (4.5, 30.0), (0.5, -30.0), (3.5, 14.47751), (2.5 + 4 * 6.1087e-5, 0.0035)],
)
def test_sca100t_by_hand(volts, degrees):
    """SCA100T-D01 on 5 V: 2.5 V at zero, 4 V/g, asin((4.5 - 2.5) / 4) = 30 deg."""
    assert sca100t_angle(volts) / DEG == pytest.approx(degrees, abs=1e-5)
    assert sca100t_volts(degrees * DEG) == pytest.approx(volts, abs=1e-6)


def test_sca100t_d02_and_beyond_one_g():
    assert sca100t_angle(2.5 + 2 * 0.5, sensitivity_v_per_g=2.0) / DEG == pytest.approx(30)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(sca100t_angle([6.6, -2.0])).all()


@pytest.mark.parametrize(
    "values",
    [(np.nan, 0.0, NO_ERROR, 0.0), (0.0, np.inf, NO_ERROR, 0.0), (0.0, 0.0, NO_ERROR, np.nan),
     (0.0, 0.0, np.full((2, 2), np.nan), 0.0), (0.0, 0.0, np.zeros(2), 0.0)],
)  # fmt: skip
def test_a_tilt_that_is_no_tilt(values):
    with pytest.raises(TiltError):
        Tilt(*values[:3], utc_unix_s=values[3])
