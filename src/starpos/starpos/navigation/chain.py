# SPDX-License-Identifier: Apache-2.0
"""Least squares of a chain of nodes with constants that all share: the filter forward, the smoother backward.

Each node's unknowns are eliminated by orthogonal rotations (square-root information filter; Bierman 1977, Factorization
Methods for Discrete Sequential Estimation, chapter 5).  That keeps digits enough where
millimetres and a hundred kilometres stand side by side, and takes unknowns of which nothing is known.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """Whitened equations of K nodes with n unknowns each and of m constants; the last column is the right-hand side.

    first  (P, n + m + 1): of the first node and the constants
    nodes  (K, R, n + m + 1): of each node and the constants
    links  (K - 1, L, 2 n + m + 1): of each node, the next one and the constants
    """

    first: np.ndarray
    nodes: np.ndarray
    links: np.ndarray
    constants: int

    @property
    def unknowns(self) -> int:
        """Unknowns n of a node."""
        return self.nodes.shape[2] - self.constants - 1


@dataclass(frozen=True, eq=False, kw_only=True)
class Smoothed:
    """Unknowns (K, n) of all nodes, constants (m,), and covariances (K, n + m, n + m) of each node with the constants."""

    nodes: np.ndarray
    constants: np.ndarray
    covariance: np.ndarray


def log_likelihood(chain: Chain) -> float:
    """Logarithm of how likely the equations are, whatever the unknowns, but for the determinants of their whitening."""
    eliminated, last = _forward(chain)
    n = chain.unknowns
    misfit = sum(float(triangle[-1, -1] ** 2) for triangle in (*eliminated, last)) / 2
    diagonals = [np.diagonal(triangle) for triangle in (*eliminated[:, :n], last[:-1])]
    return -misfit - float(np.log(np.abs(np.concatenate(diagonals))).sum())


def _forward(chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (K - 1, n + 1, 2 n + m + 1) of eliminated nodes and (n + m + 1, n + m + 1) of the last one.

    The last row of each has what no unknown can take up.
    """
    n, m, count = chain.unknowns, chain.constants, len(chain.nodes)
    eliminated = np.empty((count - 1, n + 1, 2 * n + m + 1))
    carried = chain.first
    for k in range(count - 1):
        rows = np.zeros((len(carried) + chain.nodes.shape[1] + chain.links.shape[1], 2 * n + m + 1))
        own = np.vstack([carried, chain.nodes[k]])
        rows[: len(own), :n], rows[: len(own), 2 * n :] = own[:, :n], own[:, n:]
        rows[len(own) :] = chain.links[k]
        triangle = _triangle(rows)
        eliminated[k, :n], eliminated[k, n], carried = triangle[:n], triangle[-1], triangle[n:-1, n:]
    return eliminated, _triangle(np.vstack([carried, chain.nodes[-1]]))


def _triangle(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(rows, mode="r"))


def smoothed(chain: Chain) -> Smoothed:
    """Solve a chain: the last node and the constants first, then each node from the one after it."""
    (eliminated, last), n = _forward(chain), chain.unknowns
    count, size = len(chain.nodes), last.shape[1] - 1
    root = solve_triangular(last[:-1, :-1], np.eye(size), check_finite=False)
    x = root @ last[:-1, -1]
    nodes, constants = np.empty((count, n)), x[n:]
    nodes[-1] = x[:n]
    covariance = np.empty((count, size, size))
    covariance[-1] = root @ root.T
    for k in range(count - 2, -1, -1):
        row = eliminated[k, :n]
        solved = solve_triangular(row[:, :n], np.hstack([row[:, n:], np.eye(n)]), check_finite=False)
        onward, value, noise = solved[:, :size], solved[:, size], solved[:, size + 1 :]
        nodes[k] = value - onward @ np.append(nodes[k + 1], constants)
        after = covariance[k + 1]
        across = -onward @ after
        covariance[k, :n, :n] = noise @ noise.T - across @ onward.T
        covariance[k, :n, n:] = across[:, n:]
        covariance[k, n:, :n] = across[:, n:].T
        covariance[k, n:, n:] = after[n:, n:]
    return Smoothed(nodes=nodes, constants=constants, covariance=covariance)
