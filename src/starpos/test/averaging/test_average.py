# SPDX-License-Identifier: Apache-2.0
import pickle
from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.average import MAX_REMEMBERED, Averager, average
from starpos.averaging.filter import UNIT, PlaceFilter, Plane
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import earth_state
from starpos.errors import FixError
from starpos.fix.terms import ALWAYS, ErrorTerm, correlation, total_covariance
from starpos.instrument.inclinometer import Tilt
from starpos.units import ARCSEC
from starpos_testing.skies.fields import UTC, SkyField, random_field

STATE = earth_state(UTC)


def fixes(field, rng, headings, tilt=12.6, calibration=0.0, slip=None):
    """Fixes at these azimuths: tilt noise in arcsec new in each, one slip of the mount (arcsec about S's axes) in all."""
    slip = rotation.from_vector(
        rng.normal(0, calibration * ARCSEC, 3) if slip is None else np.array(slip) * ARCSEC
    )
    made = []
    for azimuth in headings:
        here = replace(field, azimuth=azimuth)
        up = slip @ here.a3 @ here.attitude[2]
        reading = np.arcsin(up[:2]) + rng.normal(0, tilt * ARCSEC, 2)
        xy, places = here.places(STATE, rng)
        made.append(here.solve(
            xy + rng.normal(0, 0.05, xy.shape), places, STATE,
            tilt=Tilt(*reading, np.eye(2) * (tilt * ARCSEC) ** 2, utc_unix_s=UTC),
            instrument=here.instrument(calibration),
        ))  # fmt: skip
    return made


def in_order(made, apart_s=10.0):
    """Fixes given one after the other."""
    return [replace(f, utc_unix_s=UTC + apart_s * k) for k, f in enumerate(made)]


def read_at(f, *times):
    """A fix whose tilt is of these readings."""
    return replace(f, terms=tuple(replace(t, shared=times) if t.name == "tilt" else t for t in f.terms))


def moved_m(a, field):
    """East, north in m: found minus true."""
    prime, meridian = curvature_radii_m(np.radians(field.latitude))
    east = (
        rotation.half_turn(a.longitude - np.radians(field.longitude))
        * prime
        * np.cos(np.radians(field.latitude))
    )
    return np.array([east, (a.latitude - np.radians(field.latitude)) * meridian])


def sigmas_off(a, field):
    """How far the place is from the true one."""
    off = moved_m(a, field)
    return float(np.sqrt(off @ np.linalg.solve(a.covariance[:2, :2], off)))


def sigmas(a, name=None):
    return np.sqrt(np.diag(sum(t.covariance for t in a.terms if name in (None, t.name)))[:3])


def test_one_fix_is_its_own_average(rng):
    (only,) = fixes(SkyField(), rng, [40.0])
    a = average([only])
    assert (a.latitude, a.longitude, a.heading, a.utc_unix_s) == pytest.approx(
        (only.latitude, only.longitude, only.heading, UTC), abs=1e-15
    )
    np.testing.assert_allclose(a.covariance, only.covariance, rtol=1e-6, atol=1e-16)
    assert a.frames == 1


def test_noise_averages_and_what_is_common_stays(rng):
    made = fixes(SkyField(), rng, [40.0] * 16, calibration=20.0)
    a = average(made)
    assert sigmas(a, "tilt") == pytest.approx(sigmas(made[0], "tilt") / 4, rel=0.02)
    each = np.array([sigmas(f, "centroids") for f in made])
    # the small terms pay where that lowers the large one
    assert np.all(sigmas(a, "centroids") < 2.5 * np.sqrt(np.mean(each**2, 0)) / 4)
    assert sigmas(a, "calibration") == pytest.approx(sigmas(made[0], "calibration"), rel=0.02)


def test_half_a_turn_takes_the_calibration_off_the_position(rng):
    """Level: a slip of the mount moves the fix with the instrument, so that opposite headings cancel it."""
    field = SkyField(altitude=89.0)
    a = average(
        fixes(field, rng, [10.0, 100.0, 190.0, 280.0], tilt=0.1, calibration=60.0, slip=(50.0, -30.0, 0.0))
    )
    # A single one is 1.5 km off.
    assert np.all(np.abs(moved_m(a, field)) < 60)
    assert np.all(sigmas(a, "calibration")[:2] < 60)


