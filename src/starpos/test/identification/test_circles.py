# SPDX-License-Identifier: Apache-2.0
"""Triples of the brightest stars of circles, of more stars than a key of 64 bits holds three of."""

from itertools import combinations

import numpy as np
import pytest
from paper_triangles import opposite_sides

from starpos.identification._circles import binned, distinct, triples_of_circles
from starpos.identification.triangles import BINS

RADIUS, MOST = 0.02, 7
# 64 bits hold (a n + b) n + c up to 2,097,151 stars
STARS = 2_300_000


@pytest.fixture(scope="module")
def stars(rng_of_module):
    """STARS directions: the faintest 3000 on a patch 0.1 rad wide about -z, all others on the other half of the sky."""
    v = np.empty((STARS, 3))
    v[:] = rng_of_module.normal(size=(1000, 3)).repeat(STARS // 1000, axis=0)
    v[:, 2] = np.abs(v[:, 2])
    v[-3000:] = np.column_stack([rng_of_module.uniform(-0.05, 0.05, (3000, 2)), np.full(3000, -1.0)])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def rng_of_module():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def centres(rng_of_module):
    v = np.column_stack([rng_of_module.uniform(-0.05, 0.05, (60, 2)), np.full(60, -1.0)])
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def triples(stars, centres):
    return distinct(*triples_of_circles(stars, centres, RADIUS, MOST), STARS)


def test_triples_of_millions_of_stars_are_those_of_brute_force(stars, centres, triples):
    first, others = triples
    assert first[0] == 0 and first[-1] == len(others) and np.all(np.diff(first) >= 0)
    a = np.repeat(np.arange(STARS), np.diff(first))
    found = list(zip(a.tolist(), (others >> 32).tolist(), (others & 0xFFFFFFFF).tolist(), strict=True))
    wanted = set()
    for centre in centres:
        near = (
            STARS
            - 3000
            + np.flatnonzero(np.linalg.norm(stars[-3000:] - centre, axis=1) <= 2 * np.sin(RADIUS / 2))
        )
        wanted |= set(combinations(near[:MOST].tolist(), 3))
    assert len(wanted) > 1000
    assert found == sorted(wanted)


def test_triangles_of_millions_of_stars_are_those_of_their_triples(stars, triples):
    rows = np.arange(STARS, dtype=np.int32)
    corners, _, shape, start = binned(stars, rows, *triples, 1e-5, 0.1, int(np.prod(BINS)))
    assert start[-1] == len(corners) == len(triples[1])
    assert corners.min() >= STARS - 3000 and corners.max() < STARS
    np.testing.assert_allclose(
        (shape[:, 2] + 0.5) * (0.1 / 65536), opposite_sides(stars[corners]).max(1), atol=1e-6
    )
