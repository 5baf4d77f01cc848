# SPDX-License-Identifier: Apache-2.0
"""Stations of many sessions: repeats average what is new in them only."""

import json

import numpy as np
import pytest

from starpos.earth.geoid import Geoid
from starpos.errors import StationError
from starpos.units import ARCSEC
from starpos.zenith.stations import against_grid, read_session, stations_of
from starpos_testing.skies.deflections import COMMON_ARCSEC, NEW_ARCSEC, result

# a geoid that is a sum of two waves, m by deg
LENGTH_DEG = 0.5


def height(phi, lam):
    return 2.0 * np.sin((phi - 47) / LENGTH_DEG) + 1.5 * np.cos((lam - 8) / LENGTH_DEG)


def slopes(phi, lam):
    """xi, eta (arcsec) of this geoid, by the arcs of WGS 84."""
    f, a = 1 / 298.257223563, 6378137.0
    w = 1 - f * (2 - f) * np.sin(np.radians(phi)) ** 2
    north_m = np.radians(a * (1 - f) ** 2 / w**1.5)
    east_m = np.radians(a / np.sqrt(w)) * np.cos(np.radians(phi))
    north = 2.0 / LENGTH_DEG * np.cos((phi - 47) / LENGTH_DEG) / north_m
    east = -1.5 / LENGTH_DEG * np.sin((lam - 8) / LENGTH_DEG) / east_m
    return -north / ARCSEC, -east / ARCSEC


@pytest.fixture
def grid():
    phi, lam = np.meshgrid(np.arange(46, 48, 0.05), np.arange(7, 9, 0.05), indexing="ij")
    return Geoid(height(phi, lam).astype(np.float32), 46.0, 7.0, 0.05, 0.05)


def station(tmp_path, name, phi, lam, off=(0.0, 0.0)):
    xi, eta = slopes(phi, lam)
    path = result(tmp_path / f"{name}.json", phi, lam, xi + off[0], eta + off[1], station=name)
    return read_session(path)


def test_repeats_average_what_is_new_and_not_what_they_share(tmp_path):
    sessions = [read_session(result(tmp_path / f"{k}.json", 47, 8, 2 + 0.05 * k, 1)) for k in (-1, 0, 1)]
    (found,) = stations_of(sessions)
    assert found.at_geoid == pytest.approx([2, 1]) and found.at_mark == pytest.approx([2.1, 1])
    assert found.sigma == pytest.approx([np.sqrt(NEW_ARCSEC**2 / 3 + COMMON_ARCSEC**2)] * 2, rel=1e-4)
    assert found.chi2 == pytest.approx(2 * 0.05**2 / NEW_ARCSEC**2, rel=1e-4) and found.degrees == 4
    assert not found.doubt and found.off[:, 0] == pytest.approx([-0.05, 0, 0.05])


def test_repeats_that_contradict_each_other_are_told_and_widen_the_error(tmp_path):
    sessions = [read_session(result(tmp_path / f"{k}.json", 47, 8, 0.6 * k, 1, station="P")) for k in (0, 1)]
    (found,) = stations_of(sessions)
    assert "station P: its 2 sessions differ by 0.60" in found.doubt
    assert found.sigma[0] > 0.2


def test_marks_that_are_apart_are_stations_of_their_own(tmp_path):
    places = [(47.0, 8.0, ""), (47.0001, 8.0, ""), (47.0, 8.0, ""), (47.0, 8.000001, "P")]
    sessions = [
        read_session(result(tmp_path / f"{k}.json", phi, lam, 0, 0, station=name))
        for k, (phi, lam, name) in enumerate(places)
    ]
    assert [(s.name, len(s.sessions)) for s in stations_of(sessions)] == [("P", 3), ("2", 1)]
    far = read_session(result(tmp_path / "far.json", 47.1, 8, 0, 0, station="P"))
    with pytest.raises(StationError, match=r"station P, but their marks are 111\d\d.* m apart"):
        stations_of([sessions[3], far])


def test_a_grid_of_the_truth_leaves_no_difference(tmp_path, grid):
    (found,) = stations_of([station(tmp_path, "A", 47.21, 8.13, off=(0.3, -0.2))])
    _, off, _ = against_grid(found, grid)
    assert off == pytest.approx([0.3, -0.2], abs=0.02)
    assert against_grid(stations_of([station(tmp_path, "B", 30.0, 8.0)])[0], grid) is None


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_what_sessions_share_keeps_its_correlation(tmp_path, correlation):
    paths = [result(tmp_path / f"{k}.json", 47, 8, 2, 1, correlation=correlation) for k in range(9)]
    (found,) = stations_of([read_session(path) for path in paths])
    assert found.covariance[0, 1] == pytest.approx(correlation * COMMON_ARCSEC**2, abs=1e-9)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ("", "0 lines with a session"),
        ("no json", "no session's result"),
        ('{"combined": true, "xi_arcsec": 1}', "no 'site'"),
        (None, "cannot be read"),
    ],
)
def test_files_that_are_no_session_are_a_sentence(broken, words, tmp_path):
    path = tmp_path / "x.json"
    if broken is not None:
        path.write_text(broken)
    with pytest.raises(StationError, match=words):
        read_session(path)


def test_a_covariance_that_is_none_is_refused(tmp_path):
    path = result(tmp_path / "x.json", 47, 8, 0, 0)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[-1]["covariance_arcsec2"] = [[1.0, 2.0], [2.0, 1.0]]
    path.write_text("\n".join(map(json.dumps, lines)))
    with pytest.raises(StationError, match="is no covariance"):
        read_session(path)
