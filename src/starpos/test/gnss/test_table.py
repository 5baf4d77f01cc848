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


def place_row(t, latitude, longitude, sigma="2.5"):
    return f"{START_S + t:.3f},{latitude:.9f},{longitude:.9f},0.0,{sigma},{sigma},0"


@pytest.mark.parametrize("ends", [(179.9999, -179.9999), (-179.9999, 179.9999), (359.9999, 0.0001)])
def test_between_two_sides_of_a_meridian_lies_the_meridian(read, ends):
    track, faults = read(*(place_row(t, 60.0, longitude) for t, longitude in zip((0, 1), ends, strict=True)))
    place = track.at(START_S + 0.5)
    assert not faults and abs(place.offset_m(np.radians(60), np.radians(round(ends[0])))[0]) < 1e-3


@pytest.mark.parametrize("shift_s", [0.0, 2.9])
def test_a_table_of_one_row_or_of_doubled_rows_is_one_place(read, shift_s):
    for rows in ([place_row(0, 47.0, 8.0)], 5 * [place_row(0, 47.0, 8.0)]):
        track, faults = read(*rows)
        assert len(track) == 1 and (len(faults) == 0) == (len(rows) == 1)
        assert track.at(START_S + shift_s).covariance[0, 0] == pytest.approx(6.25)
        assert track.at(START_S + 3.1) is None


@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9])
def test_times_of_another_unit_tell_no_place(read, scale):
    rows = [row(t) for t in range(5)]
    spoilt = [f"{float(r.split(',')[0]) * scale:.3f},{r.split(',', 1)[1]}" for r in rows]
    assert read(*spoilt)[0].at(START_S + 2) is None and read(*rows)[0].at(START_S + 2) is not None


@pytest.mark.parametrize("rate_hz", [0.5, 1, 5, 20])
def test_a_place_is_carried_by_the_vehicles_speed_whatever_the_receivers_rate(read, rate_hz):
    """At 10 Hz the speed was a tenth of the true one, and 60 m of way were claimed as 6 m."""
    track, _ = read(*(row(k / rate_hz, 20.0 * k / rate_hz) for k in range(round(10 * rate_hz))))
    last_s = 10 - 1 / rate_hz
    for at_s, way_m in ((last_s + 2.5, 50.0), (-2.5, 50.0)):
        assert track.at(START_S + at_s).covariance[1, 1] == pytest.approx(2.5**2 + way_m**2, rel=0.05)


def test_places_of_any_order_gaps_and_sizes_are_interpolated_or_none(rng, read):
    """A receiver that drives at 20 m/s: wherever it has a place, this is the true one within its error."""
    times = np.unique(rng.uniform(0, 300, 200).round(3))
    rows = [row(t, 20.0 * t) for t in rng.permutation(times)]
    track, _ = read(*rows)
    for t in rng.uniform(-5, 305, 300):
        place = track.at(START_S + t)
        assert (place is None) == (np.abs(times - t).min() > 3.0)
        if place is not None:
            assert abs(north_m(place) - 20 * t) < 3 * np.sqrt(place.covariance[1, 1])


@pytest.mark.parametrize(
    ("head", "said"), [("utc_unix_s,latitude", "no column longitude"), ("a,b", "no column utc_unix_s")]
)
def test_a_table_without_its_columns_says_which(read, head, said):
    with pytest.raises(GnssError, match=said):
        read("1,2", head=head)


def test_a_table_that_is_not_there_says_so(tmp_path):
    with pytest.raises(GnssError, match="no such file"):
        read_gnss_csv(tmp_path / "none.csv")
