# SPDX-License-Identifier: Apache-2.0
"""Cards of a header that agree on when a frame was exposed, that contradict each other, or that are no times."""

import re
from datetime import datetime, timezone

import numpy as np
import pytest

from starpos.frames.exposure import UNKNOWN_LATENCY_S
from starpos.frames.header import read_times

START_S = datetime(2026, 11, 2, 18, tzinfo=timezone.utc).timestamp()
START = {"DATE-OBS": "2026-11-02T18:00:00.000"}
STEP_S = 0.001 / np.sqrt(3)


@pytest.mark.parametrize(
    ("cards", "middle_s", "exposure_s"),
    [
        ({**START, "EXPTIME": 4, "EXPOSURE": 4}, 2, 4),
        ({**START, "EXPTIME": 0, "EXPOSURE": 4}, 2, 4),
        ({**START, "EXPTIME": "4.0"}, 2, 4),
        ({**START, "EXP": 15.0}, 7.5, 15),
        ({**START, "DATE-END": "2026-11-02T18:00:04.000"}, 2, 4),
        ({**START, "EXPTIME": 4, "DATE-AVG": "2026-11-02T18:00:02.000", "STACKCNT": 1, "TOTALEXP": 4}, 2, 4),
        ({"DATE-AVG": "2026-11-02T18:00:02.000", "EXPTIME": 4}, 2, 4),
        ({"DATE-AVG": "2026-11-02T18:00:02.000", "DATE-OBS": "2026-11-02"}, 2, None),
        ({"MJD-OBS": "61346.75000000", "EXPTIME": 4}, 2, 4),
        ({"DATE-OBS": "2026-11-02", "UTSTART": " 18:00:00.000 ", "EXPTIME": 4}, 2, 4),
    ],
)
def test_what_agrees_is_the_middle_of_the_exposure(cards, middle_s, exposure_s):
    read = read_times(cards)
    assert read.mid_unix_s - START_S == pytest.approx(middle_s, abs=1e-5)
    assert read.exposure_s == (exposure_s if exposure_s is None else pytest.approx(exposure_s))


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({**START, "EXPTIME": 0}, "EXPTIME is 0"),
        ({**START, "EXPTIME": ""}, "needs EXPTIME"),
        (START, "needs EXPTIME"),
        ({**START, "EXPTIME": 4, "EXPOSURE": 0.5}, "EXPTIME .*EXPOSURE .*contradict"),
        ({**START, "EXPTIME": 0.5, "DATE-END": "2026-11-02T18:00:04"}, "DATE-END .*contradict"),
        ({**START, "EXPTIME": 0.5, "DATE-AVG": "2026-11-02T18:00:02"}, "contradict"),
        ({**START, "EXPTIME": 0.5, "LIVETIME": 4.0}, "LIVETIME .*contradict"),
        ({**START, "MJD-OBS": 61346.7612, "EXPTIME": 0.5}, "contradict"),
        ({**START, "DATE-END": "2026-11-02T17:59:00", "EXPTIME": 1}, "DATE-END is before its DATE-OBS"),
        ({**START, "EXPTIME": 10, "STACKCNT": 187, "TOTALEXP": 1870}, "stack of 187 exposures"),
        ({**START, "EXPTIME": 10, "NCOMBINE": 8}, "stack of 8"),
        ({**START, "EXPTIME": 10, "SNAPSHOT": 3}, "stack of 3"),
        ({**START, "EXPTIME": -1}, "EXPTIME is -1"),
        ({**START, "EXPTIME": "long"}, "EXPTIME is 'long'"),
        ({**START, "EXPTIME": 1e300}, "EXPTIME"),
        ({**START, "EXPTIME": 10**400}, "EXPTIME"),
        ({**START, "EXPTIME": 7200}, "EXPTIME is 7200: give 0 to 3600 s"),
        ({**START, "EXPTIME": 1, "TIMESYS": "MOON"}, "TIMESYS is 'moon'"),
        ({"DATE-OBS": "26/07/102", "EXPTIME": 1}, "26/07/102.*no time"),
        ({"DATE-OBS": "now", "EXPTIME": 1}, "'now'.*no time"),
        ({"DATE-OBS": "2026-13-45T99:00:00", "EXPTIME": 1}, "no time"),
        ({"DATE-OBS": "2026-11-02T18:00:75", "EXPTIME": 1}, "seconds to 59"),
        ({"DATE-OBS": "2026-11-02T18:00:60", "EXPTIME": 1}, "seconds to 59"),
        ({"DATE-OBS": "2026-11-02", "UT": "25:00:00", "EXPTIME": 1}, "no time"),
        ({"MJD-OBS": 1e300, "EXPTIME": 1}, "no time"),
        ({"MJD-OBS": "soon", "EXPTIME": 1}, "no number"),
    ],
)
def test_what_contradicts_itself_or_is_none_tells_no_time_and_says_why(cards, words):
    read = read_times(cards)
    assert read.mid_unix_s is None
    assert re.search(words, read.untimed), read.untimed
    assert "\n" not in read.untimed


