# SPDX-License-Identifier: Apache-2.0
"""Stations of many sessions: repeats average what is new in them only, levelling follows a geoid that is known."""

import json

import numpy as np
import pytest

from starpos.earth.geoid import Geoid, Grid
from starpos.errors import StationError
from starpos.units import ARCSEC
from starpos.zenith.stations import against_grid, between_m, levelled, read_session, stations_of
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
    return Geoid(Grid(height(phi, lam).astype(np.float32), 46.0, 7.0, 0.05, 0.05))


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
    compared = against_grid(found, grid)
    assert compared.off == pytest.approx([0.3, -0.2], abs=0.02)
    assert against_grid(stations_of([station(tmp_path, "B", 30.0, 8.0)])[0], grid) is None


def test_levelling_climbs_the_geoid_it_stands_on(tmp_path, grid):
    ends = [(47.0, 8.0), (47.02, 8.03), (47.05, 8.05)]
    line = stations_of([station(tmp_path, f"S{k}", *end) for k, end in enumerate(ends)])
    for geoid, most in ((None, 3.0), (grid, 0.3)):
        first, _, whole = levelled(line, geoid)
        for step, (a, b) in ((first, (0, 1)), (whole, (0, 2))):
            truth = height(*ends[b]) - height(*ends[a])
            assert abs(step.rise_m - truth) < max(most * step.between_m, 2e-5)
        assert whole.begin is line[0] and whole.end is line[2]
        # an error of 0.06 arcsec that is new at each end, and one of 0.03 that both share
        new, common = NEW_ARCSEC * ARCSEC, COMMON_ARCSEC * ARCSEC
        expected = first.distance_m * np.hypot(new / np.sqrt(2), common)
        assert first.measured_m == pytest.approx(expected, rel=0.01)
        assert first.distance_m == pytest.approx(np.hypot(0.02 * 111177, 0.03 * 76000), rel=2e-3)


def test_what_stations_share_tilts_a_line_by_its_correlation(tmp_path):
    ends = {"A": (47.0, 8.0), "B": (47.02, 8.03)}
    told = []
    for correlation in (-0.9, 0.0, 0.9):
        sessions = [
            read_session(
                result(tmp_path / f"{name}{k}.json", *end, 2, 1, station=name, correlation=correlation)
            )
            for name, end in ends.items()
            for k in range(50)
        ]
        line = stations_of(sessions)
        for found in line:
            assert found.covariance[0, 1] == pytest.approx(correlation * COMMON_ARCSEC**2, abs=1e-9)
        told.append(levelled(line, None)[0])
    # to the north-east: errors of xi and eta add if they are of one sign, and fifty sessions average all else
    azimuth, shared = told[1].azimuth, COMMON_ARCSEC * ARCSEC * told[1].distance_m
    new = NEW_ARCSEC * ARCSEC * told[1].distance_m / np.sqrt(2 * 50)
    for step, correlation in zip(told, (-0.9, 0.0, 0.9), strict=True):
        expected = np.hypot(shared * np.sqrt(1 + correlation * np.sin(2 * azimuth)), new)
        assert step.measured_m == pytest.approx(expected, rel=0.01)


def test_what_lies_between_stations_is_in_the_error(rng):
    """Random fields of the stated covariance, integrated."""
    at = np.linspace(0, 12_000.0, 241)
    far = np.abs(at[:, None] - at) / 8000
    root = np.linalg.cholesky((1 + far) * np.exp(-far) + np.eye(241) * 1e-9)
    fields = 6.0 * ARCSEC * root @ rng.normal(size=(241, 2000))
    errors = (fields[1:] + fields[:-1]).sum(0) * 25.0
    errors = errors - 6000 * (fields[0] + fields[-1])
    assert errors.std() == pytest.approx(between_m(12_000.0, 6.0, 8000.0), rel=0.06)


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