@pytest.mark.montecarlo
@pytest.mark.parametrize("calibration", [0.0, 15.0])
def test_an_average_errs_as_its_covariance_says(calibration, rng):
    position, heading = [], []
    for _ in range(30):
        field = random_field(rng, altitude=85.0, latitude=rng.uniform(-70, 70), stars=15)
        a = average(fixes(field, rng, [field.azimuth] * 4, calibration=calibration))
        m = moved_m(a, field)
        position.append(m @ np.linalg.solve(a.covariance[:2, :2], m))
        heading.append(rotation.half_turn(a.heading - field.heading) ** 2 / a.covariance[2, 2])
    assert np.mean(position) / 2 == pytest.approx(1, abs=4 / np.sqrt(30))
    assert np.mean(heading) == pytest.approx(1, abs=4 * np.sqrt(2 / 30))


def test_an_instrument_that_turned_has_the_heading_of_its_last_pose(rng):
    made = fixes(SkyField(), rng, [10.0, 10.0, 12.0, 12.0])
    a, last = average(made), average(made[2:])
    assert a.poses == 2
    assert rotation.half_turn(a.heading - last.heading) == pytest.approx(0, abs=3 * sigmas(last)[2])
    # What is known of the place helps it.
    assert 0.5 * sigmas(last)[2] < sigmas(a)[2] < sigmas(last)[2]


def test_over_the_date_line_and_over_north(rng):
    field = replace(SkyField(), longitude=180.0, azimuth=0.0, altitude=75.0, roll=180.0)
    a = average(fixes(field, rng, [0.0] * 8))
    assert np.all(np.abs(moved_m(a, field)) < 4 * sigmas(a)[:2])
    assert -np.pi <= a.longitude < np.pi
    assert abs(rotation.half_turn(a.heading)) < 5 * sigmas(a)[2]
    assert 0 <= a.heading < 2 * np.pi


def test_a_better_frame_counts_more(rng):
    field = SkyField()
    poor, good = fixes(field, rng, [40.0], tilt=100.0), fixes(field, rng, [40.0], tilt=1.0)
    a = average(poor + good)
    assert np.all(np.abs(moved_m(a, field) - moved_m(good[0], field)) < 10)
    assert sigmas(a, "tilt")[:2] == pytest.approx(sigmas(good[0], "tilt")[:2], rel=0.01)


def test_two_frames_of_two_places_have_no_average(rng):
    here, there = SkyField(), replace(SkyField(), latitude=SkyField().latitude + 0.5)
    with pytest.raises(FixError, match="the frames are of several places"):
        average(in_order(fixes(here, rng, [40.0]) + fixes(there, rng, [40.0])))


def test_no_fix_has_no_average():
    with pytest.raises(FixError, match="no fix to average"):
        average([])


def test_the_same_frame_given_twice_counts_once(rng):
    made = fixes(SkyField(), rng, [40.0] * 3)
    once, twice = average(made), average(made + made)
    assert twice.frames == once.frames == 3
    np.testing.assert_array_equal(once.covariance, twice.covariance)


def test_frames_that_share_a_tilt_reading_share_its_error(rng):
    """One reading served four frames: its noise does not average."""
    field = SkyField()
    made = in_order([read_at(f, UTC) for f in fixes(field, rng, [40.0], tilt=12.6) for _ in range(4)])
    assert sigmas(average(made), "tilt") == pytest.approx(sigmas(made[0], "tilt"), rel=1e-3)
    apart = [read_at(f, UTC + k) for k, f in enumerate(made)]
    assert sigmas(average(apart), "tilt") == pytest.approx(sigmas(made[0], "tilt") / 2, rel=1e-3)


@pytest.mark.parametrize("latitude", [89.9, 89.999, -90.0])
def test_near_a_pole_a_common_error_does_not_average_away(latitude, rng):
    field = replace(SkyField(), latitude=latitude)
    made = fixes(field, rng, [40.0] * 10, calibration=5.0)
    assert sigmas(average(made), "calibration")[:2] == pytest.approx(
        sigmas(made[0], "calibration")[:2], rel=0.05
    )


def test_a_thousand_frames(rng):
    made = fixes(SkyField(), rng, [40.0] * 2)
    many = [replace(made[k % 2], utc_unix_s=UTC + k) for k in range(1000)]
    assert sigmas(average(many), "tilt") == pytest.approx(sigmas(made[0], "tilt") / np.sqrt(1000), rel=0.02)


