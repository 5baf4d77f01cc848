# SPDX-License-Identifier: Apache-2.0
"""Tables of trails, and observers' reports in the IOD format."""

import numpy as np
import pytest

from starpos.errors import SatelliteError
from starpos.satellites.sightings import read_iod, read_sightings, to_icrs

HEAD = "track,utc,ra_deg,dec_deg,stddev_arcsec\n"


def angles(v):
    return np.degrees(np.arctan2(v[1], v[0])) % 360, np.degrees(np.arcsin(v[2]))


def test_two_rows_are_the_ends_at_opening_and_closing(tmp_path):
    (tmp_path / "s.csv").write_text(
        HEAD
        + "4,2020-09-13T12:26:41.5Z,11,20,2\n4,2020-09-13T12:26:40.5Z,10,20,3\n7,2020-09-13T12:26:41Z,1,2,3\n"
    )
    trail, single = read_sightings(tmp_path / "s.csv")
    # in the order of time, not of rows, and half an exposure away from its middle
    assert trail.utc_unix_s.tolist() == [1600000000.5, 1600000001.5]
    assert angles(trail.directions[0]) == pytest.approx((10, 20))
    assert np.sqrt(trail.covariance[0, 0, 0]) * 206264.8 == pytest.approx(3)
    assert (single.track, len(single.directions), single.satellite) == (7, 1, None)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("1,yesterday,1,2,3", "no time"),
        ("1,2020-09-13T12:26:41Z,1,95,3", "dec_deg is 95"),
        ("1,2020-09-13T12:26:41Z,1,2,0", "stddev_arcsec is 0"),
        ("1,2020-09-13T12:26:41Z,1,2,3\n" * 2, "has 2 rows"),
    ],
)
def test_a_bad_row_is_named(tmp_path, row, said):
    (tmp_path / "s.csv").write_text(HEAD + row + "\n")
    with pytest.raises(SatelliteError, match=said):
        read_sightings(tmp_path / "s.csv")


def test_reports_of_observers(tmp_path):
    (tmp_path / "a.iod").write_text(
        "Observer's remarks\n"
        "23794 96 010A   2701 G 20040506012345678 17 15 1836165+402655 38 S+020 05\n"
        "23794 96 010A   2701 G 20040506012346678 28 25 1836300-402655 37\n"
        "23794 96 010A   2701 G 20040506012346678 28 45 1800000+400000 37\n"
    )
    (a, b), (sentence,) = read_iod(tmp_path / "a.iod")
    assert a.satellite == 23794
    assert a.utc_unix_s[0] == pytest.approx(1083806625.678, abs=1e-6)
    assert (a.time_stddev_s, b.time_stddev_s) == (pytest.approx(0.1), pytest.approx(2.0))
    assert angles(a.directions[0]) == pytest.approx(
        (15 * (18 + 36 / 60 + 16.5 / 3600), 40 + 26 / 60 + 55 / 3600)
    )
    assert np.sqrt(a.covariance[0, 0, 0]) * 206264.8 == pytest.approx(3)
    # minutes with three decimals, and of declination with two; 3 x 0.1 arcmin
    assert angles(b.directions[0]) == pytest.approx((15 * (18 + 36.3 / 60), -(40 + 26.55 / 60)))
    assert np.sqrt(b.covariance[0, 0, 0]) * 206264.8 == pytest.approx(18)
    assert "line 4: azimuth and elevation" in sentence


def test_epoch_code_0_is_of_date():
    """General precession by its yearly rates in right ascension and declination (Lieske 1977)."""
    ra, dec, years = np.radians(40), np.radians(30), 20.0
    m, n = np.radians(np.array([46.124, 20.043]) * years / 3600)
    moved = ra + m + n * np.sin(ra) * np.tan(dec), dec + n * np.cos(ra)
    of_date = [np.cos(moved[1]) * np.cos(moved[0]), np.cos(moved[1]) * np.sin(moved[0]), np.sin(moved[1])]
    utc = (years * 365.25 + 10957.5) * 86400
    got = angles(to_icrs(np.array(of_date), "0", utc))
    # second order and the bias: 2 arcsec
    assert got == pytest.approx((40, 30), abs=1e-3)
    # B1950 to J2000 of the FK5 catalogue's introduction: the pole of 1950 moved by 50 years
    pole = to_icrs(np.array([0.0, 0.0, 1.0]), "4", utc)
    assert np.degrees(np.arccos(pole[2])) * 3600 == pytest.approx(50 * 20.043, abs=2)
    with pytest.raises(ValueError, match="epoch code is 1"):
        to_icrs(np.array([0.0, 0.0, 1.0]), "1", utc)
