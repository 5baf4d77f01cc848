# SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import subprocess
import sys
import threading
from itertools import combinations

import numpy as np
import pytest
from paper_triangles import angles, opposite_sides, sides
from scipy.spatial.transform import Rotation

from starpos.identification import triangles
from starpos.identification.pose import directions, stars_at
from starpos.instrument.camera import Camera
from starpos.rotation import shortest_turn
from starpos_testing.patience import WAIT_S

# Half the diagonal of a 15 deg field.
WIDE = np.radians(7.5)
# Its table is built in a second.
BROAD = np.radians(25)


@pytest.fixture(scope="module")
def table(catalogue):
    return triangles.cached_triangles(catalogue, WIDE)


@pytest.fixture(scope="module")
def places(table, catalogue):
    """Directions (S, 3) of the table's stars."""
    return catalogue.directions(table.star)


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """An empty cache and nothing remembered from it, before and after."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    triangles.KEPT.forget()
    yield tmp_path / "cache" / "starpos"
    triangles.KEPT.forget()


def unit(ra_deg, dec_deg):
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def test_an_octant_has_three_right_angles():
    x, y, z = np.eye(3)
    assert angles(opposite_sides(np.stack([x, y, z]))) == pytest.approx([np.pi / 2] * 3, abs=1e-15)
    assert sides(x, y) == pytest.approx(np.pi / 2)


def test_angles_by_the_law_of_cosines_and_the_excess(rng):
    """Equation 4 as the paper prints it; the sum exceeds pi by the area (Girard; L'Huilier by the triple product)."""
    v = rng.normal(size=(500, 3, 3))
    v /= np.linalg.norm(v, axis=2, keepdims=True)
    found = angles(opposite_sides(v))
    a, b, c = (sides(v[:, i], v[:, j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    at_first = np.arccos((np.cos(a) - np.cos(b) * np.cos(c)) / (np.sin(b) * np.sin(c)))
    np.testing.assert_allclose(found[:, 0], at_first, atol=1e-7)
    product = np.abs(np.einsum("ni,ni->n", v[:, 0], np.cross(v[:, 1], v[:, 2])))
    area = 2 * np.arctan2(product, 1 + np.cos(a) + np.cos(b) + np.cos(c))
    np.testing.assert_allclose(found.sum(1) - np.pi, area % (2 * np.pi), atol=1e-9)


def test_small_triangles_keep_their_digits():
    """An arcsec-sized one: plane angles to nine digits, where the cosine formula would lose them all."""
    s = np.radians(1 / 3600)
    v = np.array([[0, 0, 1.0], [3 * s, 0, 1], [0, 4 * s, 1]])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    assert angles(opposite_sides(np.stack(v))) == pytest.approx(
        [np.pi / 2, np.arctan(4 / 3), np.arctan(3 / 4)], abs=1e-9
    )


def test_degenerate_triangles_give_numbers():
    x, y, _ = np.eye(3)
    for v in ((x, x, x), (x, x, y), (x, y, (x + y) / 2**0.5)):
        assert np.isfinite(angles(opposite_sides(np.stack(v)))).all()


def shapes(table, places):
    """Largest angle, smallest angle, longest side (n, 3) from the catalogue's own places."""
    side = opposite_sides(places[table.corners])
    angle = angles(side)
    return np.stack([angle.max(1), angle.min(1), side.max(1)], -1)


def queries(v, error_rad):
    """What is asked for three stars v (3, 3): their order, and shape and tolerance (3,) of each; the plain form."""
    side = opposite_sides(v)
    angle = angles(side)
    order = np.argsort(-angle)
    (a, b, c), angle, error = side[order], angle[order], triangles.TRIANGLE_SIGMA * error_rad
    largest = error * np.sqrt(1 / b**2 + 1 / c**2 + (a / (b * c)) ** 2)
    smallest = error * np.sqrt(1 / a**2 + 1 / b**2 + (c / (a * b)) ** 2)
    orders = [order]
    if angle[0] - angle[1] < 2 * largest:
        orders.append(order[[1, 0, 2]])
    if angle[1] - angle[2] < 2 * largest:
        orders.append(order[[0, 2, 1]])
    tolerance = np.array([largest, smallest, triangles.SCALE_TOLERANCE * a + error])
    return orders, np.array([angle[0], angle[2], a]), tolerance


def test_what_is_looked_up_is_what_brute_force_finds(table, places, rng):
    camera, known, answers = Camera.from_focal(1000, 700, 610.3 / np.tan(WIDE)), shapes(table, places), 0
    # Which shapes, as they are kept.
    rounding = 1e-4
    for triangle in rng.integers(0, len(known), 60):
        v = places[table.corners[triangle]]
        xy = camera.project(v @ shortest_turn(unit_sum(v), np.array([0.0, 0.0, 1.0])).T)
        frame = stars_at(camera, xy + rng.normal(0, 0.3, (3, 2)), np.full(3, 0.3))
        seen = directions(frame.xy[:1], np.array([camera.fx]))[0]
        if rng.random() < 0.3:
            frame = stars_at(camera, xy, np.full(3, 1.5))
            seen = directions(frame.xy[:1], np.array([camera.fx]))[0]
        star, corner, mirrored = table.compiled.candidates(frame, 0, 3, 0.2, 1e9, 100_000, False)
        found = {(*s, *c) for s, c in zip(star.tolist(), corner.tolist(), strict=True)}
        orders, shape, tolerance = queries(seen, np.hypot(0.2, frame.sigma[0]) / camera.fx)
        apart = np.abs(known - shape)
        inside, near = ((apart <= tolerance + more).all(1) for more in (-rounding, rounding))
        for which, is_answer in ((inside, found.issuperset), (near, found.issubset)):
            rows = table.corners[which].tolist()
            assert is_answer({(*o.tolist(), *c) for o in orders for c in rows})
        own = [c == table.corners[triangle].tolist() for c in corner.tolist()]
        assert any(own) and not mirrored[own.index(True)]
        answers += len(found)
    assert answers > 100


def unit_sum(v):
    return v.sum(0) / np.linalg.norm(v.sum(0))


def test_triangles_are_those_of_their_corners(table, places, rng):
    pick = rng.integers(0, len(table.corners), 2000)
    v = places[table.corners[pick]]
    found = angles(opposite_sides(v))
    # The largest's corner first, the smallest's last.
    assert np.all(np.diff(found, axis=1) <= 1e-12)
    turn = np.einsum("ni,ni->n", np.cross(v[:, 0], v[:, 1]), v[:, 2])
    np.testing.assert_array_equal(table.counter_clockwise[pick], turn < 0)
    longest = (table.shape[pick, 2] + 0.5) * (table.longest_allowed[0] / triangles.CODES)
    np.testing.assert_allclose(longest, opposite_sides(v).max(1), atol=1e-5)
    assert longest.max() < 2 * WIDE * 1.05


def test_no_triangle_is_there_twice(table):
    corners = np.sort(table.corners, axis=1)
    assert len(np.unique(corners, axis=0)) == len(corners)


def test_every_part_of_the_sky_has_enough(table, places, catalogue, rng):
    """A limit of one magnitude leaves fields with fewer than three stars; here every frame has at least four of
    the table's, and nearly every one a triangle among its own six brightest."""
    camera = Camera.from_focal(1000, 700, 610.3 / np.tan(WIDE))
    used = np.unique(table.corners)
    known = set(map(tuple, np.sort(table.star[table.corners], axis=1).tolist()))
    fewest, hits, tries = len(used), 0, 300
    for _ in range(tries):
        attitude = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()

        def on_frame(v, attitude=attitude):
            xy = camera.project(v @ attitude.T)
            return ((xy >= 0) & (xy <= [999, 699])).all(1)

        fewest = min(fewest, on_frame(places[used]).sum())
        stars = catalogue.cone(attitude[2], WIDE, 7.0)
        brightest = np.sort(stars[on_frame(catalogue.directions(stars))][:6])
        hits += any(tuple(t) in known for t in combinations(brightest.tolist(), 3))
    assert fewest >= 4
    assert hits > 0.97 * tries


def test_it_is_built_once_then_mapped(own_cache, catalogue, monkeypatch):
    built = []
    table = triangles.cached_triangles(catalogue, BROAD, lambda what, done: built.append(done))
    assert built[-1] == pytest.approx(1)
    (folder,) = own_cache.iterdir()
    triangles.KEPT.forget()
    monkeypatch.setattr(triangles, "build", lambda *_: pytest.fail("built again"))
    again = triangles.cached_triangles(catalogue, BROAD)
    np.testing.assert_array_equal(again.corners, table.corners)
    # a refined focal length does not build another
    assert triangles.cached_triangles(catalogue, BROAD * 1.0001) is not None
    assert [p.name for p in own_cache.iterdir()] == [folder.name]


def test_who_waited_for_another_process_that_built_does_not_build_again(own_cache, catalogue, monkeypatch):
    triangles.cached_triangles(catalogue, BROAD)
    (folder,) = own_cache.iterdir()
    away = folder.rename(own_cache.parent / "away")
    triangles.KEPT.forget()
    absent, built, load = threading.Event(), [], triangles.KEPT.mapped

    def looked(*of):
        found = load(*of)
        absent.set()
        return found

    monkeypatch.setattr(triangles.KEPT, "mapped", looked)
    other = os.open(own_cache, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    waiting = threading.Thread(
        target=triangles.cached_triangles, args=(catalogue, BROAD, lambda what, done: built.append(done))
    )
    waiting.start()
    assert absent.wait(WAIT_S)
    away.rename(folder)
    os.close(other)
    waiting.join(WAIT_S)
    assert not waiting.is_alive()
    assert built == []


def zeroed(path):
    table = np.load(path)
    table[len(table) // 2 :] = 0
    np.save(path, table)


DAMAGE = {
    "a column is missing": ("corners", lambda p: p.unlink()),
    "a column is truncated": ("corners", lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2])),
    "a column is empty": ("corners", lambda p: p.write_bytes(b"")),
    "a column is text": ("corners", lambda p: p.write_bytes(b"text")),
    "rows are missing": ("corners", lambda p: np.save(p, np.zeros((10, 3), np.int32))),
    "half the corners are zero": ("corners", zeroed),
    "half the stars are zero": ("star", zeroed),
    "half the bins are zero": ("bin_start", zeroed),
    "half the cells are zero": ("cell_start", zeroed),
    "corners are no integers": ("corners", lambda p: np.save(p, np.load(p).astype(float))),
    "stars beyond the catalogue": ("star", lambda p: np.save(p, np.load(p) + 2_000_000)),
    "no longest side": ("longest_allowed", lambda p: np.save(p, np.array([np.nan]))),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_broken_cache_is_built_anew(damage, own_cache, catalogue):
    good = triangles.cached_triangles(catalogue, BROAD)
    (folder,) = own_cache.iterdir()
    column, harm = DAMAGE[damage]
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    triangles.KEPT.forget()
    path = folder / f"{column}.npy"
    # Otherwise the harm would reach what is still mapped.
    path.unlink()
    path.write_bytes(kept[path.name])
    harm(path)
    again = triangles.cached_triangles(catalogue, BROAD)
    np.testing.assert_array_equal(again.corners, good.corners)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == kept


def test_what_older_versions_left_in_the_cache_goes(own_cache, catalogue):
    own_cache.mkdir(parents=True)
    for name in (
        "triangles-4.15deg-0123456789abcdef",
        "triangles-8-4.15deg-0123456789abcdef",
        "unfinished-old",
    ):
        (own_cache / name).mkdir()
    os.utime(own_cache / "unfinished-old", (0, 0))
    (own_cache / "unfinished-now").mkdir()
    (own_cache / "somebody's").mkdir()
    triangles.cached_triangles(catalogue, BROAD)
    left = sorted(p.name for p in own_cache.iterdir() if not p.name.startswith(triangles.KEPT.prefix))
    assert left == ["somebody's", "unfinished-now"]


def test_a_cache_that_cannot_be_written(tmp_path, monkeypatch, catalogue):
    """Where the home is read-only (here: a file) the table is kept in memory, and it is said."""
    (tmp_path / "cache").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.warns(UserWarning, match="XDG_CACHE_HOME"):
        assert len(triangles.cached_triangles(catalogue, BROAD).corners) > 1000


def test_two_processes_at_once(own_cache):
    program = (
        "import numpy as np; from starpos.sky import catalogue; from starpos.identification import triangles\n"
        f"t = triangles.cached_triangles(catalogue.load_catalogue(), {BROAD}); "
        "print(len(t.corners), int(t.corners.sum()))"
    )
    environment = os.environ | {"XDG_CACHE_HOME": str(own_cache.parent)}
    running = [
        subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [p.communicate(timeout=WAIT_S)[0] for p in running]
    assert [p.returncode for p in running] == [0, 0]
    assert said[0] == said[1] != ""
    # Nothing half made is left.
    assert sorted(p.name.partition("-")[0] for p in own_cache.iterdir()) == ["stars", "triangles"]
