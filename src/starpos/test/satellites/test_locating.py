# SPDX-License-Identifier: Apache-2.0
"""A place from drawn trails: names, error against claim, clock, strangers, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.earth.gravity import itrs_place
from starpos.earth.place import Place
from starpos.errors import SatelliteError
from starpos.rotation import normalised
from starpos.satellites.adjustment import Adjuster, KnownBefore
from starpos.satellites.elements import chosen, read_orbits
from starpos.satellites.locating import locate
from starpos.satellites.sightings import read_sightings
from starpos.satellites.trails import turned
from starpos_testing.skies import sightings as skies

PLACE = 47.0, 8.0, 900.0
PRIOR = KnownBefore(900.0, 20.0, 0.002)
SEED = 5
# km/s in these orbits, 0.35 km along by the class of satellites without thrust
ALONG_S = 0.35 / 7.5


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    records, text = skies.drawn(900, 7)
    path = tmp_path_factory.mktemp("elements") / "active.tle"
    path.write_text(text)
    return records, path, chosen(read_orbits(path)[0], skies.NIGHT)[0]


def trails_of(tmp_path, records, **how):
    rng = np.random.default_rng(SEED)
    along = rng.normal(0, ALONG_S, len(records))
    text, numbers = skies.table(records, PLACE, rng, along_s=along, **how)
    (tmp_path / "sightings.csv").write_text(text)
    return read_sightings(tmp_path / "sightings.csv"), numbers, along


def off_m(fix):
    """East, north of the fix from the truth."""
    east = (np.degrees(fix.longitude) - PLACE[1]) * 111_320 * np.cos(np.radians(PLACE[0]))
    return np.array([east, (np.degrees(fix.latitude) - PLACE[0]) * 111_200])


def test_place_names_and_claim_of_a_night(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, along = trails_of(tmp_path, records, count=12)
    fix = locate(trails, orbits, PRIOR)
    assert [orbit.number for orbit in fix.named] == numbers
    off = off_m(fix)
    assert off @ np.linalg.solve(fix.covariance[:2, :2], off) < 12
    assert 40 < np.sqrt(fix.covariance[0, 0]) < 200
    assert fix.height_m == pytest.approx(900, abs=60)
    # along the motion is by how much it is before its elements
    true_km = np.array([along[n - 40001] for n in numbers]) * 7.5
    got = fix.adjustment.offset_m[fix.adjusted, 1] / 1e3
    assert np.corrcoef(got, true_km)[0, 1] > 0.8


def test_the_satellites_give_the_time(tmp_path, sky):
    records, _, orbits = sky
    trails, _, _ = trails_of(tmp_path, records, count=12, late_s=0.4)
    fix = locate(trails, orbits, PRIOR._replace(clock_stddev_s=0.5))
    assert fix.clock_s == pytest.approx(0.4, abs=4 * fix.clock_stddev_s)
    assert fix.clock_stddev_s < 0.1
    assert np.hypot(*off_m(fix)) < 500


def test_strangers_and_satellites_that_moved_are_not_used(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=12)
    gone = set(numbers[:3])
    fix = locate(trails, [orbit for orbit in orbits if orbit.number not in gone], PRIOR)
    assert [fix.named[k] for k in range(3)] == [None] * 3
    assert fix.satellites == 9
    # 20 s are 150 km
    late = np.zeros(len(records))
    late[numbers[0] - 40001] = 20.0
    text, moved = skies.table(records, PLACE, np.random.default_rng(1), count=12, along_s=late)
    (tmp_path / "moved.csv").write_text(text)
    fix = locate(read_sightings(tmp_path / "moved.csv"), orbits, PRIOR)
    k = moved.index(numbers[0])
    assert fix.named[k] is None or not fix.adjustment.used[fix.adjusted[k]]
    assert np.hypot(*off_m(fix)) < 500


def test_a_trail_whose_way_is_unknown_is_turned(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=8)
    both = []
    for k, trail in enumerate(trails):
        times = trail.utc_unix_s[::-1]
        # every other one is stated the wrong way, from a camera on the ground
        wrong = turned(trail.directions[::-1], trail.utc_unix_s - times)
        both.append(replace(trail, directions=wrong if k % 2 else trail.directions, turned_utc_unix_s=times))
    fix = locate(both, orbits, PRIOR)
    assert [orbit.number for orbit in fix.named] == numbers
    assert np.hypot(*off_m(fix)) < 500


def test_many_sightings_of_one_satellite_are_no_independent_ones(tmp_path, sky):
    """The claim of one satellite seen again and again stays at its orbit's error."""
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=4)
    by_number = {orbit.number: orbit for orbit in orbits}
    few = Adjuster(trails, [by_number[n] for n in numbers], PRIOR)
    many = Adjuster(trails * 9, [by_number[n] for n in numbers] * 9, PRIOR)
    place = itrs_place(*np.radians(PLACE[:2]), PLACE[2])
    one, nine = (a.solve(place).covariance for a in (few, many))
    assert nine[0, 0] > 0.8 * one[0, 0]


