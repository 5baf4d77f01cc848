# SPDX-License-Identifier: Apache-2.0
import os
import warnings

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument.inclinometer import SCA100T_NOISE_RAD, InclinometerErrors, Tilt
from starpos.instrument.tilt_log import NoiseTracker, TiltLog
from starpos.instrument.tilt_table import read_tilt_csv

DEG = np.pi / 180
NO_ERROR = np.zeros((2, 2))


def log(theta_x_deg, rate_hz=10.0, start=1000.0, **more):
    """A TiltLog of these x readings, y the negative of them."""
    theta = np.asarray(theta_x_deg, float) * DEG
    t = start + np.arange(len(theta)) / rate_hz
    return TiltLog.of(t, theta, -theta, np.full(len(theta), 15.0), **more)


def test_average_over_an_exposure(rng):
    noise = rng.normal(0, SCA100T_NOISE_RAD, 100)
    reading = log(3 + noise / DEG)
    tilt = reading.average(1005.0, 2.0)
    assert tilt.samples == 21
    assert tilt.theta_x == pytest.approx(np.mean(reading.theta_x[40:61]), abs=1e-15)
    assert tilt.theta_y == pytest.approx(-tilt.theta_x)
    np.testing.assert_allclose(tilt.covariance, np.eye(2) * SCA100T_NOISE_RAD**2 / 21)
    assert tilt.utc_unix_s == pytest.approx(1005.0)
    assert tilt.temperature_c == 15.0


def test_averages_err_as_their_covariance_says(rng):
    pulls = []
    for _ in range(300):
        tilt = log(3 + rng.normal(0, SCA100T_NOISE_RAD, 12) / DEG).average(1000.55, 1.2)
        pulls.append((tilt.theta_x - 3 * DEG) / np.sqrt(tilt.covariance[0, 0]))
    assert 0.85 < np.std(pulls) < 1.15


def test_a_mount_that_shakes_widens_the_covariance(rng):
    shaken = rng.normal(0, 2.2 * SCA100T_NOISE_RAD, 60)
    shaken = np.clip(shaken, -5 * SCA100T_NOISE_RAD, 5 * SCA100T_NOISE_RAD)
    tilt = log(3 + shaken / DEG).average(1002.95, 6.0)
    assert tilt.samples == 60
    assert np.diag(tilt.covariance) == pytest.approx(np.var(shaken, ddof=1) / 60 * np.ones(2), rel=0.4)


@pytest.mark.parametrize("factor", [1.0, 2.0, 3.0, 4.0])
def test_more_noise_than_stated_is_paid_for(factor, rng):
    """A night of exposures of five readings with unstated noise."""
    mids = 1000.0 + 10.0 * np.arange(200)
    t = (mids[:, None] + 0.1 * np.arange(-2, 3)).ravel()
    x, y = 3 * DEG + rng.normal(0, factor * SCA100T_NOISE_RAD, (2, len(t)))
    night = TiltLog.of(t, x, y, np.full(len(t), 15.0))
    tilts = [night.average(mid, 0.5) for mid in mids]
    pulls = [(tilt.theta_x - 3 * DEG) / np.sqrt(tilt.covariance[0, 0]) for tilt in tilts]
    assert 0.75 < np.std(pulls) < 1.2


def test_a_reading_given_twice_counts_once():
    once = log([1.0, 1.001, 0.999])
    twice = TiltLog.of(
        *(np.repeat(c, 7) for c in (once.utc_unix_s, once.theta_x, once.theta_y, once.temperature_c))
    )
    a, b = (reading.average(1000.1, 0.5) for reading in (once, twice))
    assert (a.samples, a.theta_x, a.times) == (b.samples, b.theta_x, b.times)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_each_axis_keeps_its_stated_error_and_their_correlation():
    stated = np.array([[1e-6, 9e-7], [9e-7, 1e-6]])
    t = 1000 + 0.1 * np.arange(5)
    zeros = np.zeros(5)
    tilt = TiltLog(t, zeros, zeros, temperature_c=zeros, covariance=np.tile(stated, (5, 1, 1)))
    tilt = tilt.average(1000.2, 0.5)
    np.testing.assert_allclose(tilt.covariance, stated / 5)


