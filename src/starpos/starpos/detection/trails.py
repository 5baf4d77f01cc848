# SPDX-License-Identifier: Apache-2.0
"""Trails of satellites on a frame: straight lines of light that its stars do not explain, and both ends of each.

Sums along lines of all directions and of lengths 8, 16, 32, ... cells find them: Goetz and Druckmueller's fast Radon
transform, as Nir et al. (2018, AJ 156, 229) use it for streaks. A fit of an evenly moving point measures them.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage, optimize, special

from starpos.detection.background import SkyPlane, between, measure_sky, plane_of
from starpos.detection.pipeline import DetectionSettings
from starpos.detection.second_look import FWHM_PER_SIGMA, negative_of
from starpos.frames.frame import Frame, FrameTrail, Stars

# Sums along lines, and the whole light of a trail, exceed their noise by this factor: 1e7 lines are tried.
THRESHOLD = 7.0
# Cells along the shortest and the longest sum; maximum light of a cell over its noise, so that a star is no line.
SHORTEST, LONGEST, CLIP = 8, 128, 4.0
# Columns of which only the best line is looked at; maximum number of lines that turn out to be no trails.
TILE, MAX_FAILED = 8, 8
# Width of stars (px, FWHM) where it is unknown; half the width of the fitted band, in sigma of the PSF.
USUAL_FWHM, BAND = 2.5, 4.0
# Shortest trail in sigma of the PSF: a shorter one is a star.
SHORTEST_SIGMAS = 8.0
# 1 sigma of the PSF's width over the stars' (their images are trailed), and limit of its factor.
WIDTH_SHARE, WIDEST = 0.2, 1.7
# 1 sigma of the sag of a trail by the lens: this times its length squared over the frame's diagonal.
SAG = 0.05
# Light of a knot over the strongest: less, and the object flashes, so that its ends are not the exposure's.
FAINTEST = 0.35
# Maximum deviation (rms, share of the light) of a steady trail's light along it.
UNSTEADY = 0.3
# Chi-square of its pieces' light from which a trail's light does not change evenly, and number of knots it has then.
UNEVEN, MAX_KNOTS = 3.0, 12
# Over their noise: pixels farther from the model are a star's.
OUTLIER = 5.0
# Median of a column or row, over its noise times the square root of its pixels, from which it differs from the others.
STRIPE = 5.0
# Maximum share of the frame that is left out for its stars, the brightest first.
MOST_HIDDEN = 0.15
# Steps of the slopes (px; of a logarithm); maximum number of steps of a fit.
STEPS, MAX_STEPS = (0.01, 0.01, 0.01, 0.01, 0.01, 0.01), 40
# A star hides at most so much of a trail to either side of its end, px.
HIDDEN_PX = 30
# px, 1 sigma: what the model of an image does not describe.
MODEL_PX = 0.02


def find_trails(
    frame: Frame, stars: Stars, x: np.ndarray, y: np.ndarray, flux: np.ndarray
) -> tuple[FrameTrail, ...]:
    """The trails on a frame, brightest first.

    stars: detected on it.  x, y (N,) px, flux (N,) as theirs: of the stars that are known to be there, whose light is no
    trail's.
    """
    plane, mosaic = plane_of(negative_of(frame) if stars.negative else frame)
    if min(plane.shape) < 2 * SHORTEST:
        return ()
    sky = measure_sky(plane, DetectionSettings().mesh_px, mosaic)
    sigma = (stars.fwhm_px or USUAL_FWHM) / FWHM_PER_SIGMA
    light = _light_of(sky, x, y, flux, sigma)
    found: list[FrameTrail] = []
    bin_px = max(1, round(2 * sigma))
    cells = _cells_of(light, bin_px)
    failed = 0
    for line in _lines(cells):
        _blot(cells, line, 1.5)
        trail = _measured(light, (line + 0.5) * bin_px - 0.5, sigma)
        if trail is None:
            failed += 1
            if failed == MAX_FAILED:
                break
        else:
            found.append(trail)
            _blot(cells, (trail.ends + 0.5) / bin_px - 0.5, 2 * BAND * sigma / bin_px)
            _blot(light, trail.ends, BAND * sigma, np.nan)
    return tuple(sorted(found, key=lambda trail: -trail.snr))


def _light_of(sky: SkyPlane, x: np.ndarray, y: np.ndarray, flux: np.ndarray, sigma: float) -> np.ndarray:
    """The plane (h, w) float32 above the sky, in sigma of its noise; NaN where it is saturated, or a star's."""
    light = sky.plane.astype(np.float32)
    height, width = light.shape
    step = 2 if sky.is_mosaic else 1
    for phase in range(len(sky.level)):
        part = np.s_[phase // 2 :: step, phase % 2 :: step]
        row, column = sky.cell(np.arange(width)[part[1]], np.arange(height)[part[0]])
        # the other way about, so that what lies in a row lies together
        level, noise = (
            between(mesh[phase].T.astype(np.float32), column, row).T for mesh in (sky.level, sky.noise)
        )
        light[part] = (light[part] - level) / noise
    # columns and rows of the sensor that differ a little are no trails
    for axis, some in ((0, light[::4]), (1, light[:, ::4])):
        middle = np.median(some, axis=axis, keepdims=True)
        light -= np.where(np.abs(middle) > STRIPE / math.sqrt(some.shape[axis]), middle, 0)
    hidden = sky.plane == np.iinfo(sky.plane.dtype).max
    # out to where a Gaussian, half as wide again as the stars' for its wings, is lost in the noise
    peak = flux / (2 * np.pi * sigma**2 * max(sky.typical[1], 1e-9))
    radius = 1.5 * sigma * np.sqrt(2 * np.log(np.maximum(2 * peak, 2.0)))
    on = (np.abs(2 * x - width) < width + 2 * radius) & (np.abs(2 * y - height) < height + 2 * radius)
    order = np.argsort(-flux * on)
    few = np.cumsum((np.pi * radius**2 * on)[order]) < MOST_HIDDEN * light.size
    seen = np.zeros(len(x), bool)
    seen[order[few]] = (on & (peak > 1.0))[order[few]]
    reach = np.ceil(radius).astype(int)
    for r in np.unique(reach[seen]):
        dy, dx = np.nonzero(np.hypot(*np.mgrid[-r : r + 1, -r : r + 1]) <= r)
        rows = np.rint(y[seen & (reach == r), None]).astype(int) + dy - r
        columns = np.rint(x[seen & (reach == r), None]).astype(int) + dx - r
        hidden[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)] = True
    light[hidden] = np.nan
    return light


