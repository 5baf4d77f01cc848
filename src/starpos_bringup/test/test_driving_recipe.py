# SPDX-License-Identifier: Apache-2.0
"""The recipe for robot_localization on robots that drive a square by drifting odometry, with a fix every 3 s."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from ekf import YAW, Ekf, half_turn

RECIPE = Path(__file__).parent.parent / "config" / "robot_localization.yaml"
ROBOTS = 60
STEP_S, FIX_S = 0.1, 3.0
SIDE_M, SPEED_M_S, TURN_RAD_S = 200.0, 1.0, 0.5
# 1 sigma of a fix in each of east and north: of A3, which turns with the robot, of the deflection, which does not (both
# the same in all fixes), and of the tilts' noise, new in each
A3_M, DEFLECTION_M, TILT_M = 20.0, 31.0, 10.0
HEADING_RAD = np.radians(0.003)
# Odometry: noise of each message, which it states, and errors that stay, which it does not
NOISE_M_S, NOISE_RAD_S = 0.02, 0.02
SCALE, TURN_SCALE, DRIFT_RAD_S = 0.01, 0.02, np.radians(0.1)
# robot_localization's own
DEFAULT = [0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015]


@pytest.fixture(scope="module")
def recipe() -> dict:
    return yaml.safe_load(RECIPE.read_text())["ekf_map"]["ros__parameters"]


def square() -> np.ndarray:
    """Speed and rate of turn (steps, 2) of a robot that turns on the spot at each corner."""
    side = [(SPEED_M_S, 0.0)] * round(SIDE_M / SPEED_M_S / STEP_S)
    steps = round(np.pi / 2 / TURN_RAD_S / STEP_S)
    corner = [(0.0, np.pi / 2 / (steps * STEP_S))] * steps
    return np.array((side + corner) * 4)


@dataclass
class Driven:
    """What came of the drives at each step: errors (steps, robots, 2) in m and (steps, robots) in rad, and claims."""

    place_m: np.ndarray
    place_covariance: np.ndarray
    yaw_rad: np.ndarray
    yaw_sigma_rad: np.ndarray

    @property
    def chi2(self) -> np.ndarray:
        e = self.place_m[..., None]
        return (e.swapaxes(-1, -2) @ np.linalg.inv(self.place_covariance) @ e)[..., 0, 0]


def drive(parameters: dict) -> Driven:
    rng = np.random.default_rng(15)
    filter_ = Ekf(parameters, ROBOTS)

    def draw(sigma: float, *shape: int) -> np.ndarray:
        return rng.normal(0.0, sigma, (ROBOTS, *shape))

    a3, deflection, heading = draw(A3_M, 2), draw(DEFLECTION_M, 2), draw(HEADING_RAD)
    scale, turn_scale, drift = 1 + draw(SCALE), 1 + draw(TURN_SCALE), draw(DRIFT_RAD_S)
    place, yaw = np.zeros(2), 0.0
    kept: list[tuple] = []
    for step, (speed, rate) in enumerate(square()):
        if step % round(FIX_S / STEP_S) == 0:
            c, s = np.cos(yaw), np.sin(yaw)
            fixes = place + a3 @ np.array([[c, s], [-s, c]]) + deflection + draw(TILT_M, 2)
            variance = A3_M**2 + DEFLECTION_M**2 + TILT_M**2
            filter_.correct(parameters["odom1_config"], fixes, np.full(2, variance))
            filter_.correct(parameters["imu0_config"], (yaw + heading)[:, None], np.array([HEADING_RAD**2]))
        told = np.zeros((ROBOTS, 3))
        told[:, 0] = speed * scale + draw(NOISE_M_S)
        told[:, 1] = draw(NOISE_M_S)
        told[:, 2] = rate * turn_scale + drift + draw(NOISE_RAD_S)
        filter_.correct(parameters["odom0_config"], told, np.array([NOISE_M_S, NOISE_M_S, NOISE_RAD_S]) ** 2)
        filter_.predict(STEP_S)
        yaw += rate * STEP_S
        place = place + speed * STEP_S * np.array([np.cos(yaw), np.sin(yaw)])
        kept.append(
            (
                filter_.state[:, :2] - place,
                filter_.covariance[:, :2, :2],
                half_turn(filter_.state[:, YAW] - yaw),
                np.sqrt(filter_.covariance[:, YAW, YAW]),
            )
        )
    return Driven(*(np.array(column) for column in zip(*kept, strict=True)))


@pytest.fixture(scope="module")
def driven(recipe) -> Driven:
    return drive(recipe)


@pytest.mark.montecarlo
def test_the_place_is_within_its_claim_though_fixes_share_their_errors(driven):
    # 2 where claims are true.
    assert driven.chi2.mean() < 2.5
    # 99 % of two numbers.
    assert np.mean(driven.chi2 < 9.21) > 0.98
    # and no wider than between two fixes that stand alone
    fix_m = np.sqrt(A3_M**2 + DEFLECTION_M**2 + TILT_M**2)
    assert np.sqrt(driven.place_covariance[:, :, 0, 0]).max() < 1.5 * fix_m


def test_yaw_between_fixes_is_as_good_as_the_odometry(driven):
    sigma_deg = np.degrees(driven.yaw_sigma_rad)
    assert sigma_deg.max() < 1.5
    # of the first step after a fix
    assert sigma_deg[:: round(FIX_S / STEP_S)].max() < 0.3
    assert np.degrees(np.sqrt(np.mean(driven.yaw_rad**2))) < 0.7
    assert np.mean(np.abs(driven.yaw_rad) < 2.58 * driven.yaw_sigma_rad) > 0.98


@pytest.mark.montecarlo
def test_robot_localizations_own_process_noise_does_not_do(recipe):
    """A broken filter that the drives must detect: its place claims a tenth of its error, its yaw drifts."""
    driven = drive(recipe | {"process_noise_covariance": DEFAULT})
    assert driven.chi2.mean() > 20
    assert np.degrees(driven.yaw_sigma_rad).max() > 17
