# SPDX-License-Identifier: Apache-2.0
"""Frames of unknown scale: found in fields of 1 to 90 deg, mirrored, under false stars; random points are not."""

import csv
import time
from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.detection import detect
from starpos.fix import blind as fix_blind
from starpos.fix.blind import BlindSolver
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frames.reading import read_frame
from starpos.identification import Sky, blind, quads
from starpos.identification.pose import stars_at
from starpos.identification.quads import matches
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument

WIDTH, HEIGHT = 1600, 1200
# field from corner to corner, deg, and the faintest star of a frame
FIELDS = [(1.2, 11.0), (2.0, 11.0), (5.0, 9.5), (13.0, 7.5), (30.0, 6.0), (55.0, 5.0), (90.0, 4.5)]


@pytest.fixture(scope="module")
def solver(catalogue):
    """The search has time enough on a busy machine, where a second of CPU does less."""
    return BlindSolver(catalogue, search_s=40.0)


def listed(xy, sigma_px=0.1):
    n = len(xy)
    return Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=np.arange(n, 0, -1.0),
        snr=np.full(n, 20.0),
        covariance=np.broadcast_to(sigma_px**2 * np.eye(2), (n, 2, 2)),
        flags=np.zeros(n),
        width=WIDTH,
        height=HEIGHT,
    )


def seen(catalogue, field_deg, limit_mag, rng, scatter_mag=0.2):
    """Stars (N, 2) px, brightest first, of a random frame; the direction of its middle; its focal length."""
    focal_px = np.hypot(WIDTH, HEIGHT) / 2 / np.tan(np.radians(field_deg / 2))
    camera = Camera.from_focal(WIDTH, HEIGHT, focal_px)
    attitude = rotation.best_rotation(rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3, 3)))[0]
    index = catalogue.cone(attitude[2], camera.half_diagonal_rad, limit_mag)
    xy = camera.project(catalogue.directions(index) @ attitude.T) + rng.normal(0, 0.1, (len(index), 2))
    mag = catalogue.vmag(index) + rng.normal(0, scatter_mag, len(index))
    on = ((xy > 0) & (xy < [WIDTH - 1, HEIGHT - 1])).all(1) & (rng.random(len(index)) > 0.05)
    on = np.flatnonzero(on)[np.argsort(mag[on])]
    return xy[on], attitude[2], focal_px


def looks(s, axis):
    a = s.pointing
    return np.array([np.cos(a.dec) * np.cos(a.ra), np.cos(a.dec) * np.sin(a.ra), np.sin(a.dec)]) @ axis


@pytest.mark.parametrize(("field_deg", "limit_mag"), FIELDS)
def test_frames_of_any_scale_are_found(field_deg, limit_mag, solver, catalogue, rng):
    found = 0
    for _ in range(3):
        xy, axis, focal_px = seen(catalogue, field_deg, limit_mag, rng)
        s = solver.identify(listed(xy))
        if s.ok:
            assert np.sqrt(2 - 2 * looks(s, axis)) < 1 / focal_px
            assert s.pointing.focal_px == pytest.approx(focal_px, rel=2e-3)
            assert s.warnings == ()
            found += 1
    assert found >= 2


@pytest.mark.parametrize("off", [0.85, 1.15])
def test_a_focal_length_that_is_roughly_known_comes_first(off, solver, catalogue, rng, monkeypatch):
    """EXIF's: rounded, or of a lens that breathes. Where a frame is found near it no other scale is searched."""
    tried, all_of = [], blind.focal_lengths
    monkeypatch.setattr(blind, "focal_lengths", lambda *span: tried.append(span[1:]) or all_of(*span))
    for field_deg, limit_mag in FIELDS[2::2]:
        xy, axis, focal_px = seen(catalogue, field_deg, limit_mag, rng)
        free = solver.identify(listed(xy))
        tried.clear()
        s = solver.identify(replace(listed(xy), rough_focal_px=off * focal_px))
        if free.ok:
            assert s.ok and looks(s, axis) > 1 - 1e-6
            assert s.pointing.focal_px == pytest.approx(focal_px, rel=2e-3)
            assert s.pointing.log_odds > free.pointing.log_odds
            assert all(longest < 1.5 * shortest for shortest, longest in tried)


@pytest.mark.parametrize("off", [0.1, 3.0, 1e6])
def test_a_wrong_focal_length_of_exif_costs_time_only(off, solver, catalogue, rng):
    xy, axis, focal_px = seen(catalogue, 13.0, 7.5, rng)
    s = solver.identify(replace(listed(xy), rough_focal_px=off * focal_px))
    assert s.ok and looks(s, axis) > 1 - 1e-6 and s.pointing.focal_px == pytest.approx(focal_px, rel=2e-3)


