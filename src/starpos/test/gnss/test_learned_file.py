# SPDX-License-Identifier: Apache-2.0
"""What was learned is there again, whole, and another file is refused."""

import json
import math

import numpy as np
import pytest

from starpos.earth.vertical import Deflection
from starpos.errors import GnssError
from starpos.gnss import states
from starpos.gnss.filter import place_of_stars
from starpos.gnss.watch import GnssStatus, GnssWatch
from starpos_testing.gnss_drives import GnssDrive

DRIVE = GnssDrive(stops=6)
UNKNOWN = Deflection(stddev_arcsec=6.0)


@pytest.fixture(scope="module")
def learned():
    watch = GnssWatch(DRIVE.instrument, Deflection())
    for moment in DRIVE.moments(np.random.default_rng(3)):
        watch.advance(moment.sighting)
        watch.learn(moment.sighting, moment.gnss, watch.judge(moment.sighting, moment.gnss))
    return watch.learned


@pytest.fixture
def saved(learned, tmp_path):
    states.save_learned(tmp_path / "learned.json", learned)
    return tmp_path / "learned.json"


def test_it_is_the_same_after_a_restart(learned, saved):
    again = states.read_learned(saved)
    for name in ("a3", "state", "covariance", "calibrated_up"):
        assert np.array_equal(getattr(again, name), getattr(learned, name))
    for name in (
        "axes",
        "utc_unix_s",
        "place",
        "frames",
        "poses",
        "since_unix_s",
        "temperature_c",
        "warmer_c",
    ):
        assert getattr(again, name) == getattr(learned, name)


def test_a_file_from_before_the_warmth_was_written_is_read(saved):
    content = json.loads(saved.read_text())
    del content["warmer_c"]
    saved.write_text(json.dumps(content))
    assert states.read_learned(saved).warmer_c == 0.0


def test_without_a_file_nothing_is_known(tmp_path):
    assert states.read_learned(tmp_path / "none.json") is None


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("starpos_learned", 99, "starpos_learned is not 1"),
        ("axes", 4, "axes"),
        ("state", [1.0], "state is not"),
        ("a3", np.eye(3).tolist()[::-1], "no rotation"),
        ("covariance", (-np.eye(20)).tolist(), "symmetric and positive"),
        ("frames", None, "not a file of what GNSS taught"),
        ("frames", math.inf, "not possible numbers"),
        ("axes", 2.0, "axes"),
        ("calibrated_up", [0.0, 0.0, 0.0], "no direction"),
        ("calibrated_up", [0.0, 0.0, 57.3], "no direction"),
        ("utc_unix_s", math.nan, "not possible numbers"),
        ("utc_unix_s", math.inf, "not possible numbers"),
        ("since_unix_s", math.inf, "not possible numbers"),
        ("warmer_c", math.nan, "not possible numbers"),
        ("temperature_c", math.inf, "not possible numbers"),
        ("temperature_c", 1e6, "not possible numbers"),
        ("place_rad", [math.nan, 0.1], "not possible numbers"),
        ("place_rad", [48.0, 11.0], "not possible numbers"),
    ],
)
def test_a_file_that_is_broken_says_what_is_wrong_and_what_to_do(saved, key, value, said):
    content = json.loads(saved.read_text()) | {key: value}
    saved.write_text(json.dumps(content))
    with pytest.raises(GnssError, match=said) as error:
        states.read_learned(saved)
    assert "delete it" in str(error.value)


@pytest.mark.parametrize(
    "changed", [{"utc_unix_s": 1.7e12}, {"utc_unix_s": 0.0}, {"place_rad": None}, {"frames": 0}]
)
def test_a_file_of_another_time_knows_little_and_its_claim_holds(saved, changed):
    """Times in milliseconds, or of a clock that began in 1970: the zero has wandered for as long."""
    saved.write_text(json.dumps(json.loads(saved.read_text()) | changed))
    watch, nees = GnssWatch(DRIVE.instrument, UNKNOWN, states.read_learned(saved)), []
    for k, moment in enumerate(DRIVE.moments(np.random.default_rng(3))):
        watch.advance(moment.sighting)
        if watch.tells_place(moment.sighting):
            place = place_of_stars(moment.sighting, watch.learned, UNKNOWN)
            off = place.offset_m(*moment.place)
            nees.append(off @ np.linalg.solve(place.covariance, off))
        if k < 9:
            check = watch.judge(moment.sighting, moment.gnss)
            assert check.status != GnssStatus.DISAGREES
            watch.learn(moment.sighting, moment.gnss, check)
    assert len(nees) > 10 and np.mean(nees) < 4


def test_a_place_that_cannot_be_written_is_an_error_of_one_sentence(learned, tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(GnssError, match="cannot be written"):
        states.save_learned(tmp_path / "folder", learned)
