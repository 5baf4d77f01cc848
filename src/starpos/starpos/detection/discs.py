# SPDX-License-Identifier: Apache-2.0
"""The Sun on a frame: a disc whose limb is fitted, as behind a filter, or the middle of a saturated glow.

Its altitude and size decide whether it is the Sun or a lamp: `starpos.fix.sun` compares them.
"""

from dataclasses import replace

import cv2
import numpy as np

from starpos.detection._sky import median
from starpos.detection.saturated import round_shape
from starpos.frames.frame import Disc

# Frames are searched at steps of their shorter side over this, px, or of 2. Minimum radius, px, and number of bright
# groups that are tried.
COARSE, LEAST_PX, TRIED = 800, 4.0, 4
# The dark part of a frame is at this quantile of some rows and columns; a disc is higher by this share of the top,
# and that many sigma.
SOME, DARK, CONTRAST, CLEAR = 80, 0.2, 0.3, 20.0
# Directions from a bright group's middle, in each of which its edge is looked for.
RAYS = 360
# Minimum slope of an edge, as a share of the disc's height a px, and of the steepest of its direction.
STEEP, OUTERMOST = 0.03, 0.5
# Circles through three edge points that are tried; an edge point belongs to a circle within px, or a share of its radius.
CIRCLES, NEAR_PX, NEAR_SHARE = 400, 0.8, 0.015
# Minimum share of all directions in which the limb is seen; maximum share of edge points beyond it.
SEEN, BEYOND = 0.36, 0.05
# A limb is sharp if the light falls to this share within px, or a share of the radius, of it, in most directions.
FALLEN, WITHIN_PX, WITHIN, MOST = 0.25, 3.0, 0.12, 0.8
# Distance, px, within which errors of a limb's points are alike; its least error, px, and as a share of the radius.
ALIKE_PX, FLOOR_PX, FLOOR_SHARE = 3.0, 0.03, 0.001
# What a cloud's soft end pulls the circle by, as a share of its radius, if it hid the whole limb. Px over the radius, px,
# that a cloud pulls the circle of a small disc by, whose limb is hardly rounder than the cloud's edge.
HIDDEN, SMALL, ROUNDS = 0.012, 1.5, 6
# A glow: shares of its height at which its middle is measured, the first of what is saturated; what share of it is.
HEIGHTS, SATURATED_SHARE = (0.97, 0.9, 0.8), 0.3
# Maximum size of a second bright group, as a share of the glow's. Squared ratio of its axes, share of an ellipse's area,
# and how far the middles may differ, in its radius.
ALONE, LONGEST, FULLEST, CONCENTRIC = 0.6, 1.8, 0.85, 0.3
# A glow falls off: it is wider at its lowest height by this factor than at its highest, as a bright window is not.
HALO = 1.05
# Minimum height of a glow above the sky around it, as a share of its brightness.
GLOW_CONTRAST = 0.06
# A Moon by day is narrower than the frame's shorter side over this, farther from the Sun than this times its radius, and
# stands out by this many sigma.
MOON_SHARE, AWAY, FAINT = 10, 3.0, 8.0
# The middle of a glow is known to this share of its radius: flare and blooming pull it.
OFF_CENTRE = 0.03


