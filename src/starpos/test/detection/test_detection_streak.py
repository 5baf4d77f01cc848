# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.finding import CELL, FEWEST, GAP, SHORTEST, _may_be_a_line, _through
from starpos.frames.frame import ELONGATED, Frame
from starpos_testing.skies.rendered import bound, field, grid, match, noisy

SIZE = (700, 900)


def trail(start, end, electrons_per_px, width=1.3, size=SIZE):
    """Electrons of a satellite's trail: a Gaussian across, sharp at its ends."""
    y, x = np.ogrid[: size[0], : size[1]]
    way = np.subtract(end, start)
    length = np.hypot(*way)
    along = ((x - start[0]) * way[0] + (y - start[1]) * way[1]) / length
    across = ((y - start[1]) * way[0] - (x - start[0]) * way[1]) / length
    profile = np.exp(-0.5 * (across / width) ** 2) / (width * np.sqrt(2 * np.pi))
    return electrons_per_px * profile * ((along > 0) & (along < length))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((-50, 40), (950, 780)),
        ((400.3, -20), (431.0, 720)),
        ((-9, 333.4), (909, 333.4)),
        ((210, 120), (640, 560)),
    ],
)
@pytest.mark.parametrize("electrons", [150, 2000])
def test_a_trail_makes_no_star_and_costs_none_beside_it(start, end, electrons, rng):
    stars = grid(SIZE, 50, 9000, rng)
    light = field(SIZE, stars)
    found = detect(Frame(noisy(light + trail(start, end, electrons), rng))).stars
    plain = trail(start, end, 1.0, width=1.0)
    far = plain[np.rint(stars[:, 1]).astype(int), np.rint(stars[:, 0]).astype(int)] < 1e-6
    index = match(found, stars)
    assert np.all(index[far] >= 0)
    assert len(found) == np.sum(index >= 0)
    error = np.stack([found.x[index], found.y[index]], 1)[far] - stars[far, :2]
    assert np.sqrt(np.mean(error**2)) < 1.15 * np.sqrt(np.mean(bound(9000) ** 2))
    assert np.all((found.flags[index[far]] & ELONGATED) == 0)


def test_no_line_is_passed_over_because_its_peaks_are_far_apart(rng):
    """Peaks at random, and with a row of some among them whose gaps are as large as a line may have."""
    seen = [0, 0]
    for _ in range(400):
        place = rng.uniform(0, 400, (rng.integers(0, 40), 2))
        step = rng.uniform(4, (GAP + 1) * CELL + 2)
        row = np.arange(rng.integers(3, 30))[:, None] * step + rng.normal(0, 1.5, (1, 1))
        angle = rng.uniform(0, np.pi)
        way = np.array([np.cos(angle), np.sin(angle)])
        place = np.concatenate([place, 200 + (row - row.mean()) * way + rng.normal(0, 1.0, (len(row), 2))])
        x, y = place[((place >= 0) & (place < 400)).all(1)].astype(int).T
        cells = np.zeros((400 // CELL + 1,) * 2, np.uint8)
        cells[y // CELL, x // CELL] = 255
        lines = cv2.HoughLinesP(cells, 1, np.pi / 360, FEWEST, minLineLength=SHORTEST / CELL, maxLineGap=GAP)
        points = np.stack([x, y], 1).astype(float)
        ends = [] if lines is None else lines.reshape(-1, 2, 2) * CELL + CELL / 2
        is_line = any(_through(points, each) is not None for each in ends)
        if is_line:
            assert _may_be_a_line(x, y)
        seen[is_line] += 1
    assert min(seen) > 50


@pytest.mark.parametrize("electrons", [150, 500, 2000])
@pytest.mark.parametrize("count", [1, 3, 8, 25])
def test_a_trail_is_no_ring_however_few_the_stars(count, electrons, rng):
    start, end = (-50, 40), (950, 780)
    stars = grid(SIZE, 50, 9000, rng)
    near = trail(start, end, 1.0, 9)[stars[:, 1].astype(int), stars[:, 0].astype(int)]
    stars = rng.permutation(stars[near < 1e-4])[:count]
    found = detect(Frame(noisy(field(SIZE, stars) + trail(start, end, electrons), rng))).stars
    assert np.all(match(found, stars) >= 0)
    assert len(found) == count


@pytest.mark.montecarlo
def test_a_long_trail_on_a_large_frame_hides_no_star(rng):
    size, start, end = (1872, 2808), (-20, 375), (2828, 1500)
    stars = grid(size, 180, 9000, rng)
    light = field(size, stars) + trail(start, end, 300, size=size)
    found = detect(Frame(noisy(light, rng))).stars
    index = match(found, stars)
    # One or two lie under it.
    assert np.mean(index >= 0) > 0.9
    assert len(found) == np.count_nonzero(index >= 0)


def test_stars_under_a_trail_are_measured_as_well_as_they_say(rng):
    start, end = (-50, 40), (950, 780)
    slope = (end[1] - start[1]) / (end[0] - start[0])
    x = np.arange(40, 800, 30) + rng.uniform(-1, 1, 26)
    under = np.stack([x, start[1] + slope * (x - start[0]) + rng.uniform(-4, 4, 26), np.full(26, 12000.0)], 1)
    near, others = trail(start, end, 1, 9), grid(SIZE, 60, 12000, rng)
    stars = np.concatenate([under, [s for s in others if near[int(s[1]), int(s[0])] < 1e-3]])
    found = detect(Frame(noisy(field(SIZE, stars) + trail(start, end, 1500), rng))).stars
    index = match(found, under)
    assert np.mean(index >= 0) > 0.9
    index, under = index[index >= 0], under[index >= 0]
    error = np.stack([found.x[index], found.y[index]], 1) - under[:, :2]
    pull = error / np.sqrt(np.einsum("nii->ni", found.covariance[index]))
    assert np.sqrt(np.mean(pull**2)) < 1.4
    assert np.sqrt(np.mean(error**2)) < 0.1


def test_a_row_of_stars_is_no_trail(rng):
    x = np.arange(20, 880, 20) + rng.uniform(-1, 1, 43)
    row = np.stack([x, 50 + 0.6 * x, np.full(43, 12000.0)], 1)
    found = detect(Frame(noisy(field(SIZE, row), rng))).stars
    index = match(found, row)
    assert np.all(index >= 0) and len(found) == len(row)
    assert not np.any(found.flags[index] & ELONGATED)
