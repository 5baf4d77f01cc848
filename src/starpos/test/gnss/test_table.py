# SPDX-License-Identifier: Apache-2.0
"""Tables of a receiver, and the place from their rows at a frame."""

import numpy as np
import pytest

from starpos.errors import GnssError
from starpos.gnss.receiver import read_gnss_csv

HEAD = "utc_unix_s,latitude,longitude,altitude_m,sigma_east_m,sigma_north_m,status"
START_S = 1.7e9


def row(t, north_m=0.0, status="0", sigma="2.5"):
    return f"{START_S + t:.3f},{47 + north_m / 111_200:.9f},8.0,500.0,{sigma},{sigma},{status}"


@pytest.fixture
def read(tmp_path):
    def read(*rows, head=HEAD):
        path = tmp_path / "gnss.csv"
        path.write_text("\n".join([head, *rows]) + "\n")
        return read_gnss_csv(path)

    return read


def north_m(place):
    return (np.degrees(place.latitude) - 47) * 111_200


def test_rows_in_any_order_tell_the_place_between_two_of_them(read):
    track, faults = read(row(3), row(1, 10.0), row(2, 20.0), row(0))
    assert not faults and north_m(track.at(START_S + 1.5)) == pytest.approx(15.0, abs=0.1)


def test_rows_without_a_place_are_counted_by_reason_and_tell_none(read):
    bad = (row(0, status="-1"), f"{START_S},,,,,,-1", f"{START_S},nan,NaN,nan,2.5,2.5,0", row(0, sigma=""),
           f"{START_S},0.0,0.0,0.0,2.5,2.5,0", f"{START_S},47,8")  # fmt: skip
    track, faults = read(*bad, row(60))
    assert len(track) == 1 and track.at(START_S) is None
    assert sum(int(fault.split(": ")[1].split()[0]) for fault in faults) == len(bad)


@pytest.mark.parametrize("there", [(row(5), row(5, 3000.0)), (row(5, 3000.0), row(5))])
def test_two_places_of_one_moment_tell_none(read, there):
    track, faults = read(row(0), *there, row(10))
    assert len(track) == 2 and "contradict" in faults[0]
    # the neighbours are too far in time
    assert track.at(START_S + 5) is None


def test_places_that_leap_as_of_two_receivers_are_an_error(read):
    track, _ = read(row(0), row(1, 3000.0), row(2), row(3, 3000.0))
    with pytest.raises(GnssError, match="two"):
        track.at(START_S + 0.5)


def test_a_place_that_is_carried_on_errs_by_the_way_of_the_vehicle(read):
    track, _ = read(row(0), row(1, 10.0))
    after = track.at(START_S + 3)
    assert after.covariance[1, 1] == pytest.approx(2.5**2 + 20.0**2, rel=1e-3)
    assert track.at(START_S + 4.5) is None


@pytest.mark.parametrize(
    ("head", "said"), [("utc_unix_s,latitude", "no column longitude"), ("a,b", "no column utc_unix_s")]
)
def test_a_table_without_its_columns_says_which(read, head, said):
    with pytest.raises(GnssError, match=said):
        read("1,2", head=head)


def test_a_table_that_is_not_there_says_so(tmp_path):
    with pytest.raises(GnssError, match="no such file"):
        read_gnss_csv(tmp_path / "none.csv")
