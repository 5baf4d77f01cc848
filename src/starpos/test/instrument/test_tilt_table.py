# SPDX-License-Identifier: Apache-2.0
"""Tables of tilts that hold the readings of one inclinometer, or of two."""

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument.tilt_table import read_tilt_csv


def table(path, *logs):
    """A table of the rows (time, x, y in deg) of the logs, one after another."""
    rows = np.concatenate(logs)
    np.savetxt(path, rows, delimiter=",", header="utc_unix_s,theta_x_deg,theta_y_deg", fmt="%.6f")
    return path


def test_two_inclinometers_in_one_table_are_refused(tmp_path):
    t = 1000 + 0.1 * np.arange(100)
    mine = np.stack([t, np.full(100, 1.0), np.full(100, 2.0)], 1)
    other = np.stack([t, np.full(100, 1.1), np.full(100, 2.0)], 1)
    for offset in (0.0, 0.05, 5.0):
        with pytest.raises(TiltError, match="two inclinometers"):
            read_tilt_csv(table(tmp_path / "tilt.csv", mine, other + np.array([offset, 0, 0])))


@pytest.mark.parametrize("noise_deg", [0.0, 0.0035])
def test_two_inclinometers_whose_readings_alternate_are_refused(tmp_path, rng, noise_deg):
    t = 1000 + 0.1 * np.arange(300)
    x, y = rng.normal(0, noise_deg, (2, 300))
    merged = np.stack([t, 1 + x + 0.02 * (np.arange(300) % 2), 2 + y], 1)
    with pytest.raises(TiltError, match=r"alternate between two tilts, as if .* two inclinometers"):
        read_tilt_csv(table(tmp_path / "tilt.csv", merged))


@pytest.mark.parametrize(("often", "held"), [(10, 1), (10, 10), (3, 1), (2, 1), (1, 1), (0.2, 1)])
def test_two_inclinometers_of_which_one_is_read_more_often_are_refused(tmp_path, rng, often, held):
    """Its driver may give each reading several times."""
    one, other = 1000 + 0.1 * np.arange(60), 1000.031 + 0.1 / often * np.arange(60 * often)
    logs = []
    for t, x, times in ((one, 1.0, 1), (other, 1.1, held)):
        noise = rng.normal(0, 0.0035, (2, len(t))).repeat(times, axis=1)[:, : len(t)]
        logs.append(np.stack([t, *(np.array([[x], [2.0]]) + noise)], 1))
    merged = np.concatenate(logs)
    with pytest.raises(TiltError, match=r"as if .* two inclinometers"):
        read_tilt_csv(table(tmp_path / "tilt.csv", merged[np.argsort(merged[:, 0])]))


def test_wild_readings_and_turns_are_of_one_inclinometer(tmp_path, rng):
    """Many readings are wild, or a few are wild alike, or the mount goes there and back."""
    t = 1000 + 0.1 * np.arange(1000)
    x, y = rng.normal(0, 0.0035, (2, 1000))
    wild, alike = rng.random(1000) < 0.1, np.arange(1000) % 50 == 7
    for extra in (wild * rng.normal(0, 5, 1000), alike * 1.0, 1.0 * (t % 20 < 10), 0.02 * np.sin(13 * t)):
        read_tilt_csv(table(tmp_path / "tilt.csv", np.stack([t, 1 + x + extra, 2 + y], 1)))


def test_one_inclinometer_does_not_alternate(tmp_path, rng):
    """White noise, coarse or not, with a turn, and an instrument that is read once in each of two poses."""
    t = 1000 + 0.1 * np.arange(600)
    for step in (1e-6, 0.003, 0.02):
        x, y = np.round(rng.normal(0, 0.0035, (2, 600)) / step) * step
        read_tilt_csv(table(tmp_path / "tilt.csv", np.stack([t, 1 + x + 3 * (t > 1030), 2 + y], 1)))
    to_and_fro = np.stack([1000 + 60.0 * np.arange(300), 1 + np.arange(300) % 2, np.zeros(300)], 1)
    read_tilt_csv(table(tmp_path / "tilt.csv", to_and_fro))


def test_nights_in_any_order_and_a_part_twice_are_one_table(tmp_path):
    t = 1000 + 0.1 * np.arange(100)
    night = np.stack([t, np.full(100, 1.0), np.full(100, 2.0)], 1)
    later = night + np.array([86400, 0, 0])
    for logs in ((later, night), (night, later), (night, night[50:]), (night, later, night)):
        tilt = read_tilt_csv(table(tmp_path / "tilt.csv", *logs)).average(1005.0, 0.5)
        assert tilt.samples == 5