def dense(made):
    """Generalised least squares over all fixes at once: east, north, heading against the first, and their covariance."""
    plane, n = Plane.at(made[0]), len(made)
    seen = np.array([plane.coordinates(f) * UNIT for f in made])
    whole = np.zeros((n, 3, n, 3))
    for k, term in enumerate(made[0].terms):
        # They are of one pose.
        like = [made[0] if term.constant_within_pose else f for f in made]
        factors = [plane.turn(f) @ f.terms[k].factor[:3] * UNIT[:, None] for f in like]
        for i, f in enumerate(made):
            for j, g in enumerate(made):
                a, b = f.terms[k].shared, g.terms[k].shared
                alike = 1.0 if i == j else correlation(a or (), b or ())
                first = f.terms[k] if f.utc_unix_s < g.utc_unix_s else g.terms[k]
                since = min(f.utc_unix_s, g.utc_unix_s) - made[0].utc_unix_s
                start = made[0].terms[k].variance if a == ALWAYS else first.variance
                whole[i, :, j] += alike * (start + term.walk_s * since) * factors[i] @ factors[j].T
    unit = np.tile(UNIT, n)
    inverse = np.linalg.inv(whole.reshape(3 * n, 3 * n) / np.outer(unit, unit))
    design = np.tile(np.eye(3), (n, 1))
    covariance = np.linalg.inv(design.T @ inverse @ design)
    return covariance @ design.T @ inverse @ (seen / UNIT).ravel() * UNIT, covariance * np.outer(UNIT, UNIT)


def wandering(f, rad_per_s=3e-7):
    """A fix whose zero wanders, after an hour since its calibration."""
    (tilt,) = (t for t in f.terms if t.name == "calibration")
    walk = ErrorTerm("tilt drift", tilt.factor / 5e-5 * rad_per_s, shared=ALWAYS, variance=3600.0, walk_s=1.0)
    return replace(f, terms=tuple(walk if t.name == walk.name else t for t in f.terms))