def test_a_wild_reading_does_not_move_the_average():
    calm = np.full(11, 2.0)
    wild = calm.copy()
    wild[4] = 25.0
    tilt = log(wild).average(1000.5, 1.0)
    assert tilt.samples == 10
    assert tilt.theta_x == pytest.approx(2 * DEG, abs=1e-12)


def test_readings_that_are_no_numbers_are_left_out():
    broken = log([1.0, np.nan, 1.0, 1.0, np.inf])
    assert broken.average(1000.2, 1.0).samples == 3


@pytest.mark.parametrize(("celsius", "mean"), [([np.nan, 14.0, np.nan, 16.0], 15.0), ([np.nan] * 4, np.nan)])
def test_readings_without_a_temperature_leave_that_of_the_others(celsius, mean):
    t = 1000 + np.arange(4) / 10
    tilt = TiltLog.of(t, np.zeros(4), np.zeros(4), np.array(celsius)).average(1000.15, 0.4)
    assert tilt.samples == 4 and tilt.temperature_c == pytest.approx(mean, nan_ok=True)


@pytest.mark.parametrize("mid", [1000.05, 1000.55, 1000.951])
def test_a_short_exposure_takes_the_two_readings_that_bracket_it(mid):
    reading = log(np.linspace(0, 0.01, 11))
    tilt = reading.average(mid, 0.01)
    assert tilt.samples == 2
    assert tilt.theta_x == pytest.approx(np.interp(mid, reading.utc_unix_s, reading.theta_x), abs=0.001 * DEG)


@pytest.mark.parametrize("mid", [999.9, 999.2, 1001.1, 1001.9])
def test_readings_before_or_after_an_exposure_do_not_stand_in_for_it(mid):
    """The instrument may have turned meanwhile: 36 of 36 such fixes were wrong, by 135 to 493 km."""
    with pytest.raises(TiltError, match="no tilt reading in the exposure"):
        log(np.zeros(11)).average(mid, 0.01)


def test_two_readings_that_differ_do_not_bracket_an_exposure():
    turned = np.concatenate([np.zeros(5), np.full(5, 1.0)])
    assert log(turned).average(1000.35, 0.01).theta_x == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(TiltError, match="differs before and after"):
        log(turned).average(1000.45, 0.01)


def test_two_readings_far_apart_do_not_bracket_an_exposure():
    sparse = TiltLog.of(np.array([1000.0, 1001.6]), np.zeros(2), np.zeros(2), np.zeros(2))
    with pytest.raises(TiltError, match="no tilt reading in the exposure"):
        sparse.average(1000.8, 0.01)


def lost(keep, length=101):
    """Readings at 10 Hz from 1000 s on, of which the indices `keep` have come."""
    t = 1000 + 0.1 * np.arange(length)
    t = t[keep(t)]
    return TiltLog.of(t, np.zeros(len(t)), np.zeros(len(t)), np.zeros(len(t)))


def test_an_exposure_of_which_most_readings_are_lost_has_no_tilt():
    assert lost(lambda t: (t < 1003) | (t > 1004)).average(1005, 10.0).samples > 80
    with pytest.raises(TiltError, match=r"uncovered: readings were lost"):
        lost(lambda t: t < 1003).average(1005, 10.0)
    with pytest.raises(TiltError, match=r"uncovered: readings were lost"):
        lost(lambda t: (t < 1001) | (t > 1008.5)).average(1005, 10.0)