def _cells_of(light: np.ndarray, bin_px: int) -> np.ndarray:
    """Sums of light over squares of bin_px px, in sigma of their noise, clipped; 0 for hidden pixels."""
    height, width = (n // bin_px * bin_px for n in light.shape)
    seen = light[:height, :width].copy()
    seen[np.isnan(seen)] = 0
    np.clip(seen, -2 * CLIP, 2 * CLIP, out=seen)
    cells = cv2.resize(seen, (width // bin_px, height // bin_px), interpolation=cv2.INTER_AREA) * bin_px
    return np.clip(cells, -CLIP, CLIP)


def _lines(cells: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the ends (2, 2) of lines x, y of cells with light, strongest first, as far as they are not blotted."""
    lines, scores = [np.zeros((0, 2, 2))], [np.zeros(0)]
    for turned in (False, True):
        for flipped in (False, True):
            seen = cells.T if turned else cells
            seen = seen[:, ::-1] if flipped else seen
            for ends, score in _sums(seen):
                if flipped:
                    ends[..., 0] = seen.shape[1] - 1 - ends[..., 0]
                lines.append(ends[..., ::-1] if turned else ends)
                scores.append(score)
    ends, score = np.concatenate(lines), np.concatenate(scores)
    for k in np.argsort(-score):
        steps = round(np.abs(ends[k, 1] - ends[k, 0]).max()) + 1
        x, y = np.rint(np.linspace(ends[k, 0], ends[k, 1], steps)).astype(int).T
        if cells[y, x].sum() > 0.7 * THRESHOLD * np.sqrt(steps):
            yield ends[k]


def _sums(cells: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield ends (n, 2, 2) and scores (n,) of lines that go down the cells, by at most 45 deg to the right."""
    height, width = cells.shape
    padded = np.zeros((-(-height // LONGEST) * LONGEST, width), np.float32)
    padded[:height] = cells
    sums, rows = padded[:, None], 1
    while rows < LONGEST and rows < height:
        upper, lower = sums[::2], sums[1::2]
        sums = np.repeat(upper, 2, axis=1)
        for step in range(2 * rows):
            shift = (step + 1) // 2
            if shift < width:
                sums[:, step, : width - shift] += lower[:, step // 2, shift:]
        rows *= 2
        if rows < SHORTEST:
            continue
        noise = 1.4826 * np.median(np.abs(sums[: max(1, height // rows), ::7, ::5]))
        strong = np.flatnonzero(sums > THRESHOLD * max(noise, 1e-6))
        block, aside, x = np.unravel_index(strong, sums.shape)
        score = sums[block, aside, x] / max(noise, 1e-6)
        order = np.argsort(-score)
        # of a tile only the best
        best = order[np.unique((block * width + x)[order] // TILE, return_index=True)[1]]
        first = np.stack([x, block * rows], -1)[best]
        last = np.minimum(
            first + np.stack([aside[best], np.full_like(best, rows - 1)], -1), [width - 1, height - 1]
        )
        yield np.stack([first, last], 1).astype(float), score[best]


def _blot(plane: np.ndarray, ends: np.ndarray, reach: float, value: float = 0.0) -> None:
    """Set what is within `reach` of the line between two ends (2, 2), x and y, to a value."""
    way = ends[1] - ends[0]
    low = np.clip(np.floor(ends.min(0) - reach), 0, None).astype(int)
    high = np.ceil(ends.max(0) + reach).astype(int) + 1
    part = plane[low[1] : high[1], low[0] : high[0]]
    y, x = np.mgrid[low[1] : low[1] + part.shape[0], low[0] : low[0] + part.shape[1]]
    dx, dy = x - ends[0, 0], y - ends[0, 1]
    along = np.clip((dx * way[0] + dy * way[1]) / max(way @ way, 1e-9), 0, 1)
    near = np.hypot(dx - along * way[0], dy - along * way[1]) <= reach
    part[near] = value


def _measured(light: np.ndarray, line: np.ndarray, sigma: float) -> FrameTrail | None:
    """The trail of which a line with ends (2, 2), x and y px, is a part; None without a trail there."""
    for _ in range(3):
        grown = _grown(light, line, sigma)
        if grown is None:
            return None
        line = grown
    if np.hypot(*(line[1] - line[0])) < SHORTEST_SIGMAS * sigma:
        return None
    return _fitted(light, line, sigma)


def _grown(light: np.ndarray, line: np.ndarray, sigma: float) -> np.ndarray | None:
    """The ends of the trail along a line, anew from its light; None without light."""
    (height, width), length = light.shape, np.hypot(*(line[1] - line[0]))
    way = (line[1] - line[0]) / length
    slope = np.where(np.abs(way) < 1e-9, 1e-9, way)
    walls = np.stack([-line[0] / slope, (np.array([width, height]) - 1 - line[0]) / slope])
    along = np.arange(np.ceil(walls.min(0).max()), walls.max(0).min())
    across = np.arange(-np.ceil(2 * BAND * sigma), np.ceil(2 * BAND * sigma) + 1)
    x = np.rint(line[0, 0] + along[:, None] * way[0] - across * way[1]).astype(int)
    y = np.rint(line[0, 1] + along[:, None] * way[1] + across * way[0]).astype(int)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    seen = np.where(inside, light[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)], np.nan)
    seen, known = np.nan_to_num(seen), np.isfinite(seen)
    on = (along > 0) & (along < length)
    # the offset of the line by its own light, then the light along it through the PSF
    steps = np.array(
        [np.sum(np.clip(seen, -CLIP, None)[on] * np.exp(-0.5 * ((across - d) / sigma) ** 2)) for d in across]
    )
    middle = across[steps[np.abs(across) <= BAND * sigma].argmax() + np.count_nonzero(across < -BAND * sigma)]
    weight = known * np.exp(-0.5 * ((across - middle) / sigma) ** 2)
    power = (weight**2).sum(1)
    level = (seen * weight).sum(1)
    if not power[on].sum() > 0:
        return None
    strength = level[on].sum() / power[on].sum()
    for _ in range(2):
        # the interval in which a trail of this strength explains most: the largest sum of log-likelihood ratios
        gain = np.clip(level * strength - power * strength**2 / 2, -20.0, 20.0)
        total = np.concatenate([[0.0], np.cumsum(gain)])
        lowest = np.minimum.accumulate(total)
        last = int((total - lowest).argmax())
        first = int(total[: last + 1].argmin())
        if last - first < 2 or not strength > 0:
            return None
        strength = level[first:last].sum() / max(power[first:last].sum(), 1e-9)
    if level[first:last].sum() < THRESHOLD * np.sqrt(power[first:last].sum()):
        return None
    # the direction, by the light's moments across in thirds of the trail
    near = np.abs(across - middle) <= BAND * sigma / 2
    part = np.clip(seen, 0, 3 * CLIP)[first:last] * near
    place, offset = along[first:last], across - middle
    moment, mass = (part * offset).sum(1), part.sum(1)
    centre = (place * mass).sum() / max(mass.sum(), 1e-9)
    tilt = ((place - centre) * moment).sum() / max(((place - centre) ** 2 * mass).sum(), 1e-9)
    shift = middle + moment.sum() / max(mass.sum(), 1e-9)
    s = np.array([along[first], along[last - 1]])
    return line[0] + s[:, None] * way + (shift + tilt * (s - centre))[:, None] * np.array([-way[1], way[0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Band:
    """The pixels (n,) around a trail that is about known: their light over the noise, and px along and aside of it.

    sigma: px, of the PSF.  sag: px, 1 sigma.
    """

    value: np.ndarray
    along: np.ndarray
    aside: np.ndarray
    sigma: float
    sag: float

    def image(self, p: np.ndarray, knots: int) -> np.ndarray:
        """Light (n, knots) of the trail for each of its knots, between which its light changes evenly.

        p (6,): both ends along the trail, then aside of it, logarithm of the PSF's width over sigma, sag.
        """
        first, last, left, right, wide, bend = p
        u = (self.along - first) / (last - first)
        inside = np.clip(u, 0, 1)
        far = self.aside - left - (right - left) * u - 4 * bend * inside * (1 - inside)
        s = self.sigma * np.exp(wide)
        lit = special.ndtr((self.along - first) / s) - special.ndtr((self.along - last) / s)
        lit *= np.exp(-0.5 * (far / s) ** 2)
        return lit[:, None] * np.clip(1 - np.abs(inside[:, None] * (knots - 1) - np.arange(knots)), 0, None)

    def fit(self, p: np.ndarray, knots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """p, the sky's level and the knots' light (6 + 1 + knots,), their covariance, the model (n,) and chi-square."""
        noise = np.ones(len(self.value))

        def residuals(q: np.ndarray) -> np.ndarray:
            model = self.image(q[:6], knots) @ q[7:] + q[6]
            return np.concatenate([(self.value - model) / noise, [q[4] / WIDTH_SHARE, q[5] / self.sag]])

        def slopes(q: np.ndarray) -> np.ndarray:
            jac = np.zeros((len(self.value) + 2, len(q)))
            base = self.image(q[:6], knots)
            for k, step in enumerate(STEPS):
                there = q[:6] + step * (np.arange(6) == k)
                jac[:-2, k] = (self.image(there, knots) - base) @ q[7:] / -step
            jac[:-2, 6], jac[:-2, 7:] = -1.0, -base
            jac[:-2] /= noise[:, None]
            jac[-2, 4], jac[-1, 5] = 1 / WIDTH_SHARE, 1 / self.sag
            return jac

        for _ in range(3):
            light = np.linalg.lstsq(self.image(p, knots), self.value, rcond=None)[0]
            start = np.concatenate([p, [0.0], light])
            best = optimize.least_squares(residuals, start, slopes, method="lm", max_nfev=MAX_STEPS)
            p, model = best.x[:6], self.image(best.x[:6], knots) @ best.x[7:]
            # the light's photons: what the residuals have beyond the sky's noise grows with it
            rest, known = self.value - model - best.x[6], np.isfinite(noise)
            excess = (known * (rest**2 - 1)) @ model / max(known @ model**2, 1e-9)
            noise = np.sqrt(1 + max(excess, 0.0) * np.clip(model, 0, None))
            # a star that the catalogue does not have
            noise[np.abs(rest) > OUTLIER * noise] = np.inf
        chi2 = 2 * best.cost / max(np.count_nonzero(known) - len(best.x), 1)
        return best.x, np.linalg.pinv(best.jac.T @ best.jac) * max(chi2, 1.0), model, chi2

    def unevenness(self, model: np.ndarray, p: np.ndarray) -> tuple[float, float]:
        """Scatter of the light along the trail about a model: as a share of it, without the noise, and over the noise."""
        pieces = max(int((p[1] - p[0]) / (BAND * self.sigma)), 1)
        piece = np.floor((self.along - p[0]) / (p[1] - p[0]) * pieces).astype(int)
        on = (piece >= 0) & (piece < pieces)
        power = np.bincount(piece[on], model[on] ** 2, pieces)
        kept = power > 4
        if not kept.any():
            return 0.0, 0.0
        power = power[kept]
        share = np.bincount(piece[on], (self.value * model)[on], pieces)[kept] / power - 1
        return math.sqrt(max(float(np.mean(share**2 - 1 / power)), 0.0)), float(np.mean(share**2 * power))


def _fitted(light: np.ndarray, line: np.ndarray, sigma: float) -> FrameTrail | None:
    """The trail near a line with ends (2, 2), x and y px, by a fit to its pixels; None if it is not like one."""
    height, width = light.shape
    reach = 1.5 * BAND * sigma
    low = np.clip(np.floor(line.min(0) - reach), 0, None).astype(int)
    high = np.ceil(line.max(0) + reach).astype(int) + 1
    part = light[low[1] : high[1], low[0] : high[0]]
    y, x = np.mgrid[low[1] : low[1] + part.shape[0], low[0] : low[0] + part.shape[1]]
    length = float(np.hypot(*(line[1] - line[0])))
    way = (line[1] - line[0]) / length
    turn = np.array([way, [-way[1], way[0]]])
    along, aside = np.einsum("ij,jyx->iyx", turn, np.stack([x - line[0, 0], y - line[0, 1]]))
    use = np.isfinite(part) & (np.abs(aside) < reach) & (along > -reach) & (along < length + reach)
    sag = SAG * length**2 / np.hypot(width, height)
    band = _Band(value=part[use].astype(float), along=along[use], aside=aside[use], sigma=sigma, sag=sag)
    knots = 2
    if np.count_nonzero(use) < 10 * SHORTEST_SIGMAS:
        return None
    best, covariance, model, _ = band.fit(np.array([0.0, length, 0.0, 0.0, 0.0, 0.0]), knots)
    rough, over_noise = band.unevenness(model, best)
    if over_noise > UNEVEN:
        knots = min(2 + int(length / (2 * BAND * sigma)), MAX_KNOTS)
        best, covariance, model, _ = band.fit(best[:6], knots)
        rough, _ = band.unevenness(model, best)
    first, last, left, right, wide, _ = best[:6]
    snr = float(band.value @ model / np.sqrt(max(model @ model, 1e-9)))
    inside = -reach < first < last - SHORTEST_SIGMAS * sigma < length + reach - SHORTEST_SIGMAS * sigma
    if not (snr > THRESHOLD and inside and abs(wide) < np.log(WIDEST)):
        return None
    ends = line[0] + np.array([[first, left], [last, right]]) @ turn
    order, both = [0, 2, 1, 3], np.kron(np.eye(2), turn.T)
    end_covariance = both @ covariance[np.ix_(order, order)] @ both.T + MODEL_PX**2 * np.eye(4)
    for k in (0, 1):
        end_covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += (
            _hidden_px(light, ends[k], way, sigma) ** 2 / 3 * np.outer(way, way)
        )
    edge = np.minimum(ends, np.array([width, height]) - 1 - ends).min(1)
    # a knot under a star is known badly
    base = band.image(best[:6], knots)
    least = best[7:] + 2 * np.sqrt(np.diag(np.linalg.pinv(base.T @ base)))
    # light that fades has no end
    sharp = covariance[[0, 1], [0, 1]].max() < (BAND * sigma) ** 2
    steady = bool(sharp and rough < UNSTEADY and (least > FAINTEST * best[7:].max()).all())
    if not steady and last - first < 4 * SHORTEST_SIGMAS * sigma:
        return None
    return FrameTrail(ends=ends, covariance=end_covariance, snr=snr, cut=edge < BAND * sigma, steady=steady)


def _hidden_px(light: np.ndarray, end: np.ndarray, way: np.ndarray, sigma: float) -> float:
    """How far from a trail's fitted end, px along it, the true one may be since a star hides it."""
    along = np.arange(-HIDDEN_PX, HIDDEN_PX + 1)
    x, y = np.rint(end[:, None] + way[:, None] * along).astype(int)
    x, y = np.clip(x, 0, light.shape[1] - 1), np.clip(y, 0, light.shape[0] - 1)
    runs, _ = ndimage.label(np.isnan(light[y, x]))
    near = np.setdiff1d(runs[np.abs(along) <= 1.5 * sigma], 0)
    return float(np.abs(along[np.isin(runs, near)]).max(initial=0.0))
