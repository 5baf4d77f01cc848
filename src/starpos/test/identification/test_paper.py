# SPDX-License-Identifier: Apache-2.0
"""The paper's own figures, from the committed catalogue."""

from itertools import combinations

import numpy as np
import paper_triangles as paper
import pytest


def test_the_papers_stars_and_triangles(catalogue):
    """The paper prints 951,181 triangles: docs/the_paper.md."""
    row = paper.stars(catalogue)
    assert len(row) == 15_236
    count = paper.count_triangles(catalogue.directions(row), np.radians(paper.LONGEST_SIDE_DEG))
    # from the original files it is 952,970
    assert count == pytest.approx(953_187, abs=9)
    shorter = paper.count_triangles(catalogue.directions(row), np.radians(3.43))
    assert shorter == pytest.approx(490_000, rel=0.05)


def test_the_papers_stars_differ_little_from_the_plain_cut(catalogue):
    row, plain = paper.stars(catalogue), paper.plain_cut(catalogue)
    assert len(np.setdiff1d(plain, row)) < 250
    added = np.setdiff1d(row, plain)
    # one of a merged pair, or one whose V was rounded up to the limit
    assert catalogue.vmag(added) == pytest.approx(paper.LIMIT_MAG, abs=0.011)
    twice, times = np.unique(row, return_counts=True)
    assert times.max() == 2
    assert (catalogue.vmag(twice[times == 2]) < 6.5).all()


def test_the_printed_angles(catalogue):
    """See docs/the_paper.md#star-vectors; 27 mas in the place of HIP 98753's component A are 1.4e-5 rad."""
    here, sigma = paper.angles_of_printed(catalogue)
    assert here == pytest.approx(paper.ANGLES, abs=1.5e-5)
    assert np.all(np.abs(here - paper.ANGLES) < 1.5 * sigma + 5e-6)
    assert sigma.max() < 2e-5


@pytest.mark.parametrize("side_deg", [3, 20, 200])
def test_triangles_by_brute_force(side_deg, rng):
    v = rng.normal((0, 0, 4), 1, (40, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    # A pair in one place counts as two stars.
    v[7] = v[3]
    longest = np.radians(side_deg)
    near = paper.sides(v[:, None], v) < longest
    expected = sum(near[i, j] and near[i, k] and near[j, k] for i, j, k in combinations(range(40), 3))
    assert paper.count_triangles(v, min(longest, np.pi)) == expected
