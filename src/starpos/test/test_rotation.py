# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos import rotation


def test_about_axis_is_active_and_right_handed():
    x, y, z = np.eye(3)
    for axis, (start, end) in enumerate([(y, z), (z, x), (x, y)]):
        np.testing.assert_allclose(rotation.about_axis(axis, np.pi / 2) @ start, end, atol=1e-15)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-8, 1e-3, 1.0, 3.1])
def test_from_vector_is_scipys(size, rng):
    v = rng.normal(size=3)
    v *= size / np.linalg.norm(v)
    np.testing.assert_allclose(rotation.from_vector(v), Rotation.from_rotvec(v).as_matrix(), atol=1e-15)
    if size < 1e-6:
        np.testing.assert_allclose(rotation.to_small_vector(rotation.from_vector(v)), v, atol=1e-16)


def test_best_rotation_finds_a_rotation_and_never_a_mirror(rng):
    for _ in range(50):
        r = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
        v = rng.normal(size=(int(rng.integers(2, 9)), 3))
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        np.testing.assert_allclose(rotation.best_rotation(v, v @ r.T), r, atol=1e-12)
        mirrored = rotation.best_rotation(v, v * [1, 1, -1])
        assert np.linalg.det(mirrored) == pytest.approx(1)


def test_best_rotation_minds_the_weights():
    v = np.eye(3)
    wrong = v.copy()
    wrong[2] = [0.1, 0, 0.995]
    kept = rotation.best_rotation(v, wrong, np.array([1.0, 1.0, 1e-9]))
    np.testing.assert_allclose(kept, np.eye(3), atol=1e-8)


def test_quaternion_is_x_y_z_w_with_w_not_negative(rng):
    half = np.sqrt(0.5)
    np.testing.assert_allclose(rotation.to_quaternion(rotation.about_axis(2, np.pi / 2)), [0, 0, half, half])
    for _ in range(50):
        r = rotation.from_vector(rng.normal(size=3) * 2)
        q = rotation.to_quaternion(r)
        assert q[3] >= 0
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), r, atol=1e-12)


@pytest.mark.parametrize("angle", [-1e-17, -1e-300, 0.0, 2 * np.pi, -2 * np.pi, 7.0, -7.0])
def test_a_full_turn_is_never_reached(angle):
    turned = rotation.full_turn(angle)
    assert 0 <= turned < 2 * np.pi
    assert np.degrees(turned) < 360
    assert np.cos(turned - angle) == pytest.approx(1)
