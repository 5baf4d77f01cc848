# SPDX-License-Identifier: Apache-2.0
"""The robust fit of A3, the zenith and the errors of the inclinometer to attitudes and tilts, from several starts."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.calibration.readings import Readings
from starpos.instrument.instrument import UNKNOWN_ARCSEC
from starpos.units import ARCSEC

# a frame further off than this pulls no harder
ROBUST_SIGMA = 3.0
MAX_STEPS, LONGEST_STEP = 60, 0.5
# a step that would lower chi-square by less (1e-5 sigma) is the last
SETTLED_CHI2 = 1e-10


@dataclass(frozen=True)
class Linear:
    """A fit about its answer: p holds A3's turns (3) about `turns`, the zenith's moves (2) along `across`, and the
    columns.

    residual (K, 2) in rad with p = 0 for the columns, design (K, 2, n): its derivatives.  prior_sigma (n,).
    turns (3, 3): axes in S, two across the plumb line and it.  across (2, 3): axes in ITRS, across the zenith.
    """

    residual: np.ndarray
    design: np.ndarray
    prior_sigma: np.ndarray
    turns: np.ndarray
    across: np.ndarray


@dataclass(frozen=True, kw_only=True)
class PlumbLine:
    """a3 (3, 3) with covariance (3, 3) in rad2 about S's axes, and the zenith (3,) in ITRS with its sigma in rad.

    cost: half the robust chi-square.  scatter: chi-square per degree of freedom, 1 for frames of one zenith.
    left (K, 2): what the fit leaves of each frame's reading, in rad across the plumb line.
    response (m,), response_covariance (m, m): of the inclinometer's response.
    linear: the fit about its answer.
    astray (rad): sigma by which the zenith may be off together with A3's turn about a leaning axis; no heading shows it.
    """

    a3: np.ndarray
    covariance: np.ndarray
    zenith: np.ndarray
    zenith_sigma: float
    cost: float
    scatter: float
    left: np.ndarray
    response: np.ndarray
    response_covariance: np.ndarray
    linear: "Linear"
    astray: float = 0.0

    def stddev_across(self, plumb: np.ndarray) -> float:
        """Sigma in rad of the direction that A3 takes to `plumb` (3,), on the worse of two axes."""
        across = np.linalg.svd(plumb[None])[2][1:]
        return float(np.sqrt(np.linalg.eigvalsh(across @ self.covariance @ across.T)[-1]))


@dataclass(frozen=True)
class Known:
    """Prior knowledge of the fit: the zenith (3,) or None, its sigma, and the sigma of A3's turn, in rad."""

    zenith: np.ndarray | None = None
    zenith_sigma: float = np.inf
    turn_sigma: float = np.pi


