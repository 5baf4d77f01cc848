# SPDX-License-Identifier: Apache-2.0
"""Fisheyes: the model of OpenCV and ROS, beyond 90 deg off the axis too, and where a lens has no picture."""

import pickle

import cv2
import numpy as np
import pytest

from starpos.errors import InstrumentError
from starpos.fix.star_fit import seen_problem
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.rotation import from_vector

# of a lens that is nearly equisolid, one that is nearly stereographic, one that ends its picture at 100 deg
EQUISOLID, STEREOGRAPHIC, SHORT = (
    (-0.0417, 5e-4, 1e-5, -2e-6),
    (0.083, 0.0083, 8e-4, 1e-4),
    (-0.1, -0.0015, 0, 0),
)
LENSES = [(0.0, 0.0, 0.0, 0.0), EQUISOLID, STEREOGRAPHIC, SHORT]


def fisheye(distortion=EQUISOLID, focal_px=600.0):
    return Camera(
        width=2000,
        height=1900,
        fx=focal_px,
        fy=1.002 * focal_px,
        cx=1003.2,
        cy=951.7,
        distortion=distortion,
        model=EQUIDISTANT,
    )


def directions(theta, rng):
    around = rng.uniform(0, 2 * np.pi, len(theta))
    return np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], -1)


def matrix(camera):
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


