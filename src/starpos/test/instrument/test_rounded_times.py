# SPDX-License-Identifier: Apache-2.0
"""Times with too few digits, and dates as astronomers count them, are called what they are."""

import numpy as np
import pytest

from starpos.earth.orientation import earth_orientation
from starpos.errors import TiltError, TimeError
from starpos.instrument.tilt_table import read_tilt_csv

T = 1793642400.25 + 0.5 * np.arange(40)


def table(path, times):
    rows = "".join(f"{t},{1.0 + 1e-4 * (k % 7)},-2.0\n" for k, t in enumerate(times))
    path.write_text("utc_unix_s,theta_x_deg,theta_y_deg\n" + rows)
    return path


@pytest.mark.parametrize(
    "rounded", [lambda t: f"{t:g}", lambda t: f"{float(np.float32(t)):.3f}", lambda t: "1793642400.5"]
)
def test_rounded_times_are_named(tmp_path, rounded):
    with pytest.raises(TiltError, match="double precision"):
        read_tilt_csv(table(tmp_path / "tilt.csv", [rounded(t) for t in T]))


@pytest.mark.parametrize("times", [T, np.round(T), T[:1] // 128 * 128, [1793642400.5] * 3])
def test_others_are_read(tmp_path, times):
    assert len(read_tilt_csv(table(tmp_path / "tilt.csv", times)).utc_unix_s) == len(times)


@pytest.mark.parametrize(
    ("time", "said"), [(2461347.25, "a Julian date"), (61346.75, "modified Julian"), (1234.0, "Gazebo")]
)
def test_a_date_is_not_taken_for_a_simulation(time, said):
    with pytest.raises(TimeError, match=said):
        earth_orientation(time)