def test_a_telephone_s_widest_lens_is_found_where_exif_tells_it(solver, catalogue, rng):
    """Lens of 13 mm on film's frame: wider than the fields that are searched by default."""
    xy, axis, focal_px = seen(catalogue, 114.0, 3.5, rng)
    s = solver.identify(replace(listed(xy), rough_focal_px=1.05 * focal_px))
    assert s.ok
    assert np.sqrt(2 - 2 * looks(s, axis)) < 1 / focal_px


def test_a_mirrored_frame_is_found_and_said(solver, catalogue, rng):
    xy, axis, _ = seen(catalogue, 8.0, 8.5, rng)
    s = solver.identify(listed(np.stack([xy[:, 0], HEIGHT - 1 - xy[:, 1]], 1)))
    assert s.ok and s.pointing.mirrored and looks(s, axis) > 1 - 1e-6


def test_a_few_false_stars_brighter_than_all_others_do_not_matter(solver, catalogue, rng):
    xy, axis, _ = seen(catalogue, 8.0, 8.5, rng)
    false = rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (5, 2))
    s = solver.identify(listed(np.concatenate([false, xy])))
    assert s.ok and looks(s, axis) > 1 - 1e-6


def test_lights_that_crowd_in_one_corner_hide_no_sky(solver, catalogue, rng):
    xy, axis, _ = seen(catalogue, 13.0, 7.5, rng)
    town = rng.uniform([0, 0.85 * HEIGHT], [0.3 * WIDTH, HEIGHT - 1], (120, 2))
    s = solver.identify(listed(np.concatenate([town, xy])))
    assert s.ok and looks(s, axis) > 1 - 1e-6
    assert s.star.min() >= len(town)


def test_random_points_are_refused_in_bounded_time(solver, rng):
    begin = time.process_time()
    for n in (0, 3, 4, 14):
        s = solver.identify(listed(rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (n, 2))))
        assert s.status is (Status.TOO_FEW_STARS if n < 4 else Status.NOT_IDENTIFIED)
    assert "at any scale" in s.message
    assert time.process_time() - begin < 60


def crowd(rng):
    """A swarm of detections that makes very many quads of the same sizes, as a cloud's edge or a tree does."""
    swarm = rng.normal([800, 600], [30, 30], (60, 2))
    return listed(np.concatenate([swarm, rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (40, 2))]))


def test_a_search_ends_with_its_time_and_says_how_to_go_on(catalogue, rng):
    said = []
    solver = BlindSolver(catalogue, lambda what, done: said.append(done), search_s=1.0)
    begin = time.process_time()
    s = solver.identify(crowd(rng))
    assert s.status is Status.NOT_IDENTIFIED and "in 1 s of CPU" in s.message and "--search-time" in s.message
    assert time.process_time() - begin < 4
    assert said and all(0 <= done <= 1 for done in said)


def test_building_the_quads_takes_no_time_of_the_search(solver, catalogue, rng, monkeypatch):
    order, quads_of, limit_of = [], fix_blind.cached_quads, fix_blind.CpuLimit.of
    monkeypatch.setattr(fix_blind, "cached_quads", lambda *given: order.append("quads") or quads_of(*given))
    monkeypatch.setattr(fix_blind.CpuLimit, "of", lambda *given: order.append("limit") or limit_of(*given))
    xy, _, _ = seen(catalogue, 8.0, 8.5, rng)
    assert solver.identify(listed(xy)).ok and order[:2] == ["quads", "limit"]


def test_at_any_scale_the_quads_of_a_frame_are_those_of_the_sky(catalogue, rng):
    """Every quad of the sky that a frame can hold is found again, whatever the focal length of that frame."""
    sky, table, half_px = (
        Sky(catalogue, None),
        quads.cached_quads(catalogue),
        np.hypot(WIDTH, HEIGHT) / 2,
    )
    span = [half_px / np.tan(np.radians(d / 2)) for d in (blind.LARGEST_DEG, blind.SMALLEST_DEG)]
    tried = 0
    while tried < 40:
        focal_px, quad = np.exp(rng.uniform(*np.log(span))), rng.integers(len(table.corners))
        camera = Camera.from_focal(WIDTH, HEIGHT, focal_px)
        w = sky.directions(table.corners[quad])
        axis = rotation.normalised(w.mean(0)[None])[0]
        turn = rotation.best_rotation(axis[None, None], np.array([[[0.0, 0, 1]]]))[0]
        xy = camera.project(w @ turn.T)
        # a quad of a few pixels has no shape, and one that is not on the frame is not seen
        if not (np.abs(xy - camera.centre_px) < [WIDTH / 2, HEIGHT / 2]).all() or np.ptp(xy) < 300:
            continue
        tried += 1
        field = stars_at(camera, xy, np.full(4, 0.1))
        found = [
            matches(field, table, 4, 0.4, focal, step)
            for focal, step in blind.focal_lengths(half_px, *span)
            if abs(np.log(focal / focal_px)) < 0.3
        ]
        assert any((corner == table.corners[quad]).all(1).any() for _, corner, _ in found), focal_px


