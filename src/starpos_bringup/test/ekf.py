# SPDX-License-Identifier: Apache-2.0
"""robot_localization's EKF on level ground (its ekf.cpp with two_d_mode), of many robots at once, without ROS."""

import numpy as np

# of robot_localization's 15 state variables those that level ground leaves: x, y, yaw, vx, vy, vyaw, ax, ay
KEPT = [0, 1, 5, 6, 7, 11, 12, 13]
X, Y, YAW, VX, VY, VYAW, AX, AY = range(8)
# it takes no measurement for better
MIN_VARIANCE = 1e-9


def half_turn(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


class Ekf:
    """State (n, 8) and covariance (n, 8, 8) of n robots, with the parameters of an ekf_node."""

    def __init__(self, parameters: dict, n: int):
        start = np.array(parameters["initial_estimate_covariance"])[KEPT]
        self.state = np.zeros((n, 8))
        self.covariance = np.tile(np.diag(start), (n, 1, 1))
        self._noise = np.diag(np.array(parameters["process_noise_covariance"])[KEPT])

    def predict(self, seconds: float) -> None:
        yaw, v, a = self.state[:, YAW], self.state[:, [VX, VY]], self.state[:, [AX, AY]]
        c, s = np.cos(yaw), np.sin(yaw)
        to_map = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
        transfer = np.tile(np.eye(8), (len(yaw), 1, 1))
        transfer[:, X : Y + 1, VX : VY + 1] = to_map * seconds
        transfer[:, X : Y + 1, AX : AY + 1] = to_map * seconds**2 / 2
        transfer[:, YAW, VYAW] = transfer[:, VX, AX] = transfer[:, VY, AY] = seconds
        way = v * seconds + a * seconds**2 / 2
        jacobian = transfer.copy()
        jacobian[:, X, YAW] = -s * way[:, 0] - c * way[:, 1]
        jacobian[:, Y, YAW] = c * way[:, 0] - s * way[:, 1]
        self.state = (transfer @ self.state[..., None])[..., 0]
        self.state[:, YAW] = half_turn(self.state[:, YAW])
        self.covariance = jacobian @ self.covariance @ jacobian.transpose(0, 2, 1) + self._noise * seconds

    def correct(self, config: list[bool], measured: np.ndarray, variances: np.ndarray) -> None:
        """Take what the 15 flags of `config` say is measured: (n, m), with its variances (m,)."""
        which = [KEPT.index(k) for k, used in enumerate(config) if used]
        pick = np.eye(8)[which]
        innovation = measured - self.state[:, which]
        if YAW in which:
            k = which.index(YAW)
            innovation[:, k] = half_turn(innovation[:, k])
        noise = np.diag(np.maximum(variances, MIN_VARIANCE))
        cross = self.covariance @ pick.T
        gain = cross @ np.linalg.inv(pick @ cross + noise)
        self.state = self.state + (gain @ innovation[..., None])[..., 0]
        self.state[:, YAW] = half_turn(self.state[:, YAW])
        rest = np.eye(8) - gain @ pick
        self.covariance = rest @ self.covariance @ rest.transpose(0, 2, 1) + gain @ noise @ gain.transpose(
            0, 2, 1
        )
