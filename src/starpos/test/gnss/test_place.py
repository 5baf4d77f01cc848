# SPDX-License-Identifier: Apache-2.0
"""Values that a receiver may state, and the sentence for each one without a place."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import GnssError
from starpos.gnss.receiver import message_to_gnss

SOUND = {
    "status": 0,
    "latitude": 47.0,
    "longitude": 8.0,
    "covariance": np.diag([4.0, 9.0, 25.0]),
    "kind": 2,
    "frame_id": "gps",
    "stamp": 1_700_000_000,
}


def message(**changes):
    values = SOUND | changes
    return SimpleNamespace(
        header=SimpleNamespace(
            stamp=SimpleNamespace(sec=values["stamp"], nanosec=0), frame_id=values["frame_id"]
        ),
        status=SimpleNamespace(status=values["status"]),
        latitude=values["latitude"],
        longitude=values["longitude"],
        position_covariance=values["covariance"].ravel(),
        position_covariance_type=values["kind"],
    )


def test_a_sound_fix_is_a_place_without_an_altitude_too():
    place = message_to_gnss(message())
    assert np.degrees([place.latitude, place.longitude]) == pytest.approx([47.0, 8.0], abs=1e-12)
    assert place.covariance.tolist() == [[4.0, 0.0], [0.0, 9.0]]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"status": -1}, "no fix"),
        ({"latitude": np.nan}, "not a number"),
        ({"longitude": np.inf}, "not a number"),
        ({"latitude": 0.0, "longitude": 0.0}, "0 N 0 E"),
        ({"latitude": 91.0}, "latitude first"),
        ({"kind": 0}, "states no error"),
        ({"covariance": np.full((3, 3), np.nan)}, "states no error"),
        ({"covariance": np.diag([4.0, -4.0, 4.0])}, "states no error"),
        ({"covariance": np.diag([1e9, 1e9, 1e9])}, "over 10 km"),
        *(
            ({"frame_id": name}, "another datum")
            for name in ("map_NAD-27", "PZ-90", "gcj_02", "rover/gps_ed50", "tokyo")
        ),
        ({"stamp": 0}, "no time stamp"),
    ],
)
def test_what_tells_no_place_says_why_in_a_sentence(changes, said):
    with pytest.raises(GnssError, match=said):
        message_to_gnss(message(**changes))


@pytest.mark.parametrize(
    "frame_id", ["", "tokyo_rover/gps", "tokyo/gps", "speed50_gps", "led50", "led-50", "nad27_mast"]
)
def test_a_frame_whose_name_only_holds_the_letters_of_a_datum_is_taken(frame_id):
    message_to_gnss(message(frame_id=frame_id))


def test_an_error_may_be_taken_for_one_that_is_not_stated():
    assert message_to_gnss(message(kind=0), 30.0).covariance[0, 0] == 900.0


@pytest.mark.parametrize("cross", [1.0, 5.0, 1e300])
def test_a_covariance_of_which_one_half_is_filled_in_is_whole_or_no_covariance(cross):
    """Its lower half alone was checked: with 1e300 m2 above it, a place was compared by no chi-square."""
    for halves in ([[4.0, cross], [0.0, 9.0]], [[4.0, 0.0], [cross, 9.0]]):
        covariance = np.diag([4.0, 9.0, 25.0])
        covariance[:2, :2] = halves
        if cross / 2 < 6.0:
            found = message_to_gnss(message(covariance=covariance)).covariance
            assert np.array_equal(found, found.T) and np.linalg.eigvalsh(found)[0] > 0
        else:
            with pytest.raises(GnssError, match="states no error"):
                message_to_gnss(message(covariance=covariance))


def test_metres_to_a_place_across_the_date_line():
    east = message_to_gnss(message(longitude=-179.999, latitude=0.5))
    here = message_to_gnss(message(longitude=179.999, latitude=0.5))
    assert east.offset_m(here.latitude, here.longitude) == pytest.approx([222.6, 0.0], abs=0.1)