def test_the_focal_lengths_that_are_tried_cover_all():
    half_px = 1000.0
    for shortest, longest in ((800.0, 2e5), (466.0, 1000.0)):
        reached = shortest
        for focal_px, step in blind.focal_lengths(half_px, shortest, longest):
            assert focal_px * (1 - step) <= reached * (1 + 1e-9)
            reached = focal_px * (1 + step)
        assert reached >= longest


def test_a_poor_answer_near_the_focal_length_of_exif_does_not_bind(solver, catalogue, rng):
    """Eight stars of one sky fit the stated focal length; sixty of another fit a third of it."""
    few, _, told_px = seen(catalogue, 6.0, 8.5, rng)
    many, axis, focal_px = seen(catalogue, 20.0, 7.0, rng)
    xy = np.concatenate([few[:8], many[:60]])
    alone = solver.identify(replace(listed(few[:8]), rough_focal_px=told_px))
    assert alone.ok and alone.pointing.focal_px == pytest.approx(told_px, rel=3e-3)
    s = solver.identify(replace(listed(xy), rough_focal_px=told_px))
    assert s.ok and looks(s, axis) > 1 - 1e-6 and s.pointing.focal_px == pytest.approx(focal_px, rel=3e-3)
    assert s.pointing.log_odds > 2 * alone.pointing.log_odds


def test_a_shape_is_that_of_the_quad_turned_scaled_and_mirrored(rng):
    flat = rng.normal(size=(50, 4, 2)) * 0.001
    v = rotation.normalised(np.concatenate([flat, np.ones((50, 4, 1))], 2))
    order, shape, size = quads.shapes(quads.chords(v))
    shuffled = rng.permutation(4)
    w = rotation.normalised(np.concatenate([2 * flat[:, shuffled] * [-1, 1], np.ones((50, 4, 1))], 2))
    again, shape2, size2 = quads.shapes(quads.chords(w @ rotation.from_vector([0.3, -0.2, 1.0])))
    assert np.allclose(shape, shape2, atol=1e-4) and np.allclose(2 * size, size2, rtol=1e-4)
    assert np.array_equal(shuffled[again], order)


def test_a_damaged_cache_is_built_again(catalogue, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(quads, "LEVELS", ((19.4, 6), (29.0, 6)))
    quads.KEPT.forget()
    # a copy, because the file below it is damaged
    first = quads.cached_quads(catalogue).shape.copy()
    assert quads.is_built(catalogue) and len(first) > 100
    (folder,) = (tmp_path / "starpos").glob("quads-*")
    (folder / "shape.npy").write_bytes(b"no")
    quads.KEPT.forget()
    assert np.array_equal(quads.cached_quads(catalogue).shape, first)
    assert (folder / "shape.npy").stat().st_size > 100


def test_real_frames_are_found_with_no_option_at_all(shared, solver):
    with (shared / "real" / "truth.csv").open() as f:
        rows = [row for row in csv.DictReader(f) if row["solved"] == "1"][::6]
    right = 0
    for row in rows:
        s = solver.identify(detect(read_frame(shared / "real" / row["set"] / row["file"])).stars)
        if s.ok:
            ra, dec = np.radians([float(row["ra_deg"]), float(row["dec_deg"])])
            axis = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
            off_arcsec = np.degrees(np.sqrt(max(2 - 2 * looks(s, axis), 0))) * 3600
            assert off_arcsec < max(20, 1.5 * float(row["scale_x"])), row["file"]
            right += 1
    assert right >= 0.9 * len(rows)


@pytest.mark.parametrize(("field_deg", "limit_mag"), [(80.0, 4.5), (99.0, 4.0)])
def test_wide_fields_of_a_known_scale_are_found(field_deg, limit_mag, catalogue, rng):
    for _ in range(3):
        xy, axis, focal_px = seen(catalogue, field_deg, limit_mag, rng)
        s = Solver(Instrument(focal_px), catalogue).identify(listed(xy))
        assert s.ok and np.sqrt(2 - 2 * looks(s, axis)) < 1 / focal_px