def find_disc(plane: np.ndarray) -> Disc | None:
    """The Sun on a plane (h, w), or what looks like it; None without."""
    step = max(2, min(plane.shape) // COARSE)
    if min(plane.shape) < 16 * step:
        return None
    # what is narrower than three of these pixels, as stars and hot pixels are, leaves nothing
    wide = np.ascontiguousarray(plane[::step, ::step])
    cv2.erode(wide, np.ones((3, 3), np.uint8), dst=wide)
    every = max(1, min(wide.shape) // SOME)
    some = wide[::every, ::every].astype(float)
    dark, top = float(np.sort(some, axis=None)[int(DARK * (some.size - 1))]), float(wide.max())
    noise = median(np.abs(some[:, 1:] - some[:, :-1]).ravel()) + 1.0
    height = top - dark
    if height < max(CONTRAST * top, CLEAR * noise):
        return None
    groups = _groups(wide, dark + 0.5 * height, step)
    for middle, extent in groups:
        if (disc := _limb(plane, middle, extent, dark, height)) is not None:
            break
    else:
        disc = _alone(plane, groups, dark, height)
        if disc is None:
            # in a bright sky the Sun's glow is no group of its own, but what is saturated is
            disc = _alone(plane, _groups(wide, dark + HEIGHTS[0] * height, step), dark, height)
    return None if disc is None else replace(disc, other=_fainter(plane, step, disc))


def _fainter(plane: np.ndarray, step: int, first: Disc) -> Disc | None:
    """The Moon by day: a second, fainter disc with a limb, far from the first; None without."""
    small = cv2.medianBlur(np.ascontiguousarray(plane[::step, ::step]), 3)
    wide = 2 * (min(small.shape) // MOON_SHARE) + 1
    # what is narrower than the Moon at its widest, on the sky's own light
    above = cv2.morphologyEx(small, cv2.MORPH_TOPHAT, np.ones((wide, wide), np.uint8)).astype(np.float32)
    noise = float(np.median(np.abs(np.diff(above[::4, ::4], axis=1)))) + 1.0
    rows, columns = np.mgrid[: small.shape[0], : small.shape[1]]
    above[
        np.hypot(columns - first.x / step, rows - first.y / step) < AWAY * first.radius_px / step + wide
    ] = 0
    if (height := float(above.max())) < FAINT * noise:
        return None
    for middle, extent in _groups(cv2.erode(above, np.ones((3, 3), np.uint8)), 0.5 * height, step):
        around = small[tuple(slice(max(0, int(v / step - wide)), int(v / step + wide)) for v in middle[::-1])]
        sky = float(np.median(around))
        disc = _limb(plane, middle, extent, sky, height)
        if disc is not None:
            return disc
    return None


def _groups(wide: np.ndarray, level: float, step: int) -> list[tuple[np.ndarray, float]]:
    """Middles (2,) px and extents, px, of the largest groups of pixels above a level, of a plane reduced by a step."""
    bright = (wide > wide.dtype.type(level)).view(np.uint8)
    outlines, _ = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    groups = []
    for left, top_row, width, rows in map(cv2.boundingRect, sorted(outlines, key=len, reverse=True)[:TRIED]):
        middle = np.array([left + (width - 1) / 2, top_row + (rows - 1) / 2])
        groups.append((middle * step, float((max(width, rows) + 2) * step)))
    return groups


def _alone(
    plane: np.ndarray, groups: list[tuple[np.ndarray, float]], dark: float, height: float
) -> Disc | None:
    """The glow of the largest group; None if another is as large: nothing says which is the Sun."""
    if not groups or (len(groups) > 1 and groups[1][1] > ALONE * groups[0][1]):
        return None
    return _glow(plane, *groups[0], dark, height)


def _limb(plane: np.ndarray, middle: np.ndarray, extent: float, dark: float, height: float) -> Disc | None:
    """The disc of a bright group by its limb; None if it has none."""
    step = max(0.5, extent / 200)
    radii = np.arange(0, 0.9 * extent + 8, step)
    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    x, y = (middle[k] + radii * f(angle)[:, None] for k, f in enumerate((np.cos, np.sin)))
    light = (_sampled(plane, x, y, step) - dark) / height
    fall = np.full(light.shape, -np.inf)
    fall[:, 1:-1] = (light[:, :-2] - light[:, 2:]) / (2 * step)
    fall[~np.isfinite(fall)] = -np.inf
    steepest = fall.max(1)
    strong = fall >= np.maximum(OUTERMOST * steepest, STEEP / step)[:, None]
    rows = np.flatnonzero(strong.any(1))
    if len(rows) < SEEN * RAYS / 2:
        return None
    last = strong.shape[1] - 1 - strong[rows, ::-1].argmax(1)
    # the steepest place of that edge
    back = np.arange(-4, 1)
    near = np.clip(last[:, None] + back, 1, strong.shape[1] - 2)
    best = near[np.arange(len(rows)), fall[rows[:, None], near].argmax(1)]
    a, b, c = (fall[rows, best + k] for k in (-1, 0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        shift = np.nan_to_num(np.clip(0.5 * (a - c) / (a - 2 * b + c), -0.5, 0.5))
    along = (best + shift) * step
    points = middle + along[:, None] * np.stack([np.cos(angle[rows]), np.sin(angle[rows])], -1)
    return _circle(plane, points, extent, dark)


def _circle(plane: np.ndarray, points: np.ndarray, extent: float, dark: float) -> Disc | None:
    """The circle on which most of the edge's points (n, 2) lie, if it is a disc's limb."""
    number = len(points)
    three = points[np.random.default_rng(0).integers(0, number, (CIRCLES, 3))]
    base = three[:, 0]
    sides = three[:, 1:] - base[:, None]
    squares = (sides**2).sum(-1)
    twice = 2 * (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    sound = np.abs(twice) > 1e-3 * extent
    base, sides, squares, twice = base[sound], sides[sound], squares[sound], twice[sound]
    across = np.stack(
        [
            sides[:, 1, 1] * squares[:, 0] - sides[:, 0, 1] * squares[:, 1],
            sides[:, 0, 0] * squares[:, 1] - sides[:, 1, 0] * squares[:, 0],
        ],
        -1,
    )
    centres = base + across / twice[:, None]
    radii = np.linalg.norm(across / twice[:, None], axis=1)
    fit = (radii >= LEAST_PX) & (radii < 1.2 * extent)
    if not fit.any():
        return None
    off = np.linalg.norm(points - centres[fit, None], axis=2) - radii[fit, None]
    near = np.abs(off) < np.maximum(NEAR_PX, NEAR_SHARE * radii[fit, None])
    best = near.sum(1).argmax()
    keep, circle = near[best], np.append(centres[fit][best], radii[fit][best])
    for _ in range(ROUNDS):
        apart = points - circle[:2]
        distance = np.linalg.norm(apart, axis=1)
        slope = np.column_stack([apart / distance[:, None], np.ones(number)])
        residual = distance - circle[2]
        keep = np.abs(residual) < max(NEAR_PX, NEAR_SHARE * circle[2])
        if keep.sum() < SEEN * RAYS / 2:
            return None
        circle = circle + np.linalg.lstsq(slope[keep], residual[keep], rcond=None)[0]
    radius = float(circle[2])
    apart = points[keep] - circle[:2]
    seen = np.unique((np.arctan2(apart[:, 1], apart[:, 0]) * 18 / np.pi).astype(int) // 1)
    beyond = residual > 2 * max(NEAR_PX, NEAR_SHARE * radius)
    if radius < LEAST_PX or len(seen) < SEEN * 36 or beyond.mean() > BEYOND:
        return None
    away, step = max(WITHIN_PX, WITHIN * radius), max(0.5, radius / 100)
    unit = apart / np.linalg.norm(apart, axis=1)[:, None]
    rims = (circle[:2] + r * unit for r in (radius - away, radius + away))
    inside, outside = (_sampled(plane, rim[:, :1], rim[:, 1:], step)[:, 0] - dark for rim in rims)
    if (outside < FALLEN * inside).mean() < MOST:
        return None
    # points along the limb are as independent as they are far apart
    rms2 = float(np.mean(residual[keep] ** 2)) + FLOOR_PX**2
    arc = len(seen) / 36 * 2 * np.pi * radius
    alike = max(1.0, keep.sum() * ALIKE_PX / max(arc, ALIKE_PX))
    covariance = np.linalg.inv(slope[keep].T @ slope[keep])[:2, :2] * rms2 * alike
    hidden = HIDDEN * (1 - len(seen) / 36) * radius
    covariance += np.eye(2) * (FLOOR_PX**2 + (FLOOR_SHARE * radius) ** 2 + hidden**2 + (SMALL / radius) ** 2)
    return Disc(x=float(circle[0]), y=float(circle[1]), covariance=covariance, radius_px=radius, sharp=True)


def _sampled(plane: np.ndarray, x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """The light at places x, y (n, m) px, smoothed over a step; NaN outside of the plane."""
    left, top = max(int(x.min()) - 8, 0), max(int(y.min()) - 8, 0)
    raw = plane[top : max(int(y.max()) + 9, 0), left : max(int(x.max()) + 9, 0)].astype(np.float32)
    if not raw.size:
        return np.full(x.shape, np.nan)
    part = cv2.GaussianBlur(raw, (0, 0), max(0.7, step))
    places = (x - left).astype(np.float32), (y - top).astype(np.float32)
    light = np.asarray(cv2.remap(part, *places, cv2.INTER_LINEAR), float)
    rows, columns = plane.shape
    light[(x < 1) | (y < 1) | (x > columns - 2) | (y > rows - 2)] = np.nan
    return light


def _glow(plane: np.ndarray, middle: np.ndarray, extent: float, dark: float, height: float) -> Disc | None:
    """The middle of a bright group that is a saturated glow; None if it is not round, or not like that at all heights."""
    left, top = (max(0, int(v - 2 * extent)) for v in middle)
    part = plane[top : int(middle[1] + 2 * extent) + 1, left : int(middle[0] + 2 * extent) + 1]
    rim = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
    floor, peak = float(np.median(rim)), dark + height
    if peak - floor < GLOW_CONTRAST * peak:
        return None
    found = []
    for share in HEIGHTS:
        mask = (part > floor + share * (peak - floor)).astype(np.uint8)
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outline = max(outlines, key=cv2.contourArea, default=None)
        if outline is None or len(outline) < 8:
            return None
        x0, y0, width, length = cv2.boundingRect(outline)
        if not (x0 > 0 and y0 > 0 and x0 + width < part.shape[1] and y0 + length < part.shape[0]):
            return None
        if (one := round_shape(outline, LONGEST, FULLEST)) is None:
            return None
        found.append(one)
    x, y, radii = np.array(found).T + np.array([[left], [top], [0]])
    radius = float(radii[0])
    if radii[-1] < HALO * radius:
        return None
    off = np.hypot(x - x[0], y - y[0])
    if (
        radius < LEAST_PX
        or radii[0] ** 2 < SATURATED_SHARE * radii[-1] ** 2
        or off.max() > CONCENTRIC * radius
    ):
        return None
    variance = (OFF_CENTRE * radius) ** 2 + float(off.max() ** 2) / 4
    return Disc(x=float(x[0]), y=float(y[0]), covariance=np.eye(2) * variance, radius_px=radius, sharp=False)