@pytest.mark.parametrize("shared", ["nothing", "a reading", "one reading of three"])
def test_the_recursion_is_generalised_least_squares_over_all(shared, rng):
    field = replace(SkyField(), altitude=80.0)
    # Each reading serves three frames.
    if shared == "a reading":
        made = [f for f in fixes(field, rng, [40.0] * 3, calibration=10.0) for _ in range(3)]
        made = [read_at(spoiled(f, *rng.normal(0, 3, 2)), UTC + k // 3) for k, f in enumerate(made)]
    else:
        made = fixes(field, rng, [40.0] * 6, calibration=10.0)
    # Each reading serves two frames.
    if shared == "one reading of three":
        made = [read_at(f, *(UTC + 10 * (k // 2) + 2 * (k % 2) + np.arange(3))) for k, f in enumerate(made)]
    made = in_order([wandering(f) for f in made])
    moved, covariance = dense(made)
    recursion = PlaceFilter.before(made[0])
    for f in made:
        recursion, _ = recursion.updated(f, made[0])
    np.testing.assert_allclose(recursion.east_north_m, moved[:2], atol=1e-3)
    found = total_covariance(recursion.terms(made[-1].terms))
    np.testing.assert_allclose(found[:2, :2], covariance[:2, :2], rtol=1e-5)
    plane = Plane.at(made[0])
    latitude, longitude, heading = recursion.place
    expected = moved[2] + plane.heading - plane.convergence(latitude, longitude)
    assert rotation.half_turn(heading - expected) == pytest.approx(0, abs=1e-11)


def test_as_they_come_or_all_at_once(rng):
    made = in_order(fixes(SkyField(), rng, [40.0] * 5 + [90.0] * 5, calibration=10.0))
    averager = Averager()
    for f in made:
        averager.include(f)
    a, b = average(made[::-1]), averager.average
    # at once, the first frames too are judged by the scatter of all
    assert (a.frames, a.poses) == (b.frames, b.poses) == (10, 2)
    apart = np.array([a.latitude - b.latitude, a.longitude - b.longitude]) * 6.37e6
    assert np.all(np.abs(apart) < 0.3 * sigmas(b)[:2])
    np.testing.assert_allclose(sigmas(a)[:2], sigmas(b)[:2], rtol=0.4)


def test_frames_that_share_a_few_readings_are_believed_and_no_more_than_is_due(rng):
    """Every third frame has lost its own readings: its tilt comes from the readings around it."""
    field, off, n = SkyField(altitude=85.0), [], 15
    for _ in range(n):
        readings = rng.normal(0, 5 * ARCSEC, (30, 2))
        averager = Averager()
        for k in range(6):
            which = [5 * k - 1, 5 * k + 5] if k % 3 == 1 else list(range(5 * k, 5 * k + 5))
            now = replace(field, utc=UTC + k)
            tilt = now.tilt(np.eye(2) * (5 * ARCSEC) ** 2 / len(which))
            error = readings[which].mean(0)
            tilt = replace(
                tilt, theta_x=tilt.theta_x + error[0], theta_y=tilt.theta_y + error[1], times=tuple(which)
            )
            state = earth_state(now.utc)
            xy, places = now.places(state, rng)
            averager.include(now.solve(xy + rng.normal(0, 0.05, xy.shape), places, state, tilt=tilt))
        a = averager.average
        assert a.frames == 6
        off.append(sigmas_off(a, field) ** 2 / 2)
    assert np.mean(off) == pytest.approx(1, abs=4 / np.sqrt(n))


def spoiled(f, east_m=0.0, north_m=0.0):
    """A fix that is off by so much, of a camera that did not move."""
    prime, meridian = curvature_radii_m(f.latitude)
    return replace(
        f,
        latitude=f.latitude + north_m / meridian,
        longitude=f.longitude + east_m / prime / np.cos(f.latitude),
    )


def check_not_moved(spoiled_fixes, sound, field):
    """Check that the average of these equals the sound ones' average, within a fraction of its error."""
    a, b = average(in_order(spoiled_fixes)), average(in_order(sound))
    off = moved_m(a, field) - moved_m(b, field)
    assert np.all(np.abs(off) < 0.5 * sigmas(b)[:2])
    return a


@pytest.mark.parametrize("first", [0, 12, 24])
def test_a_burst_of_bad_tilts_does_not_move_it(first, rng):
    """Ten in a row that agree with each other, 11 km off, at the beginning, in the middle, at the end."""
    field = SkyField()
    made = fixes(field, rng, [40.0] * 25)
    bad = [spoiled(f, 8e3, -8e3) for f in fixes(field, rng, [40.0] * 10)]
    a = check_not_moved(made[:first] + bad + made[first:], made, field)
    assert (a.frames, a.left_out, a.moved) == (25, 10, 0)


def test_single_bad_tilts_do_not_move_it(rng):
    field = SkyField()
    made = fixes(field, rng, [40.0] * 25)
    mixed = [spoiled(f, *rng.normal(0, 3e4, 2)) if k % 6 == 0 else f for k, f in enumerate(made)]
    a = check_not_moved(mixed, [f for k, f in enumerate(made) if k % 6], field)
    assert a.frames == 20 and a.left_out == 5


def slipped(f, seconds):
    """A fix whose frame was stamped late: the Earth turns under the camera, and the place runs east to west."""
    angle = 7.292115e-5 * seconds
    return replace(
        f,
        longitude=f.longitude - angle,
        camera=replace(f.camera, rotation=rotation.about_axis(2, -angle) @ f.camera.rotation),
    )


@pytest.mark.montecarlo
@pytest.mark.parametrize(("seconds", "at"), [(1.0, 0), (-1.0, 7), (60.0, 24), (3600.0, 7)])
def test_a_wrong_time_stamp_does_not_move_it(seconds, at, rng):
    field = SkyField()
    made = fixes(field, rng, [40.0] * 25, tilt=1.0)
    mixed = [slipped(f, seconds) if k == at else f for k, f in enumerate(made)]
    a = check_not_moved(mixed, made[:at] + made[at + 1 :], field)
    assert a.left_out == 1 and a.frames == 24


def test_a_knocked_tripod_does_not_move_the_place(rng):
    """Its heading and tilt are others from then on; the frame of the knock itself is far off."""
    field = SkyField()
    before = fixes(field, rng, [40.0] * 12)
    after = fixes(replace(field, altitude=field.altitude - 0.7, roll=field.roll + 0.5), rng, [40.4] * 12)
    during = [spoiled(fixes(field, rng, [40.2])[0], 5e4, 2e4)]
    a = check_not_moved(before + during + after, before + after, field)
    assert (a.moved, a.left_out) == (0, 1)
    assert rotation.half_turn(a.heading - average(in_order(after)).heading) == pytest.approx(
        0, abs=3 * sigmas(a)[2]
    )


@pytest.mark.parametrize(("moved_to_m", "needs"), [(1e6, 3), (2e4, 3), (700.0, 25)])
def test_a_robot_that_drove_on_begins_a_new_average(moved_to_m, needs, rng):
    """A long way off after three frames; less than two errors of one frame after a few."""
    here = SkyField()
    there = replace(here, latitude=here.latitude - np.degrees(moved_to_m / 6.371e6), azimuth=90.0)
    averager = Averager()
    for f in in_order(fixes(here, rng, [40.0] * 30) + fixes(there, rng, [90.0] * needs)):
        averager.include(f)
    a = averager.average
    assert a.moved == 1 and a.frames <= needs
    assert np.all(np.abs(moved_m(a, there)) < 4 * sigmas(a)[:2])


def test_a_robot_on_shaking_ground_that_drives_on_is_noticed(rng):
    """Every frame in a pose of its own."""
    here, there = SkyField(), replace(SkyField(), latitude=SkyField().latitude - 0.1)
    made = fixes(here, rng, 40 + 0.1 * rng.normal(size=15)) + fixes(there, rng, 40 + 0.1 * rng.normal(size=6))
    a = average(in_order(made))
    assert a.moved == 1 and a.frames == 6
    assert np.all(np.abs(moved_m(a, there)) < 4 * sigmas(a)[:2])


def test_a_robot_that_turns_on_the_spot_has_not_moved(rng):
    field = SkyField()
    made = in_order(fixes(field, rng, np.repeat(np.arange(0.0, 720.0, 40.0), 4)))
    a = average(made)
    assert (a.frames, a.moved, a.left_out) == (72, 0, 0)
    assert np.all(np.abs(moved_m(a, field)) < 4 * sigmas(a)[:2])


def test_a_clock_that_was_far_off_bends_no_average(rng):
    """16 km along the parallel leave the tangent plane by 20 m: frames of the right clock begin anew."""
    field, averager, worst = SkyField(latitude=55.0), Averager(), 0.0
    for k in range(8):
        known = k >= 3
        # Touched, or the stamp has slipped.
        now = replace(field, utc=UTC + k, azimuth=150.0 if known else 40.0)
        xy, places = now.places(earth_state(now.utc), rng)
        tilt = replace(now.tilt(np.eye(2) * (0.16 * ARCSEC) ** 2), utc_unix_s=now.utc + 60 * (not known))
        state = earth_state(tilt.utc_unix_s)
        averager.include(now.solve(xy, places, state, tilt=tilt, clock_stddev_s=0.01 if known else 60.0))
        worst = max(worst, sigmas_off(averager.average, field))
    assert worst < 4 and averager.average.covariance[0, 0] < 10**2


def test_memory_does_not_grow(rng):
    averager, two = Averager(), fixes(SkyField(), rng, [40.0] * 2)
    sizes = []
    for k in range(3 * MAX_REMEMBERED):
        averager.include(read_at(replace(two[k % 2], utc_unix_s=UTC + k), UTC + k, UTC + k + 1))
        sizes.append(len(pickle.dumps(vars(averager))))
    # once as much is remembered as ever
    settled = MAX_REMEMBERED + 10
    # Counts have grown.
    assert max(sizes[settled:]) <= max(sizes[:settled]) + 8 * MAX_REMEMBERED


def test_the_heading_of_a_pose_that_nobody_believed_is_none(rng):
    """The camera was turned, and the tilts since are wrong: it does not face where it did."""
    field = SkyField()
    before = fixes(field, rng, [40.0] * 8)
    wrong = [spoiled(f, 5e4, 0.0) for f in fixes(field, rng, [160.0] * 2)]
    a = average(in_order(before + wrong))
    assert (a.poses, a.left_out) == (1, 2)
    assert np.isnan(a.heading) and np.isnan(a.covariance[2]).all()
    assert np.all(np.abs(moved_m(a, field)) < 4 * np.sqrt(np.diag(a.covariance)[:2]))
    right = average(in_order(before + wrong + fixes(field, rng, [160.0])))
    assert right.poses == 2 and rotation.half_turn(right.heading - field.heading) != 0


EAST_RAD_S = np.radians(15.041 / 3600)


@pytest.mark.parametrize(
    ("times_s", "west_s", "words"),
    [
        # a clock that stands, a picture that stands, places of their own
        ((0, 0, 0, 0), (0, 300, 600, 900), "have the same time"),
        ((0, 300, 600, 900), (0, 300, 600, 900), "same sky at different times"),
        ((0, 5, 10, 15), (0, 5, 10, 15), "same sky at different times"),
        ((0, 300, 600, 900), (0, -300, 250, 4000), "of several places"),
    ],
)
def test_a_clock_or_a_picture_that_stands_still_is_named(rng, times_s, west_s, words):
    one = fixes(SkyField(), rng, [40.0])[0]
    made = [
        replace(
            read_at(one, UTC + t, 1e3 * k),
            utc_unix_s=UTC + t,
            longitude=rotation.half_turn(one.longitude - EAST_RAD_S * w),
        )
        for k, (t, w) in enumerate(zip(times_s, west_s, strict=True))
    ]
    with pytest.raises(FixError, match=words):
        average(made)