def test_a_rough_place_makes_two_trails_enough(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=2)
    near = Place.on_ellipsoid(PLACE[0] + 0.3, PLACE[1] - 0.3, covariance=50e3**2 * np.eye(2))
    fix = locate(trails, orbits, PRIOR._replace(near=near))
    assert [orbit.number for orbit in fix.named] == numbers
    off = off_m(fix)
    assert np.hypot(*off) < 3000
    assert off @ np.linalg.solve(fix.covariance[:2, :2], off) < 12


def test_trails_of_two_places_are_refused(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=5)
    rest = [r for r in records if r.satnum not in numbers]
    elsewhere, others = skies.table(rest, (44.0, 13.0, 900.0), np.random.default_rng(2), count=5)
    assert not set(others) & set(numbers)
    (tmp_path / "other.csv").write_text(elsewhere)
    with pytest.raises(SatelliteError, match=r"two places, 5\d\d km apart"):
        locate([*trails, *read_sightings(tmp_path / "other.csv")], orbits, PRIOR)


def test_one_satellite_is_no_place_and_scatter_that_no_error_explains_is_refused(tmp_path, sky):
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=12)
    known = PRIOR._replace(near=Place.on_ellipsoid(*PLACE[:2], covariance=50e3**2 * np.eye(2)))
    again = [replace(trails[0], track=k) for k in range(3)]
    # wherever it stands in the file
    for some in (orbits, sorted(orbits, key=lambda orbit: orbit.number == numbers[0])):
        with pytest.raises(SatelliteError, match="of two or more"):
            locate(again, some, known._replace(clock_stddev_s=1.0))
    # errors of 5 times the stated ones: neither an outlier nor an orbit explains them
    off = np.random.default_rng(4).normal(0, 15 / 206265, (len(trails), 2, 3))
    noisy = [
        replace(t, track=k, directions=normalised(t.directions + d), satellite=n)
        for k, (t, d, n) in enumerate(zip(trails, off, numbers, strict=True))
    ]
    with pytest.raises(SatelliteError, match="fit one place within the stated errors"):
        locate(noisy, orbits, PRIOR)


def test_a_trail_that_leaves_the_frame_counts_by_its_other_end(tmp_path, sky):
    """Half of the trails end at the frame's edge, after a third of the exposure, or before its last two thirds."""
    records, _, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=10)
    seen = []
    for k, trail in enumerate(trails):
        opening, closing = trail.utc_unix_s
        first, last = trail.directions
        if k % 2:
            seen.append(replace(trail, turned_utc_unix_s=trail.utc_unix_s[::-1]))
            continue
        # as the ground sees it, at the opening
        last_there = turned(last[None], np.array([opening - closing]))[0]
        edge = normalised(first + (last_there - first) * (1 / 3 if k % 4 else 2 / 3))
        kept = first if k % 4 else last_there
        seen.append(
            replace(
                trail,
                directions=kept[None],
                covariance=trail.covariance[:1],
                utc_unix_s=np.array([opening]),
                turned_utc_unix_s=np.array([closing]),
                towards=edge,
            )
        )
    fix = locate(seen, orbits, PRIOR)
    assert [orbit.number for orbit in fix.named] == numbers
    off = off_m(fix)
    assert off @ np.linalg.solve(fix.covariance[:2, :2], off) < 12


def test_refusals(tmp_path, sky):
    records, path, orbits = sky
    trails, numbers, _ = trails_of(tmp_path, records, count=3)
    with pytest.raises(SatelliteError, match="takes 3"):
        locate(trails[:2], orbits, PRIOR)
    with pytest.raises(SatelliteError, match=r"no place agrees|can be satellites"):
        locate(trails, [o for o in orbits if o.number not in numbers[:2]], PRIOR)
    every = read_orbits(path)[0]
    with pytest.raises(SatelliteError, match="--newer-elements"):
        chosen(every, skies.NIGHT - 2 * 86400)
    assert len(chosen(every, skies.NIGHT - 2 * 86400, newer=True)[0]) == 900
    with pytest.raises(SatelliteError, match="older than their class"):
        chosen(every, skies.NIGHT + 40 * 86400)