def test_one_reading_in_the_exposure_is_enough_where_more_are_not_usual():
    """A sensor that reads once a second, and one that is read once an exposure."""
    t = 1000.0 + np.arange(10)
    slow = TiltLog.of(t, np.zeros(10), np.zeros(10), np.zeros(10))
    for mid in np.arange(1003, 1004, 0.07):
        assert slow.average(mid, 0.5).samples in (1, 2)
    once = TiltLog.of(1000.0 + 60 * np.arange(5), np.zeros(5), np.zeros(5), np.zeros(5))
    assert once.average(1060.0, 0.5).samples == 1


@pytest.mark.parametrize("mid", [1004.249, 1004.751])
def test_a_turn_beside_the_only_reading_of_an_exposure_gives_no_tilt(mid):
    """A sensor that reads once a second: 111 km off with 402 m claimed."""
    t = 1000.0 + np.arange(10)
    turned = 5.0 * (t > 1004.5) * DEG
    assert TiltLog.of(t, np.zeros(10), np.zeros(10), np.zeros(10)).average(mid, 0.5).samples == 1
    with pytest.raises(TiltError, match=r"0\.50 s of the exposure of 0\.5 s uncovered"):
        TiltLog.of(t, turned, np.zeros(10), np.zeros(10)).average(mid, 0.5)


def test_no_readings_at_all_hide_a_turn_as_the_exposure_begins(rng):
    """Many rates, many losses, a reading at the very edge, and a log that ends anywhere: the new lean, or none."""
    told = 0
    for _ in range(2000):
        period_s, exposure_s = rng.choice([0.1, 0.1, 0.5, 1.0]), rng.choice([0.2, 0.5, 1.0])
        t = np.arange(-4, 5, period_s) + rng.uniform(0, period_s)
        t = t[rng.random(len(t)) < rng.choice([max(0.2, period_s), 0.9, 1.0])]
        turn_s = rng.uniform(-1.0, 0.01)
        if rng.random() < 0.5:
            turn_s = rng.uniform(-0.05, 0.01)
            t = np.append(t, turn_s)
        if rng.random() < 0.3:
            t = t[(t <= turn_s) | (t > exposure_s - 0.02)]
        t = np.sort(t)[: rng.integers(1, 2 * len(t) + 2)]
        noise = rng.normal(0, SCA100T_NOISE_RAD, (2, len(t)))
        log = TiltLog.of(
            t, np.where(t <= turn_s, 0.0, 0.05) + noise[0], noise[1], np.full(len(t), 8.0), SCA100T_NOISE_RAD
        )
        try:
            tilt = log.average(exposure_s / 2, exposure_s)
        except TiltError:
            continue
        told += 1
        assert tilt.theta_x == pytest.approx(0.05, abs=6 * SCA100T_NOISE_RAD)
    assert told > 500


@pytest.mark.parametrize("mid", [990.0, 1020.0, float("nan"), float("inf")])
def test_no_reading_near_the_exposure(mid):
    with pytest.raises(TiltError, match="no tilt reading in the exposure"):
        log(np.zeros(10)).average(mid, 0.5)


@pytest.mark.parametrize("row", ["{},nan,nan,15", "{},1.5,nan,15", "nan,1.5,2.5,{}"])
def test_a_table_without_a_number_is_refused_when_it_is_read(row, tmp_path):
    path = tmp_path / "tilt.csv"
    rows = "\n".join(row.format(10 + k) for k in range(7))
    path.write_text(f"utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n{rows}\n")
    with pytest.raises(
        TiltError, match=r"tilt\.csv: none of its 7 readings is a number: check the inclinometer"
    ):
        read_tilt_csv(path)


def test_nothing_but_nan_and_nothing_at_all():
    for empty in (log([np.nan] * 5), log([])):
        with pytest.raises(TiltError, match="no tilt reading"):
            empty.average(1000.2, 0.5)


def test_an_instrument_that_moves_during_the_exposure():
    with pytest.raises(TiltError, match="not at rest"):
        log(np.linspace(0, 5, 11)).average(1000.5, 1.0)


