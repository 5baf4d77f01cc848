# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from starpos import rotation
from starpos.errors import TiltError, TiltRangeError
from starpos.instrument import sensors
from starpos.instrument.inclinometer import InclinometerErrors, Tilt, level_of, up_of, up_slope
from starpos.instrument.instrument import LocalLevel

DEG = np.pi / 180
NO_ERROR = np.zeros((2, 2))


def test_a2_turns_up_as_the_sensor_feels_it_into_z(rng):
    """The paper, section 4.2: a sensor whose axes rise by theta sees up at (sin theta_x, sin theta_y, rest)."""
    for _ in range(300):
        tx, ty = rng.uniform(-30, 30, 2) * DEG
        up = np.array([np.sin(tx), np.sin(ty), np.sqrt(1 - np.sin(tx) ** 2 - np.sin(ty) ** 2)])
        np.testing.assert_allclose(Tilt(tx, ty, NO_ERROR, utc_unix_s=0.0).up, up, atol=1e-15)
        a2 = level_of(up)
        np.testing.assert_allclose(a2 @ a2.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(a2) == pytest.approx(1)
        np.testing.assert_allclose(a2[2], up, atol=1e-15)
        # R2 R1: X' stays above the X axis of L.
        assert a2[1, 0] == 0


def test_a_sensor_of_three_axes_leans_in_any_way(rng):
    """Upside down and on its side too: the third row of A2 is up; slopes are by the sines, which err alike."""
    for up in [
        *rotation.normalised(rng.normal(size=(200, 3))),
        np.array([1.0, 0, 0]),
        np.array([0, 0, -1.0]),
    ]:
        theta = np.arcsin(up)
        tilt = Tilt(theta[0], theta[1], NO_ERROR, utc_unix_s=0.0, theta_z=theta[2])
        np.testing.assert_allclose(tilt.up, up, atol=1e-12)
        a2 = level_of(tilt.up)
        np.testing.assert_allclose(a2 @ a2.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(a2) == pytest.approx(1)
        np.testing.assert_allclose(a2[2], up, atol=1e-12)
        for axis in np.flatnonzero(np.abs(theta) < 1.5):
            step = np.eye(3)[axis] * 1e-6
            change = (up_of(np.arcsin(up + step)) - up_of(np.arcsin(up - step))) / 2e-6
            np.testing.assert_allclose(tilt.slope[:, axis], change, atol=1e-6)


def test_levelling_turns_the_level_as_the_errors_of_the_angles_do(rng):
    for _ in range(50):
        theta = rng.uniform(-0.6, 0.6, 2)
        before, error = up_of(theta), rng.normal(0, 1e-6, 2)
        a2 = level_of(before)
        turns = LocalLevel(before, a2, a2, np.zeros((3, 0))).turns
        turn = rotation.from_vector(turns @ up_slope(theta, before) @ error)
        up = level_of(before).T @ turn.T @ [0, 0, 1.0]
        np.testing.assert_allclose(up, up_of(theta + error), atol=1e-11)


@pytest.mark.parametrize(
    "angles", [(60.0, 60.0), (np.nan, 0.0), (0.0, 91.0), (45.0, 45.0, 45.0), (0.0, 0.0, 0.0)]
)
def test_angles_that_no_gravity_makes_are_refused(angles):
    x, y, *z = np.radians(angles)
    with pytest.raises(TiltError):
        Tilt(x, y, NO_ERROR, utc_unix_s=0.0, theta_z=z[0] if z else np.nan)


def test_a_tilt_beyond_the_sensors_range_is_refused():
    tilt = Tilt(40 * DEG, 0.0, NO_ERROR, utc_unix_s=0.0)
    InclinometerErrors().check_range(tilt)
    with pytest.raises(TiltRangeError, match=r"beyond \+-30 deg"):
        InclinometerErrors(range_rad=30 * DEG).check_range(tilt)


def three_axes(angles_deg):
    x, y, z = np.radians(angles_deg)
    return Tilt(x, y, np.eye(2) * 1e-9, utc_unix_s=0.0, theta_z=z)


@pytest.mark.parametrize(
    ("errors", "most", "sentence"),
    [
        (InclinometerErrors(), 0.062, "contradict each other: .* add up to {:.4f}, not to 1"),
        (sensors.presets()["scl3300"], 0.094, "contradict each other: .* add up to {:.4f}, not to 1"),
        (sensors.presets()["sca100t"], 0.1, "cannot hold together"),
    ],
)
def test_three_axes_that_contradict_each_other_are_refused(errors, most, sentence):
    """The sines of (30, 40, 35.69) deg have squares that add up to 1; a step of the third axis makes them contradict.

    0.1 is beyond what any sensor's errors make possible: no tilt may be that wrong.
    """
    refused = 0
    for third in np.linspace(35.69, 42.0, 200):
        angles = (30.0, 40.0, third)
        off = float(np.sum(np.sin(np.radians(angles)) ** 2)) - 1
        if off < 0.059:
            errors.check_axes(three_axes(angles))
        elif most < off and (off < 0.1 or most == 0.1):
            with pytest.raises(TiltError, match=sentence.format(1 + off)):
                errors.check_axes(three_axes(angles))
            refused += 1
    assert refused > 3
    errors.check_axes(Tilt(0.1, 0.2, NO_ERROR, utc_unix_s=0.0))


def test_axes_with_the_errors_of_their_sheet_do_not_contradict_each_other(rng):
    errors = sensors.presets()["scl3300"]
    for up in rotation.normalised(rng.normal(size=(2000, 3))):
        skew = np.eye(3) + errors.cross * rng.normal(size=(3, 3)) * (1 - np.eye(3))
        read = skew @ up * (1 + errors.scale * rng.normal(size=3)) + errors.pose_rad * rng.normal(size=3)
        errors.check_axes(three_axes(np.degrees(np.arcsin(np.clip(read, -1, 1)))))


@pytest.mark.parametrize(
    "values",
    [(np.nan, 0.0, NO_ERROR, 0.0), (0.0, np.inf, NO_ERROR, 0.0), (0.0, 0.0, NO_ERROR, np.nan),
     (0.0, 0.0, np.full((2, 2), np.nan), 0.0), (0.0, 0.0, np.zeros(2), 0.0)],
)  # fmt: skip
def test_a_tilt_that_is_no_tilt(values):
    with pytest.raises(TiltError):
        Tilt(*values[:3], utc_unix_s=values[3])