def huber(off: np.ndarray) -> np.ndarray:
    """Square root of Huber's weight of residuals (..., K) in sigma: beyond a limit they pull no harder."""
    size = np.abs(off)
    # far from the answer all residuals are large and none is an outlier
    limit = np.maximum(ROBUST_SIGMA, 2 * np.median(size, axis=-1, keepdims=True))
    return np.sqrt(np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def robust(off: np.ndarray) -> np.ndarray:
    """Contribution of each residual (in sigma) to the robust chi-square."""
    size = np.abs(off)
    return np.where(size > ROBUST_SIGMA, ROBUST_SIGMA * (2 * size - ROBUST_SIGMA), size**2)


def symmetric(covariance: np.ndarray) -> np.ndarray:
    """The symmetric part of a covariance (n, n)."""
    return (covariance + covariance.T) / 2


@dataclass(frozen=True, kw_only=True)
class _Model:
    """What all starts of a fit share, and what each begins with.

    turns (3, 3): axes in S, two across the plumb line and it.  columns (K, 2, M): as Readings', across the plumb line.
    prior_sigma (n,): of A3's turns (3), the zenith's moves (2) and the columns (M).
    zenith (T, 3), across (T, 2, 3): of each start, in ITRS.  seen_across (T, 2, K, 3): `across` in the camera.
    """

    readings: Readings
    spread: np.ndarray
    turns: np.ndarray
    columns: np.ndarray
    prior_sigma: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    seen_across: np.ndarray

    @classmethod
    def of(cls, readings: Readings, starts: np.ndarray, known: Known) -> "_Model":
        to_camera, mean = readings.to_camera, readings.mean_plumb
        if known.zenith is None:
            zenith = np.einsum("kji,tlj,kl->ti", to_camera, starts, readings.plumb)
        else:
            zenith = np.tile(known.zenith, (len(starts), 1))
        zenith = rotation.normalised(zenith)
        across = np.linalg.svd(zenith[:, None])[2][:, 1:]
        turns = np.vstack([np.linalg.svd(mean[None])[2][1:], mean]).T
        loose = UNKNOWN_ARCSEC[0] * ARCSEC
        zenith_sigma = min(known.zenith_sigma, np.pi)
        return cls(
            readings=readings,
            spread=readings.spread,
            turns=turns,
            columns=-np.einsum("kim,ij->kjm", readings.columns, turns[:, :2]),
            prior_sigma=np.array(
                [loose, loose, known.turn_sigma, zenith_sigma, zenith_sigma, *readings.column_sigma]
            ),
            zenith=zenith,
            across=across,
            seen_across=np.einsum("kij,tdj->tdki", to_camera, across),
        )


@dataclass(frozen=True, kw_only=True)
class _State:
    """Where T fits stand: a3 (T, 3, 3), up (T, 3) of any length, p (T, n) as in Linear, start (T,): its number."""

    a3: np.ndarray
    up: np.ndarray
    p: np.ndarray
    start: np.ndarray

    def take(self, rows: np.ndarray) -> "_State":
        return _State(a3=self.a3[rows], up=self.up[rows], p=self.p[rows], start=self.start[rows])


@dataclass(frozen=True, kw_only=True)
class _Slopes:
    """A linearisation at T states, and what it costs.

    residual (T, K, 2) in rad without the columns, slope (T, K, 2, n), off (T, K, 2) in sigma, cost (T,).
    """

    residual: np.ndarray
    slope: np.ndarray
    off: np.ndarray
    cost: np.ndarray


def fits(
    readings: Readings, starts: np.ndarray, known: Known, turned: np.ndarray | float = 0.0
) -> list[PlumbLine]:
    """Fit A3, the zenith and the errors of the inclinometer by robust Gauss-Newton, from each of T starts.

    starts (T, 3, 3): the given A3, turned by `turned` (T,) rad about the plumb line.  The residuals compare
    the readings with the plumb line of the stars, whose error is small compared with theirs.  The prior of A3's tilts is
    UNKNOWN_ARCSEC.
    """
    model = _Model.of(readings, starts, known)
    p = np.zeros((len(starts), len(model.prior_sigma)))
    p[:, 2] = turned
    now = _State(a3=starts, up=model.zenith, p=p, start=np.arange(len(starts)))
    best = np.full(len(starts), np.inf)
    answer = _State(a3=starts.copy(), up=model.zenith.copy(), p=p.copy(), start=now.start)
    for _ in range(MAX_STEPS):
        slopes = _slopes(model, now)
        # if the headings hardly differ, later steps may lead away again
        better = slopes.cost < best[now.start]
        rows = now.start[better]
        best[rows] = slopes.cost[better]
        answer.a3[rows], answer.up[rows], answer.p[rows] = now.a3[better], now.up[better], now.p[better]
        step, gain = _step(model, slopes, now.p)
        now = _stepped(model, now, step).take(gain >= SETTLED_CHI2)
        if not len(now.start):
            break
    slopes = _slopes(model, answer)
    return [_plumb_line(model, answer, slopes, t) for t in range(len(starts))]


def _slopes(model: _Model, now: _State) -> _Slopes:
    """Residuals and their derivatives at T states."""
    plumb, flat = model.readings.plumb, model.turns[:, :2]
    count, frames, n = len(now.start), len(plumb), len(model.prior_sigma)
    length = np.linalg.norm(now.up, axis=1)
    seen = np.tensordot(now.up / length[:, None], model.readings.to_camera, (1, 2))
    read = seen @ now.a3.swapaxes(1, 2)
    residual = (plumb - read) @ flat
    slope = np.empty((count, frames, 2, n))
    # a turn about an axis moves the reading by axis x reading
    slope[..., :3] = np.tensordot(read, np.cross(model.turns.T, flat.T[:, None]), (2, 2))
    moved = model.seen_across[now.start].reshape(count, 2 * frames, 3) @ (now.a3.swapaxes(1, 2) @ flat)
    slope[..., 3:5] = -moved.reshape(count, 2, frames, 2).transpose(0, 2, 3, 1) / length[:, None, None, None]
    slope[..., 5:] = model.columns
    off = (residual + np.tensordot(now.p[:, 5:], model.columns, (1, 2))) / model.spread[:, None]
    prior = np.sum((now.p / model.prior_sigma) ** 2, axis=1)
    cost = (robust(off).sum((1, 2)) + prior) / 2
    return _Slopes(residual=residual, slope=slope, off=off, cost=cost)


def _design(model: _Model, slopes: _Slopes) -> tuple[np.ndarray, np.ndarray]:
    """Weighted design (T, 2 K, n) in units of the prior, and weighted residuals (T, 2 K) in sigma."""
    off = slopes.off.reshape(len(slopes.off), -1)
    weight = huber(off)
    # the prior's own units keep the loose and the tight of one size
    scaled = slopes.slope.reshape(*off.shape, -1) * model.prior_sigma
    return scaled * (weight / np.repeat(model.spread, 2))[..., None], off * weight


def _step(model: _Model, slopes: _Slopes, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton steps (T, n), none longer than LONGEST_STEP, and how much (T,) a whole one would lower chi-square."""
    design, off = _design(model, slopes)
    transposed = design.swapaxes(1, 2)
    pull = (transposed @ off[..., None])[..., 0] + p / model.prior_sigma
    normal = transposed @ design + np.eye(design.shape[2])
    moved = np.linalg.solve(normal, pull[..., None])[..., 0]
    step = -model.prior_sigma * moved
    longest = np.linalg.norm(step[:, :5], axis=1, keepdims=True)
    return step * LONGEST_STEP / np.maximum(longest, LONGEST_STEP), np.sum(moved * pull, axis=1)


def _stepped(model: _Model, now: _State, step: np.ndarray) -> _State:
    turned = np.array([rotation.from_vector(model.turns @ s) for s in step[:, :3]]) @ now.a3
    p = now.p + step
    moved = np.einsum("td,tdi->ti", p[:, 3:5], model.across[now.start])
    return _State(a3=turned, up=model.zenith[now.start] + moved, p=p, start=now.start)


def _plumb_line(model: _Model, answer: _State, slopes: _Slopes, t: int) -> PlumbLine:
    """The answer from start t."""
    readings, turns, prior_sigma, p = model.readings, model.turns, model.prior_sigma, answer.p[t]
    scaled = _design(model, slopes)[0][t]
    normal = scaled.T @ scaled + np.eye(len(prior_sigma))
    whole = np.outer(prior_sigma, prior_sigma) * np.linalg.inv(normal)
    # without the turn about the plumb line, which may be as good as unknown
    told = np.delete(np.arange(len(prior_sigma)), 2)
    given_turn = np.outer(prior_sigma[told], prior_sigma[told]) * np.linalg.inv(normal[np.ix_(told, told)])
    response = slice(5 + readings.response.start, 5 + readings.response.stop)
    cost = float(slopes.cost[t])
    return PlumbLine(
        a3=answer.a3[t],
        covariance=symmetric(turns @ whole[:3, :3] @ turns.T),
        zenith=rotation.normalised(answer.up[t]),
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(given_turn[2:4, 2:4])[-1])),
        cost=cost,
        scatter=2 * cost / max(2 * len(model.spread) - 5, 1),
        left=slopes.residual[t] + model.columns @ p[5:],
        response=p[response],
        response_covariance=symmetric(whole[response, response]),
        linear=Linear(slopes.residual[t], slopes.slope[t], prior_sigma, turns, model.across[t]),
    )