@pytest.mark.parametrize("late", [2, 3, 5, 7, 8])
@pytest.mark.parametrize("step_deg", [0.06, 1.0])
def test_a_turn_before_or_after_the_middle_of_the_exposure_is_no_wild_reading(rng, late, step_deg):
    """However few readings are of the other lean, if two are that follow each other."""
    readings = log(1 + step_deg * (np.arange(10) >= 10 - late) + rng.normal(0, 0.0035, 10))
    with pytest.raises(TiltError, match="not at rest"):
        readings.average(1000.45, 0.98)


def test_noise_beyond_the_stated_and_angles_that_cannot_be_are_named_as_such(rng):
    noisy = log(3 + rng.normal(0, 1, 60))
    with pytest.raises(
        TiltError, match=r"not at rest, or its inclinometer has more noise than the 0.0035 deg"
    ):
        noisy.average(1003.0, 2.0)
    for middle in (170.0, 60.0):
        with pytest.raises(TiltError, match="cannot hold together: check the inclinometer and its units"):
            log(middle + rng.normal(0, 1, 60)).average(1003.0, 2.0)


def froze(rng, step_deg, readings, noise_deg=SCA100T_NOISE_RAD / DEG):
    """A log of 60 readings in steps, of which some from the 30th on are equal."""
    x, y = np.round(rng.normal(0, noise_deg, (2, 60)) / step_deg) * step_deg * DEG
    x[30 : 30 + readings], y[30 : 30 + readings] = x[30], y[30]
    return TiltLog.of(1000 + 0.1 * np.arange(60), x, y, np.full(60, 15.0))


@pytest.mark.parametrize("step_deg", [1e-6, 0.0005, 0.001])
def test_a_sensor_that_is_stuck_for_a_while_is_refused_meanwhile(rng, step_deg):
    errors, log = InclinometerErrors(), froze(rng, step_deg, 12)
    for mid in (1003.5, 1003.0, 1004.3):
        with pytest.raises(TiltError, match="repeats the same value"):
            errors.check_live(log.average(mid, 0.5))
    for mid in (1002.0, 1005.0):
        tilt = log.average(mid, 0.5)
        errors.check_live(tilt)
        assert tilt.samples == 5
    errors.check_live(froze(rng, step_deg, 9).average(1003.5, 0.5))


def test_a_coarse_table_of_many_poses_is_not_stuck(rng):
    InclinometerErrors().check_live(froze(rng, 0.01, 12).average(1003.5, 0.5))
    poses = np.repeat(rng.uniform(-20, 20, 40), 20)
    read = np.round((poses + rng.normal(0, 0.0035, 800)) / 0.01) * 0.01
    InclinometerErrors().check_live(log(read).average(1003.0, 0.5))


def test_csv(tmp_path):
    path = tmp_path / "tilt.csv"
    path.write_text(
        "utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n12.5,1,-2,20.5\n10.5,0.5,nan,20\nnan,1,1,20\n"
    )
    read = read_tilt_csv(path)
    # Sorted, and only those with a time.
    assert read.utc_unix_s.tolist() == [10.5, 12.5]
    assert read.theta_x / DEG == pytest.approx([0.5, 1])
    assert read.theta_y[1] / DEG == pytest.approx(-2)
    assert read.temperature_c.tolist() == [20, 20.5]


@pytest.mark.parametrize(
    "text",
    ["theta_y_deg,utc_unix_s,theta_x_deg\n-2,10,1\n", "# utc_unix_s, theta_x_deg, theta_y_deg\n10, 1, -2\n"],
)
def test_csv_in_any_order_without_temperature(tmp_path, text):
    path = tmp_path / "tilt.csv"
    path.write_text(text)
    tilt = read_tilt_csv(path).average(10.0, 0.1)
    assert (tilt.theta_x, tilt.theta_y) == pytest.approx((DEG, -2 * DEG))
    assert np.isnan(tilt.temperature_c)


