# SPDX-License-Identifier: Apache-2.0
"""Today's frames with the Earth's rotation as the IERS knew it in February 2024, which is what Ubuntu 24.04 has.

data/finals2000A-2024-02.gz: the rows from 2023 on of finals2000A in PyPI's astropy-iers-data 0.2024.2.26.0.28.55.
"""

import gzip
from pathlib import Path

import astropy_iers_data
import numpy as np
import pytest
from astropy.utils import iers
from cli_calls import KNOWN, PLACE, objects, solve

from starpos.earth import orientation
from starpos.errors import TimeError
from starpos.fix.solution import Solution, Status
from starpos.frames.frame import no_stars
from starpos.session import reports
from starpos.units import unix_of

TABLE = Path(__file__).parent / "data" / "finals2000A-2024-02.gz"
DAY_S = 86400


@pytest.fixture
def old_table(tmp_path, monkeypatch):
    path = tmp_path / "finals2000A.all"
    path.write_bytes(gzip.decompress(TABLE.read_bytes()))
    monkeypatch.setattr(astropy_iers_data, "IERS_A_FILE", str(path))
    # Loaded before, so that astropy's own table stays as it was, for the tests that come after.
    assert str(path) != iers.IERS_A_FILE
    orientation._table.cache_clear()
    yield
    orientation._table.cache_clear()


@pytest.fixture
def times():
    """Every tenth day since that table that is measured by now, with UT1-UTC as it came."""
    days = np.arange(unix_of("2024-02-20"), orientation.measured_until(), 10 * DAY_S)
    return [(t, orientation.earth_orientation(t).ut1_minus_utc_s) for t in days]


# `times` reads the new table before the old one is there
def test_ut1_is_within_the_claim_of_the_old_table(times, old_table):
    off = [(orientation.earth_orientation(t), ut1) for t, ut1 in times]
    sigmas = [abs(old.ut1_minus_utc_s - ut1) / old.ut1_sigma_s for old, ut1 in off]
    assert len(sigmas) > 60 and max(sigmas) < 3
    assert [old.extrapolated_days > 0 for old, _ in off].count(True) > 20


def test_todays_frames_claim_what_the_old_table_does_not_know(night, capsys, old_table):
    status, out, errors = solve(capsys, night, *KNOWN, "--json")
    *each, together = objects(out)
    assert status == 0
    for answer in each:
        east_m = (answer["longitude"] - PLACE["longitude"]) * 111320 * np.cos(np.radians(PLACE["latitude"]))
        assert abs(east_m) < 4 * answer["sigma_east_m"]
        # 88 m at the equator.
        assert 50 < answer["budget"]["ut1"][0] < 80
    assert together["iers_table_age_days"] == pytest.approx(991, abs=1)
    (line,) = errors
    assert "upgrade astropy-iers-data" in line
    status, out, _ = solve(capsys, night, *KNOWN)
    last = "Earth rotation: IERS table, measured until 2024-02-15, 992 days before these frames"
    assert status == 0 and out.splitlines()[-1] == last


def test_the_solvers_diagnostics_tell_the_age_of_the_old_table(old_table):
    frame = no_stars(640, 480, mid_unix_s=unix_of("2026-11-02T18:00:00"))
    answer = Solution.failed(frame, Status.NO_TILT, "no tilt")
    assert reports.of_solution(answer, {}).values["IERS table age (days)"] == pytest.approx(991, abs=1)


def test_from_2028_on_the_old_table_gives_no_fix(old_table):
    assert orientation.earth_orientation(unix_of("2028-02-01")).ut1_sigma_s > 0.4
    with pytest.raises(TimeError, match="upgrade astropy-iers-data"):
        orientation.earth_orientation(unix_of("2028-03-01"))
