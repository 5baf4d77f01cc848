# SPDX-License-Identifier: Apache-2.0
"""Detects a GNSS place that is spoofed or wrong, suddenly or slowly.

Every COPY_INTERVAL_S seconds the filter is copied, and the copy is kept for LONGEST_S. A copy has one more unknown, an
error of GNSS that began when it was made, as a step or growing evenly. If GNSS is good, that error is 0 within its
covariance, which includes all errors of the stars' place; a likelihood ratio decides (Willsky and Jones, IEEE Trans.
Automatic Control 21(1), 1976, 108, from memory). So a slow drag shows although each of its frames agrees with the one
before, and although the filter that learns has followed it.
"""

from dataclasses import dataclass, replace

import numpy as np

from starpos.gnss.sighting import Innovation
from starpos.gnss.states import Ageing, Learned

# Interval at which the filter is copied, and time for which each copy is kept, s.
COPY_INTERVAL_S, LONGEST_S = 110.0, 3000.0
# Time from which the growing error is counted, and its unit, s.
GROWS_AFTER_S, UNIT_S = 240.0, 600.0
# 1 sigma of an unknown error, as an angle at the Earth's centre: 600 km.
NOTHING_RAD = 0.1
OFFSETS = 4
# Minimum information (1/rad2) on the error of GNSS: an error of 1 rad, the whole Earth, would be 1 sigma.
MIN_INFORMATION = 1.0


@dataclass(frozen=True, eq=False)
class OnsetFilters:
    """W filters, each with n states and then the error of GNSS: east, north of a step, and of a growth in UNIT_S.

    before: the state that each was copied from.  since (W,): time of the copy.  frames (W,): number used since.
    """

    before: tuple[Learned, ...]
    since: np.ndarray
    frames: np.ndarray
    state: np.ndarray
    covariance: np.ndarray

    @classmethod
    def empty(cls, size: int) -> "OnsetFilters":
        """No filters yet, for a number of states."""
        n = size + OFFSETS
        return cls((), np.zeros(0), np.zeros(0, int), np.zeros((0, n)), np.zeros((0, n, n)))

    def started(self, learned: Learned) -> "OnsetFilters":
        """These filters and a copy of the present one."""
        n = len(learned.state)
        state, covariance = np.zeros((1, n + OFFSETS)), np.zeros((1, n + OFFSETS, n + OFFSETS))
        state[0, :n], covariance[0, :n, :n] = learned.state, learned.covariance
        covariance[0, n:, n:] = np.eye(OFFSETS) * NOTHING_RAD**2
        return OnsetFilters(
            (*self.before, learned),
            np.append(self.since, learned.utc_unix_s),
            np.append(self.frames, 0),
            np.concatenate([self.state, state]),
            np.concatenate([self.covariance, covariance]),
        )

    def due(self, utc_unix_s: float) -> bool:
        """Whether another copy should be made."""
        return not len(self.since) or utc_unix_s - self.since[-1] >= COPY_INTERVAL_S

    def recent(self, utc_unix_s: float) -> "OnsetFilters":
        """The filters that are not older than LONGEST_S."""
        return self._take(utc_unix_s - self.since <= LONGEST_S)

    def _take(self, which: np.ndarray) -> "OnsetFilters":
        before = tuple(b for b, kept in zip(self.before, which, strict=True) if kept)
        return OnsetFilters(
            before, self.since[which], self.frames[which], self.state[which], self.covariance[which]
        )

    def aged(self, by: Ageing) -> "OnsetFilters":
        """These filters with the process noise of the time that passed."""
        state, covariance = by.of(self.state, self.covariance)
        return replace(self, state=state, covariance=covariance)

    def updated(self, seen: Innovation, about: np.ndarray, utc_unix_s: float) -> "OnsetFilters":
        """These filters updated with a frame's GNSS place; its innovation is linear about the states (n,)."""
        n, grown = len(about), (utc_unix_s - self.since) / UNIT_S
        rows = np.empty((len(self.since), 2, n + OFFSETS))
        rows[:, :, :n] = seen.rows
        rows[:, :, n : n + 2] = seen.offset
        rows[:, :, n + 2 :] = seen.offset * grown[:, None, None]
        left = np.concatenate([about - self.state[:, :n], -self.state[:, n:]], 1)
        value = seen.value + np.einsum("wij,wj->wi", rows, left)
        across = self.covariance @ rows.swapaxes(1, 2)
        spread = rows @ across + seen.noise
        gain = np.linalg.solve(spread, across.swapaxes(1, 2)).swapaxes(1, 2)
        kept = np.eye(n + OFFSETS) - gain @ rows
        covariance = kept @ self.covariance @ kept.swapaxes(1, 2) + gain @ seen.noise @ gain.swapaxes(1, 2)
        return replace(
            self,
            state=self.state + np.einsum("wij,wj->wi", gain, value),
            covariance=(covariance + covariance.swapaxes(1, 2)) / 2,
            frames=self.frames + 1,
        )

    def evidence(self, utc_unix_s: float) -> np.ndarray:
        """Evidence of each filter (W,) that GNSS is wrong: the larger chi-square (2 dof) of step and growth."""
        n = self.state.shape[1] - OFFSETS
        weight = np.linalg.inv(self.covariance[:, n:, n:])
        pull = np.einsum("wij,wj->wi", weight, self.state[:, n:])
        # the prior's weight is taken off: only measurements count
        weight = weight - np.eye(OFFSETS) / NOTHING_RAD**2
        step = _chi2(weight[:, :2, :2], pull[:, :2])
        growth = _chi2(weight[:, 2:, 2:], pull[:, 2:])
        old = utc_unix_s - self.since >= GROWS_AFTER_S
        return np.where(self.frames > 0, np.where(old, np.maximum(step, growth), step), 0.0)


def _chi2(weight: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """pull^T weight^-1 pull for each (2, 2) weight, 0 where it holds no information."""
    informative = np.linalg.eigvalsh(weight)[:, 0] > MIN_INFORMATION
    safe = np.where(informative[:, None, None], weight, np.eye(2))
    return np.where(
        informative, np.einsum("wi,wi->w", pull, np.linalg.solve(safe, pull[..., None])[..., 0]), 0.0
    )