def test_cards_that_are_a_little_apart_are_in_the_claim():
    """A DATE-END 0.6 s late by the time the frame took to come: the middle may be 0.3 s later."""
    late = read_times({**START, "EXPTIME": 4, "DATE-END": "2026-11-02T18:00:04.600"})
    assert late.mid_unix_s - START_S == pytest.approx(2.0, abs=1e-5)
    assert late.stamp_stddev_s == pytest.approx(0.3, abs=0.01)
    # whole seconds are only cut off
    cut = read_times({**START, "EXPTIME": 4, "DATE-END": "2026-11-02T18:00:04"})
    assert cut.stamp_stddev_s == pytest.approx(STEP_S)
    assert read_times({**START, "EXPTIME": 4, "DATE-END": "2026-11-02T18:00:06.000"}).untimed


def test_the_finest_of_several_times_is_the_one_that_counts():
    read = read_times(
        {"DATE-OBS": "2026-11-02T18:00:00", "DATE-AVG": "2026-11-02T18:00:02.7500", "EXPTIME": 4}
    )
    assert read.mid_unix_s - START_S == pytest.approx(2.75, abs=1e-5)
    assert read.stamp_stddev_s == pytest.approx(1e-4 / np.sqrt(3))


def test_an_end_alone_tells_the_middle_but_for_the_delay_of_who_reads_the_clock():
    read = read_times({"DATE-END": "2026-11-02T18:00:04.000", "EXPTIME": 4})
    assert read.mid_unix_s - START_S == pytest.approx(2.0, abs=1e-5)
    assert read.stamp_stddev_s == pytest.approx(np.hypot(STEP_S, UNKNOWN_LATENCY_S))


def test_without_any_card_nothing_is_said():
    for cards, exposure_s in (({"EXPTIME": 2}, 2.0), ({}, None)):
        nothing = read_times(cards)
        assert (nothing.exposure_s, nothing.mid_unix_s, nothing.untimed) == (exposure_s, None, "")


LOCAL = {"DATE-OBS": "2026-11-02T20:00:00.000", "EXPTIME": 4}
UTC = {**START, "EXPTIME": 4}


@pytest.mark.parametrize(
    "cards",
    [
        {"UT": "18:00:00.000"},
        {"UT": "18:00:04"},
        {"UTC": "2026-11-02T18:00:00"},
        {"TIME-OBS": "18:00"},
        {"UTSTART": "18:00:00"},
        {"DATE-UTC": "2026-11-02T18:00:01.5"},
        {"JD": 2461347.25},
        {"JD": "2461347.2500231"},
        {"EXPSTART": 61346.75},
        {"UNIXTIME": START_S},
        {"MJD": 61346.75, "OBSJD": 2461347.25, "UT-START": "18:00:00", "GPS-TIME": "2026-11-02T18:00:00"},
        {"MJD": 61346},
        {"GPSTIME": 151218.0},
        {"GPSTIME": 1.478e9},
        {"DATE-LOC": "2026-11-02T20:00:00", "TIMEZONE": 2},
        {"DATE-LOC": "2026-11-02T13:00:00", "TIMEZONE": "UTC-5"},
        {"TIMEZONE": 0},
        {"TIMEZONE": "UTC"},
        {"TIMEZONE": 2, "UT": "18:00:02"},
        # of other moments, or no times
        {
            "HJD": 2461347.2531,
            "DATE": "2026-11-02T20:03:11",
            "UT": "unknown",
            "JD": 12.5,
            "COADDS": 1,
            "NFRAMES": 1,
        },
        {"IMAGETYP": "Light Frame", "IMCMB001": "raw_1.fits"},
    ],
)
def test_cards_that_agree_with_utc_change_nothing(cards):
    read = read_times({**UTC, **cards})
    assert read.facts == read_times(UTC).facts


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"UT": "18:00:00.000"}, "UT is -2.00 h .*local"),
        ({"UTC": "18:00:00"}, "local"),
        ({"TIME-OBS": "18:00:00"}, "TIME-OBS"),
        ({"UTSTART": "18:00"}, "UTSTART"),
        ({"DATE-UTC": "2026-11-02T18:00:00"}, "DATE-UTC"),
        ({"JD": 2461347.25}, "JD is -2.00 h"),
        ({"EXPSTART": 61346.75}, "EXPSTART"),
        ({"EXPSTART": "2026-11-02T18:00:00"}, "EXPSTART"),
        ({"UNIXTIME": START_S}, "UNIXTIME"),
        ({"MJD": 61346.75}, "MJD"),
        ({"OBSJD": 2461347.25}, "OBSJD"),
        ({"UT-START": "18:00:00"}, "UT-START"),
        ({"GPS-TIME": "2026-11-02T18:00:00"}, "GPS-TIME"),
        ({"UT": "17:11:00"}, "contradict"),
        ({"TIMEZONE": 2}, "TIMEZONE is \\+2 h"),
        ({"TIMEZONE": "+02:00", "DATE-LOC": "2026-11-02T20:00:00"}, "local time"),
    ],
)
def test_a_local_time_next_to_utc_is_seen(cards, words):
    read = read_times({**LOCAL, **cards})
    assert read.mid_unix_s is None and re.search(words, read.untimed), read