def test_a_third_axis_and_the_error_of_each_row(tmp_path):
    path = tmp_path / "tilt.csv"
    path.write_text(
        "utc_unix_s,theta_x_deg,theta_y_deg,theta_z_deg,sigma_deg\n10,-30,324.7356,-35.2644,0.05\n20,30,0,120,nan\n"
    )
    read = read_tilt_csv(path)
    one, other = read.average(10.0, 0.1), read.average(20.0, 0.1)
    assert one.theta / DEG == pytest.approx([-30, -35.2644, -35.2644])
    assert np.sqrt(np.diag(one.noise)) / DEG == pytest.approx([0.05] * 3)
    # of three axes an angle over the zenith is the elevation of its supplement
    assert other.theta / DEG == pytest.approx([30, 0, 60])
    assert np.sqrt(np.diag(other.noise)) == pytest.approx([SCA100T_NOISE_RAD] * 3)


@pytest.mark.parametrize("name", ["utc_unix_s", "theta_x_deg", "theta_z_deg", "temperature_c"])
@pytest.mark.parametrize("wild", ["inf", "-inf"])
def test_what_is_infinite_in_a_table_warns_nobody(tmp_path, name, wild):
    path = tmp_path / "tilt.csv"
    names = ["utc_unix_s", "theta_x_deg", "theta_y_deg", "theta_z_deg", "temperature_c"]
    rows = [[str(v) for v in (1000 + 0.1 * k, 1, 2, 87.7635, 15)] for k in range(30)]
    for row in rows[12:14]:
        row[names.index(name)] = wild
    path.write_text("\n".join(",".join(row) for row in [names, *rows]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tilt = read_tilt_csv(path).average(1001.2, 1.0)
    assert tilt.theta_x == pytest.approx(DEG) and tilt.samples >= 8


@pytest.mark.parametrize("sigma", ["0", "-0.01", "inf", "90"])
def test_an_error_that_cannot_be_is_refused_in_a_sentence(tmp_path, sigma):
    path = tmp_path / "tilt.csv"
    path.write_text(f"utc_unix_s,theta_x_deg,theta_y_deg,sigma_deg\n10,1,2,{sigma}\n")
    with pytest.raises(TiltError, match=r"tilt.csv:2: sigma_deg is .*from .* to 45"):
        read_tilt_csv(path)


def three(theta_z_deg, t=None, theta_deg=(40.0, 30.0)):
    """Readings of a three-axis sensor whose first two axes do not change."""
    z = np.asarray(theta_z_deg, float) * DEG
    t = 1000 + 0.1 * np.arange(len(z)) if t is None else t
    x, y = (np.full(len(z), angle * DEG) for angle in theta_deg)
    return TiltLog.of(t, x, y, np.full(len(z), 15.0), theta_z=z)


THIRD_DEG = np.degrees(np.arcsin(np.sqrt(1 - np.sin(40 * DEG) ** 2 - np.sin(30 * DEG) ** 2)))


def test_the_third_axis_is_averaged_with_an_error_of_its_own(rng):
    shaken = rng.normal(0, 3 * SCA100T_NOISE_RAD, 60) / DEG
    tilt = three(THIRD_DEG + np.clip(shaken, -0.03, 0.03)).average(1002.95, 6.0)
    assert (tilt.axes, tilt.samples) == (3, 60)
    assert tilt.theta_z / DEG == pytest.approx(THIRD_DEG, abs=0.01)
    assert np.sqrt(tilt.variance_z * 60) == pytest.approx(3 * SCA100T_NOISE_RAD, rel=0.4)


def test_a_turn_that_only_the_third_axis_shows_is_seen():
    below = np.concatenate([np.full(5, THIRD_DEG), np.full(5, -THIRD_DEG)])
    with pytest.raises(TiltError, match="not at rest"):
        three(below).average(1000.45, 1.0)
    with pytest.raises(TiltError, match="differs before and after"):
        three(below).average(1000.45, 0.01)
    wild = np.full(11, THIRD_DEG)
    wild[4] = -THIRD_DEG
    assert three(wild).average(1000.5, 1.0).samples == 10


def test_readings_of_two_and_of_three_axes_are_not_mixed():
    tilts = [Tilt(0.1, 0.2, np.eye(2) * 1e-10, utc_unix_s=1000.0 + k) for k in range(3)]
    deep = Tilt(0.1, 0.2, np.eye(2) * 1e-10, theta_z=-np.arcsin(np.sqrt(1 - np.sin(0.1) ** 2 - np.sin(0.2) ** 2)),
                variance_z=4e-10, utc_unix_s=1000.4)  # fmt: skip
    with pytest.raises(TiltError, match="two axes and some three"):
        TiltLog.of_readings([*tilts, deep]).mean()
    mean = TiltLog.of_readings([deep, deep]).mean()
    assert (mean.theta_z, mean.variance_z) == pytest.approx((deep.theta_z, 2e-10))


def test_an_empty_cell_is_an_unknown_value(tmp_path):
    path = tmp_path / "tilt.csv"
    path.write_text(
        "utc_unix_s,theta_x_deg,theta_y_deg,temperature_c,sigma_deg\n10,1,2,,0.05\n10.1,1,,20, \r\n10.2,1,2,20,\n"
    )
    read = read_tilt_csv(path, noise_rad=0.01 * DEG)
    np.testing.assert_array_equal(np.isnan(read.temperature_c), [True, False, False])
    np.testing.assert_array_equal(np.isnan(read.theta[:, 1]), [False, True, False])
    np.testing.assert_allclose(np.sqrt(read.variance[:, 0]) / DEG, [0.05, 0.01, 0.01])


@pytest.mark.parametrize("name", ["temperature", "Temperature_degC", "sigma_degs", "theta_z"])
def test_a_column_that_is_almost_called_like_one_that_is_read_is_refused(tmp_path, name):
    path = tmp_path / "tilt.csv"
    path.write_text(f"utc_unix_s,theta_x_deg,theta_y_deg,{name}\n10,1,2,3\n")
    with pytest.raises(TiltError, match=f"its column {name.lower()} is not read: call it"):
        read_tilt_csv(path)
    path.write_text("utc_unix_s,theta_x_deg,theta_y_deg,battery_v\n10,1,2,3\n")
    assert len(read_tilt_csv(path).theta) == 1


HOSTILE = {
    "empty": b"",
    "header only": b"utc_unix_s,theta_x_deg,theta_y_deg\n",
    "no header": b"1,2,3\n4,5,6\n",
    "binary": bytes(range(256)) * 8,
    "ragged": b"utc_unix_s,theta_x_deg,theta_y_deg\n1,2\n1,2,3,4\n",
    "words": b"utc_unix_s,theta_x_deg,theta_y_deg\none,two,three\n",
    "half a row": b"utc_unix_s,theta_x_deg,theta_y_deg\n1,2,3\n2,3",
    "no commas": b"utc_unix_s theta_x_deg theta_y_deg\n1 2 3\n",
    "nul": b"utc_unix_s,theta_x_deg,theta_y_deg\n1,2,\x00\n",
    "a column twice": b"utc_unix_s,theta_x_deg,theta_y_deg,theta_x_deg\n1,2,3,4\n",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_csv_gives_one_sentence_that_names_the_file(tmp_path, kind):
    path = tmp_path / "tilt.csv"
    path.write_bytes(HOSTILE[kind])
    with warnings.catch_warnings(), pytest.raises(TiltError) as e:
        # A warning would reach the user's screen.
        warnings.simplefilter("error")
        read_tilt_csv(path).average(1.0, 1.0)
    assert "\n" not in str(e.value)
    assert str(path) in str(e.value) or "tilt reading" in str(e.value)


def test_missing_csv_and_folder(tmp_path):
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(TiltError, match=r"no such file|not a readable table"):
            read_tilt_csv(path)


def test_a_pipe_is_no_table_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "tilt.csv")
    for path in (tmp_path / "tilt.csv", "/dev/zero"):
        with pytest.raises(TiltError, match=r"no regular file.*give a CSV"):
            read_tilt_csv(path)


def test_a_temperature_that_no_sensor_has_is_unknown(tmp_path):
    path = tmp_path / "tilt.csv"
    path.write_text("utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n1,1,1,20\n2,1,1,1e9\n3,1,1,-inf\n")
    np.testing.assert_array_equal(read_tilt_csv(path).temperature_c, [20, np.nan, np.nan])


def test_a_clock_that_counts_whole_seconds_takes_what_agrees_around_it():
    """A camera's EXIF: the readings of the exposure lie up to half a second from where its stamp says."""
    reading = log(np.zeros(5))
    with pytest.raises(TiltError, match="no tilt reading in the exposure"):
        reading.average(1000.75, 0.5)
    assert reading.average(1000.75, 0.5, spread_s=1.0).samples == 5
    with pytest.raises(TiltError, match="not at rest"):
        log(np.repeat([0.0, 5.0], 5)).average(999.6, 0.5, spread_s=1.5)
    with pytest.raises(TiltError, match="no tilt reading in the exposure"):
        reading.average(1002.0, 0.5, spread_s=1.0)


def published(often, readings, step_rad, rng):
    """A log of readings of both axes, each published several times at 100 Hz."""
    x, y = np.array([[3], [-5]]) * DEG + rng.normal(0, SCA100T_NOISE_RAD, (2, readings))
    x, y = (np.repeat(step_rad * np.round(axis / step_rad), often) for axis in (x, y))
    return TiltLog.of(1000 + np.arange(len(x)) / 100, x, y, np.full(len(x), 15.0))


@pytest.mark.parametrize("often", [2, 3, 9, 20])
def test_what_is_published_several_times_counts_once(often, rng):
    log = published(often, 200, 1e-7, rng)
    tilt = log.average(1000 + often, often)
    assert tilt.samples == pytest.approx(100, abs=2)
    claimed = np.diag(tilt.covariance) / (SCA100T_NOISE_RAD**2 / 100)
    assert (claimed > 0.9).all()
    assert (claimed < 1.8).all()
    assert tilt.step_rad == 0


@pytest.mark.parametrize("steps", [0.5, 1.0, 2.0])
def test_steps_that_repeat_by_chance_count_each(steps, rng):
    log = published(1, 2000, steps * SCA100T_NOISE_RAD, rng)
    assert (np.diff(log.theta, axis=0) == 0).all(1).any() or steps < 1
    assert log.average(1010, 10).samples == pytest.approx(1000, abs=2)


def test_a_sensor_that_freezes_is_stuck_however_often_each_reading_is_published(rng):
    log = published(3, 400, 1e-7, rng)
    frozen = np.arange(len(log.theta_x)) > 600
    x, y = (np.where(frozen, axis[600], axis) for axis in (log.theta_x, log.theta_y))
    log = TiltLog.of(log.utc_unix_s, x, y, log.temperature_c)
    with pytest.raises(TiltError, match="repeats the same value"):
        InclinometerErrors().check_live(log.average(1010, 2))
    assert log.average(1003, 2).samples == pytest.approx(67, abs=2)


def test_a_driver_measures_the_noise_of_readings_that_are_published_several_times(rng):
    for often, rate_hz in ((1, 100), (5, 100), (5, 10), (20, 10)):
        tracker = NoiseTracker()
        x, y = rng.normal(0, SCA100T_NOISE_RAD, (2, 800)).repeat(often, 1)
        for k, angles in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
            tracker.add_sample(k / rate_hz, *angles)
        np.testing.assert_allclose(tracker.sigma, SCA100T_NOISE_RAD, rtol=0.3)
