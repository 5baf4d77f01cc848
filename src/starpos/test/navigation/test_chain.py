# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos.navigation.chain import Chain, log_likelihood, smoothed

COUNT, N, M = 5, 3, 2


@pytest.fixture
def chain(rng):
    return Chain(
        first=rng.normal(size=(N + M + 1, N + M + 1)),
        nodes=rng.normal(size=(COUNT, 2, N + M + 1)),
        links=rng.normal(size=(COUNT - 1, N, 2 * N + M + 1)),
        constants=M,
    )


def whole(chain):
    """All equations at once: matrix and right-hand side."""
    rows = []
    for k in range(COUNT):
        for own in [*chain.nodes[k], *(chain.first if k == 0 else ())]:
            row = np.zeros(COUNT * N + M + 1)
            row[k * N : (k + 1) * N], row[COUNT * N :] = own[:N], own[N:]
            rows.append(row)
    for k in range(COUNT - 1):
        for link in chain.links[k]:
            row = np.zeros(COUNT * N + M + 1)
            row[k * N : (k + 2) * N], row[COUNT * N :] = link[: 2 * N], link[2 * N :]
            rows.append(row)
    rows = np.array(rows)
    return rows[:, :-1], rows[:, -1]


def test_the_smoother_is_the_adjustment_of_all_at_once(chain):
    a, b = whole(chain)
    x, found = np.linalg.lstsq(a, b, rcond=None)[0], smoothed(chain)
    assert found.nodes.ravel() == pytest.approx(x[: COUNT * N])
    assert found.constants == pytest.approx(x[COUNT * N :])
    covariance = np.linalg.inv(a.T @ a)
    for k in range(COUNT):
        own = np.r_[k * N : (k + 1) * N, COUNT * N : COUNT * N + M]
        assert found.covariance[k] == pytest.approx(covariance[np.ix_(own, own)])


def test_the_likelihood_is_that_of_all_at_once(chain):
    a, b = whole(chain)
    x = np.linalg.lstsq(a, b, rcond=None)[0]
    expected = -0.5 * np.sum((a @ x - b) ** 2) - 0.5 * np.linalg.slogdet(a.T @ a)[1]
    assert log_likelihood(chain) == pytest.approx(expected)


def test_what_nothing_is_known_of_stays_so_beside_what_is_known_well(chain):
    """A first place known to 1e7 and links good to 1e-4: the sum keeps its digits."""
    first = np.diag(np.full(N + M + 1, 1e-7))[:-1]
    links = np.zeros((COUNT - 1, N, 2 * N + M + 1))
    links[:, :, :N], links[:, :, N : 2 * N] = -np.eye(N) * 1e4, np.eye(N) * 1e4
    links[:, :, -1] = 1e4
    nodes = np.zeros((COUNT, 2, N + M + 1))
    found = smoothed(Chain(first=first, nodes=nodes, links=links, constants=M))
    assert np.diff(found.nodes, axis=0) == pytest.approx(np.ones((COUNT - 1, N)), abs=1e-6)
    assert np.sqrt(found.covariance[-1, 0, 0]) == pytest.approx(1e7, rel=1e-3)