def test_another_clock_that_is_some_seconds_off_widens_the_claim():
    assert read_times({**UTC, "UT": "18:00:44.0"}).stamp_stddev_s == pytest.approx(35, abs=1)


@pytest.mark.parametrize(
    ("comment", "middle_s"),
    [
        ("UTC, start of exposure", 2),
        ("[UTC] GPS start of exposure", 2),
        ("UTC+0, begin", 2),
        ("estimated start", 2),
        ("Start of exposure, the end is in DATE-END", 2),
        ("mid-exposure (UT)", 0),
        ("UTC at the middle of the exposure", 0),
        ("End of exposure UTC", -2),
        ("Frame grabbed", -2),
    ],
)
def test_a_comment_says_which_moment_a_date_is(comment, middle_s):
    read = read_times(UTC, {"DATE-OBS": comment})
    assert read.mid_unix_s - START_S == pytest.approx(middle_s, abs=1e-5)


@pytest.mark.parametrize(
    ("comment", "word"),
    [
        ("Local time of start of exposure", "local"),
        ("start [CET]", "local"),
        ("UTC+1", "local"),
        ("GMT -5, start", "local"),
        ("GPS time", "GPS"),
        ("TAI, start", "37 s ahead"),
        ("civil time", "local"),
        ("Image created time", "made"),
    ],
)
def test_a_comment_that_says_another_time_gives_no_time(comment, word):
    read = read_times(UTC, {"DATE-OBS": comment})
    assert read.mid_unix_s is None and word in read.untimed


def test_gps_time_is_18_s_ahead():
    read = read_times({**UTC, "TIMESYS": "GPS"}, {"DATE-OBS": "GPS time"})
    assert read.mid_unix_s - START_S == pytest.approx(2 - 18, abs=1e-5)


@pytest.mark.parametrize(
    ("cards", "comment", "exposure_s"),
    [
        ({"EXPTIME": 500}, "[ms] exposure", 0.5),
        ({"EXPTIME": 500, "TIMEUNIT": "ms"}, "", 0.5),
        ({"EXPTIME": 0.5, "TIMEUNIT": "ms"}, "[s]", 0.5),
        ({"EXPTIME": 2}, "[min] exposure", 120),
        ({"EXPTIME": 2}, "exposure [total]", 2),
    ],
)
def test_a_length_is_in_the_unit_that_the_header_states(cards, comment, exposure_s):
    assert read_times({**START, **cards}, {"EXPTIME": comment}).exposure_s == pytest.approx(exposure_s)


@pytest.mark.parametrize(
    "cards",
    [
        *({key: 10} for key in ("COADDS", "NCOADD", "NFRAMES", "NSTACK", "LIGH_CNT", "LUM_CNT", "NSUBEXP")),
        {"IMCMB001": "a.fits", "IMCMB002": "b.fits"},
        {"IMAGETYP": "Master Light"},
        {"IMAGETYP": "masterLight"},
        {"IMAGETYP": "stacked"},
    ],
)
def test_a_sum_of_exposures_has_no_time(cards):
    assert "stack" in read_times({**UTC, **cards}).untimed


@pytest.mark.parametrize(
    ("written", "days"),
    [
        # a clock that went back, GPS weeks that rolled over, day and month exchanged, a local date across a zone
        ({"DATE": "2026-11-01T10:00:00"}, 1.3),
        ({"DATE": "2007-03-19T18:00:10"}, 7168),
        ({"DATE": "2026-02-11T18:00:10.5"}, 264),
        ({"DATE": "2026-11-01T20:00:00"}, None),
        ({"DATE": "2026-10-01"}, None),
        ({"DATE": "2031-01-01T00:00:00"}, None),
        ({"DATE": "unknown"}, None),
    ],
)
def test_a_file_is_not_written_days_before_its_exposure(written, days):
    read = read_times({**UTC, **written})
    assert (read.mid_unix_s is None) == (days is not None)
    assert days is None or f"written (DATE) {days:.1f} days before" in read.untimed
