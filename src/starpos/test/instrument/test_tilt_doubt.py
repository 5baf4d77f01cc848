# SPDX-License-Identifier: Apache-2.0
"""Tables of tilts that look like radians, and those that do not."""

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilt_table import like_radians, read_tilt_csv

NOISE = np.radians(0.0035)


def table(theta_x, theta_y, noise, stated=NOISE, number=40, period_s=0.1):
    """Readings of two angles, in rad, that a reader took for degrees."""
    rng = np.random.default_rng(3)
    theta = np.array([theta_x, theta_y])[:, None] + rng.normal(0, noise, (2, number))
    t = 1.8e9 + np.arange(number) * period_s
    return TiltLog.of(t, *np.radians(theta), np.full(number, np.nan), np.full(number, stated))


@pytest.mark.parametrize("angle", [0.0, 0.05, -0.2, 0.5])
def test_radians_are_seen_at_any_lean(angle):
    assert "look like radians" in like_radians(table(angle, -0.1, NOISE))


def test_radians_are_seen_of_one_reading_a_frame():
    assert "look like radians" in like_radians(table(0.05, -0.1, NOISE, number=12, period_s=20.0))


@pytest.mark.parametrize(
    "sound",
    [
        # a level instrument in degrees
        table(0.02, -0.01, np.degrees(NOISE)),
        table(12.0, -3.0, np.degrees(NOISE)),
        table(0.02, -0.01, np.degrees(NOISE), number=12, period_s=20.0),
        # readings of no noise, or too few of them
        table(0.1, 0.1, 0.0),
        table(0.1, 0.1, NOISE, number=6),
        # a quiet sensor whose noise is stated
        table(0.1, 0.1, np.degrees(1e-6), stated=1e-6),
        # beyond a right angle no reading is of radians
        table(2.0, 0.1, NOISE),
    ],
    ids=["level", "leaning", "one a frame", "without noise", "few", "quiet", "large"],
)
def test_degrees_are_left_in_peace(sound):
    assert like_radians(sound) == ""


@pytest.mark.parametrize(("theta_y", "refused"), [(-1135.3, True), (-11.588, False), (348.412, False)])
def test_degrees_and_minutes_are_named_and_a_full_turn_is_not(tmp_path, theta_y, refused):
    """-11 deg 35.3 arcmin as ddmm.mm, in degrees, and counted from 0 to 360."""
    rows = "".join(f"{1.79e9 + k},{3.08 + 1e-3 * (k % 3)},{theta_y + 1e-3 * (k % 2)}\n" for k in range(30))
    (tmp_path / "tilt.csv").write_text("utc_unix_s,theta_x_deg,theta_y_deg\n" + rows)
    if refused:
        with pytest.raises(TiltError, match=r"beyond a full turn \(1135.*ddmm.mm"):
            read_tilt_csv(tmp_path / "tilt.csv")
    else:
        log = read_tilt_csv(tmp_path / "tilt.csv")
        assert np.degrees(log.theta_y) == pytest.approx(-11.588, abs=2e-3)