@pytest.mark.parametrize("lens", LENSES)
def test_the_projection_is_opencvs(lens, rng):
    """cv2.fisheye.projectPoints has the same model in front of the camera."""
    camera, v = fisheye(lens), directions(rng.uniform(0, np.radians(85), 500), rng)
    zero = np.zeros(3)
    theirs = cv2.fisheye.projectPoints(v.reshape(-1, 1, 3), zero, zero, matrix(camera), np.array(lens))[0][
        :, 0
    ]
    np.testing.assert_allclose(camera.project(v), theirs, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_its_inverse_is_opencvs(lens, rng):
    camera = fisheye(lens)
    xy = camera.project(directions(rng.uniform(0, np.radians(80), 500), rng))
    # OpenCV stops at 90 deg of an ideal lens's distance
    xy = xy[np.hypot(*((xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T) < 1.55]
    theirs = cv2.fisheye.undistortPoints(xy.reshape(-1, 1, 2), matrix(camera), np.array(lens))[:, 0]
    v = camera.directions(*xy.T)
    np.testing.assert_allclose(v[:, :2] / v[:, 2:], theirs, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_there_and_back_also_behind_the_image_plane(lens, rng):
    camera = fisheye(lens)
    v = directions(np.radians(np.append(rng.uniform(0, 98, 500), [0.0, 1e-9, 90.0])), rng)
    assert (v[:, 2] < 0).any()
    back = camera.directions(*camera.project(v).T)
    np.testing.assert_allclose(back, v, atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-14)


def test_the_angle_off_the_axis_is_the_distance_from_the_principal_point(rng):
    camera = Camera.from_focal(4000, 4000, 600.0, EQUIDISTANT)
    theta = np.radians([0.0, 30.0, 90.0, 120.0, 179.0])
    xy = camera.project(directions(theta, rng))
    np.testing.assert_allclose(np.hypot(*(xy - camera.centre_px).T), 600 * theta, atol=1e-9)
    # straight behind is a circle, not a point
    assert np.isnan(camera.project([[0.0, 0.0, -1.0]])).all()
    np.testing.assert_allclose(camera.project([[0.0, 0.0, 1.0]]), [camera.centre_px])


def test_beyond_the_end_of_its_picture_a_lens_shows_nothing():
    """Where the distance no longer grows with the angle, at 100 deg, two directions would have one pixel."""
    camera, theta = fisheye(SHORT), np.radians([80.0, 99.0, 101.0, 150.0])
    v = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    edge = np.degrees(np.sqrt(np.roots([5 * SHORT[1], 3 * SHORT[0], 1]).max()))
    assert 99 < edge < 101
    xy = camera.project(v)
    assert np.isfinite(xy).all(1).tolist() == [True, True, False, False]
    assert camera.sees(*xy[:2].T).all() and not camera.sees(camera.cx + 1200, camera.cy)
    assert np.isnan(camera.directions([camera.cx + 1200], [camera.cy])).all()


def test_the_field_is_to_the_corner_or_to_the_end_of_the_picture():
    assert Camera.from_focal(2000, 2000, 1000.0, EQUIDISTANT).half_diagonal_rad == pytest.approx(np.sqrt(2))
    assert Camera.from_focal(2000, 2000, 400.0, EQUIDISTANT).half_diagonal_rad == pytest.approx(np.pi)
    assert np.degrees(fisheye(SHORT, 300.0).half_diagonal_rad) == pytest.approx(100, abs=1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"distortion": (0.1,) * 5}, "equidistant has 4, k1 k2 k3 k4"),
        ({"distortion": (np.nan, 0, 0, 0)}, "not finite"),
        ({"model": "omni"}, "'omni'; plumb_bob, equidistant, rational_polynomial are understood"),
    ],
)
def test_impossible_fisheyes_are_refused(change, words):
    good = {"width": 100, "height": 80, "fx": 90.0, "fy": 90.0, "cx": 49.5, "cy": 39.5, "model": EQUIDISTANT}
    with pytest.raises(InstrumentError, match=words):
        Camera(**good | change)


def test_no_stars_are_no_error():
    assert fisheye().directions([], []).shape == (0, 3)
    assert fisheye().project(np.zeros((0, 3))).shape == (0, 2)


def test_a_fisheye_whose_lens_is_made_goes_to_other_processes():
    camera = fisheye(SHORT)
    assert camera.sees([900.0], [900.0]).all()
    again = pickle.loads(pickle.dumps(camera))
    np.testing.assert_array_equal(again.directions([900.0], [900.0]), camera.directions([900.0], [900.0]))


def test_a_decentred_lens_is_colmaps_and_is_inverted(rng):
    k1, k2, k3, k4 = EQUISOLID
    p1, p2 = 2e-3, -3e-3
    camera, v = fisheye((*EQUISOLID, p1, p2)), directions(rng.uniform(0, np.radians(95), 500), rng)
    # THIN_PRISM_FISHEYE as COLMAP documents it
    theta, phi = np.arccos(v[:, 2]), np.arctan2(v[:, 1], v[:, 0])
    x, y = theta * np.cos(phi), theta * np.sin(phi)
    radial = 1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
    seen_x = x * radial + 2 * p1 * x * y + p2 * (theta**2 + 2 * x**2)
    seen_y = y * radial + 2 * p2 * x * y + p1 * (theta**2 + 2 * y**2)
    xy = np.stack([camera.fx * seen_x + camera.cx, camera.fy * seen_y + camera.cy], -1)
    np.testing.assert_allclose(camera.project(v), xy, atol=1e-9)
    np.testing.assert_allclose(camera.directions(*xy.T), v, atol=1e-12)
    np.testing.assert_allclose(pickle.loads(pickle.dumps(camera)).project(v), xy, atol=1e-9)


def test_the_fit_of_a_decentred_lens_has_its_slopes(rng):
    camera = fisheye((*EQUISOLID, 0.02, -0.03))
    v = directions(rng.uniform(0.01, np.radians(80), 50), rng)
    problem = seen_problem(camera.project(v), camera, v)
    slope = np.asarray(problem.jacobian(np.eye(3), 1.0))
    for k, turn in enumerate(np.eye(3) * 1e-6):
        ahead, behind = (np.asarray(problem.predict(from_vector(s * turn), 1.0)) for s in (1, -1))
        np.testing.assert_allclose(slope[..., k], (ahead - behind) / 2e-6, atol=1e-3)
