# SPDX-License-Identifier: Apache-2.0
"""Identify the stars of a fisheye, whose field no plane can hold.

A part of the field is taken as a pinhole would see it, first the middle, then others in case that is covered, and
identified like any frame. Then all stars are matched, with the lens itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.frozen import at_once
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import (
    BENT_PX,
    BLEND_PX,
    EDGE_PX,
    FAINTEST_FIT,
    FLOOR_PX,
    GATE_PX,
    GATE_SIGMA,
    INSIDE_PX,
    MIN_LOG_ODDS,
    MIN_SPREAD_PX,
    MIN_STARS,
    Identification,
    OnFrame,
)
from starpos.identification.pose import Pose, close_pairs, mutual_nearest, stars_at
from starpos.identification.prior import AimPrior, PlumbPrior, PointingPrior
from starpos.identification.sky import Sky
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.sky.catalogue import Catalogue, rows_near
from starpos.units import SIGMA_PER_MAD

# A fisheye whose corners are farther off the middle than this is worked by parts.
WIDE_RAD = math.radians(25)
# Half the sides of a part; how far off the axis the middles of the other parts lie, and in how many directions.
HALF_RAD, OFF_RAD, AROUND = math.radians(30), math.radians(45), 4
# Rounds of matching; step of a fit's numerical derivatives (rad, and shares).
ROUNDS, STEP = 6, 1e-6
# Most steps of a fit, and the step that ends it: of the pose alone, and with the lens.
POSE_STEPS, LENS_STEPS = (8, 1e-10), (3, 1e-6)
# Prior of an unknown lens, 1 sigma: the position of the axis in focal lengths (x, y), k1 and k2.
LENS_PRIOR = np.array([0.08, 0.08, 0.06, 0.02])
# Radius about the part's middle in which stars are matched first, its growth in each round, number of final rounds.
FIRST_RAD, NEXT_RAD, LAST_ROUNDS = math.radians(32), math.radians(15), 2
# Maximum distance of a star from its predicted place (focal lengths), in addition to the residuals' spread.
GATE_RAD, MIN_LENS_SPREAD_PX = 0.004, 0.2
# Stars beyond the part bear it out if chance makes as many pairs as seldom as this (logarithm).
LOG_CHANCE_PAIRS = math.log(1e-6)
# A coordinate where no star is.
FAR_PX = -1e7
# The rows of a mirrored frame run bottom-up.
FLIP = np.diag([1.0, -1.0, 1.0])


def is_wide(camera: Camera) -> bool:
    """Whether the frames of a camera are worked by parts."""
    return camera.model == EQUIDISTANT and camera.half_diagonal_rad > WIDE_RAD


def field_rad(camera: Camera) -> float:
    """Half the diagonal, rad, of what is identified at once: of the frame, or of a part of it."""
    return pinhole_of(camera).half_diagonal_rad if is_wide(camera) else camera.half_diagonal_rad


@at_once
@dataclass(frozen=True)
class WideField:
    """N stars of a fisheye's frame, brightest first.

    directions  (N, 3) in C
    sigma_px    (N,): their errors along one axis
    """

    directions: np.ndarray
    sigma_px: np.ndarray
    camera: Camera


@at_once
@dataclass(frozen=True)
class Part:
    """The stars of a part of a frame, as an ideal camera that looks there sees them.

    whole  all of the frame
    turn   (3, 3): C into that camera
    row    (n,): which of the frame's stars they are
    field  the stars on that camera's frame
    """

    whole: WideField
    turn: np.ndarray
    row: np.ndarray
    field: FrameStars

    def turned(
        self, priors: Sequence[PointingPrior | PlumbPrior | AimPrior]
    ) -> tuple[PointingPrior | PlumbPrior, ...]:
        """Priors of the frame, turned into this part, without those that a fisheye does not have."""
        return tuple(
            replace(p, attitude=self.turn @ p.attitude)
            if isinstance(p, PointingPrior)
            else replace(p, zenith_camera=self.turn @ p.zenith_camera)
            for p in priors
            if not isinstance(p, AimPrior)
        )


def parts(field: WideField) -> list[Part]:
    """The parts of a frame: first its middle."""
    pinhole = pinhole_of(field.camera)
    return [part_at(field, pinhole, turn) for turn in _turns(field.camera, pinhole)]


def part_at(field: WideField, pinhole: Camera, turn: np.ndarray, shrink: float = 1.0) -> Part:
    """The part that an ideal camera sees into which a rotation (3, 3) takes C; its pixels are `shrink` times as large."""
    seen = field.directions @ turn.T
    xy = pinhole.project(seen)
    with np.errstate(invalid="ignore"):
        row = np.flatnonzero(((xy >= 0) & (xy <= [pinhole.width - 1, pinhole.height - 1])).all(1))
    # a pinhole's picture is stretched away from its middle
    sigma_px = field.sigma_px[row] / shrink / seen[row, 2] ** 2
    return Part(field, turn, row, stars_at(pinhole, xy[row], sigma_px))


def pinhole_of(camera: Camera) -> Camera:
    """The ideal camera of a part: as wide as the frame, but at most HALF_RAD to each side."""
    across = np.minimum(
        [camera.cx, camera.cy], np.array([camera.width, camera.height]) - 1 - [camera.cx, camera.cy]
    )
    half = np.minimum(np.maximum(across, 1) / [camera.fx, camera.fy], HALF_RAD)
    width, height = (2 * max(1, round(camera.fx * math.tan(angle))) for angle in half)
    return Camera.from_focal(width, height, camera.fx)


def _turns(camera: Camera, pinhole: Camera) -> list[np.ndarray]:
    """Rotations (3, 3) of C into the cameras of the parts: all but the first lie wholly on the frame."""
    turns = [np.eye(3)]
    x, y = np.meshgrid(np.linspace(0, pinhole.width - 1, 5), np.linspace(0, pinhole.height - 1, 5))
    grid = pinhole.directions(x.ravel(), y.ravel())
    for angle in 2 * np.pi * np.arange(AROUND) / AROUND:
        turn = rotation.from_vector(OFF_RAD * np.array([math.cos(angle), math.sin(angle), 0.0]))
        xy = camera.project(grid @ turn)
        if ((xy >= 0) & (xy <= [camera.width - 1, camera.height - 1])).all():
            turns.append(turn)
    return turns


def enough(part_count: int) -> float:
    """Log-odds that one of `part_count` parts needs, so that all together are as safe as a frame."""
    return float(MIN_LOG_ODDS) + math.log(part_count)


def part_of(field: WideField, sky: Sky, found: Identification) -> tuple[Part, Identification]:
    """The part with most identified stars of a frame, and the identification in terms of the part."""
    best = max(parts(field), key=lambda p: np.isin(found.star, p.row).sum())
    inside = np.isin(found.star, best.row)
    star, catalogue = np.searchsorted(best.row, found.star[inside]), found.catalogue[inside]
    flip = FLIP if found.mirrored else np.eye(3)
    stars = best.field
    pose = Pose(flip @ best.turn @ flip @ found.attitude, stars.focal_px * found.focal_scale, found.mirrored)
    residual = stars.xy[int(found.mirrored)][star] - pose.project(sky.directions(catalogue))
    from_middle = np.abs(pose.project(sky.directions(found.expected)) - stars.middle)
    return best, found.but(
        star=star,
        catalogue=catalogue,
        blend_px=found.blend_px[inside],
        attitude=pose.attitude,
        mean_square_px2=float(np.square(residual).mean()),
        expected=found.expected[(from_middle < stars.half - INSIDE_PX).all(1)],
    )


@at_once
@dataclass(frozen=True)
class LensPose:
    """A pose of the fisheye among the stars: attitude (3, 3), `Sky`'s directions into C."""

    camera: Camera
    attitude: np.ndarray
    mirrored: bool

    def project(self, w: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of directions w (n, 3); NaN outside the lens's picture."""
        u = w @ self.attitude.T
        return self.camera.project(u @ FLIP if self.mirrored else u)

    def moved(self, step: np.ndarray) -> "LensPose":
        """The pose turned about C's axes (rad), its focal length longer by a share, its lens moved in LENS_PRIOR's terms.

        step (4,), or (8,) with the lens
        """
        c = self.camera.scaled(1 + step[3])
        if len(step) > 4:
            k1, k2, *rest = c.distortion
            focal_px, lens = self.camera.fx, (k1 + step[6], k2 + step[7], *rest)
            c = replace(c, cx=c.cx + focal_px * step[4], cy=c.cy + focal_px * step[5], distortion=lens)
        return replace(self, camera=c, attitude=rotation.from_vector(step[:3]) @ self.attitude)

    def fitted(
        self, xy: np.ndarray, w: np.ndarray, error_px: np.ndarray, given: Camera | None = None
    ) -> "LensPose":
        """Fit attitude and focal length to pixels xy (n, 2), with errors (n,) px, of directions w (n, 3).

        given: the lens is fitted too, to these and to LENS_PRIOR about this one's.
        """
        pose, terms, (steps, settled) = self, 4, POSE_STEPS
        if given is not None:
            terms, (steps, settled) = 4 + len(LENS_PRIOR), LENS_STEPS
        for _ in range(steps):
            here = pose.project(w)
            ahead = [pose.moved(step).project(w) for step in np.eye(terms) * STEP]
            slope = (np.stack(ahead, -1) - here[..., None]) / STEP
            on = np.isfinite(slope).all((1, 2))
            design = (slope[on] / error_px[on, None, None]).reshape(-1, terms)
            target = ((xy - here)[on] / error_px[on, None]).ravel()
            if given is not None:
                design = np.vstack([design, np.eye(terms)[4:] / LENS_PRIOR[:, None]])
                target = np.append(target, pose.away_from(given) / LENS_PRIOR)
            step = np.linalg.lstsq(design, target, rcond=None)[0]
            pose = pose.moved(step)
            if np.abs(step).max() < settled:
                break
        return pose

    def away_from(self, given: Camera) -> np.ndarray:
        """How far (4,) its lens has still to go to a given one, in LENS_PRIOR's terms."""
        c = self.camera
        axis = (given.cx - c.cx) / c.fx, (given.cy - c.cy) / c.fx
        return np.array([*axis, *np.subtract(given.distortion[:2], c.distortion[:2])])

    def identified(
        self, field: WideField, xy: np.ndarray, there: OnFrame, pair: np.ndarray, found: Identification
    ) -> Identification:
        """The identification of a field, its stars at xy (N, 2), that pairs (2, M) of stars and those there make."""
        star, sigma = pair[0], field.sigma_px[pair[0]]
        residual = xy[star] - self.project(there.directions[pair[1]])
        return Identification(
            star=star,
            catalogue=there.index[pair[1]],
            blend_px=there.blend_px[pair[1]],
            attitude=self.attitude,
            focal_scale=self.camera.fx / field.camera.fx,
            residual_px=_rms_px(residual, np.hypot(sigma, FLOOR_PX)),
            mean_square_px2=float(np.square(residual).mean()),
            log_odds=found.log_odds,
            expected=there.index[_within(self.project(there.directions), field.camera, -INSIDE_PX)],
            mirrored=found.mirrored,
        )


def _start(
    part: Part, found: Identification
) -> tuple[np.ndarray, np.ndarray, LensPose, np.ndarray, np.ndarray, np.ndarray]:
    """What a part of a frame says of all its stars.

    Returns the pixels (N, 2) of the frame's stars, their errors (N,), and the pose of the whole frame. Then, of the
    identified stars, the rows (M,) and those in the catalogue (M,), and which stars (N,) are not on the part.
    """
    field, flip = part.whole, FLIP if found.mirrored else np.eye(3)
    attitude = flip @ part.turn.T @ flip @ found.attitude
    # ignore stars that fall outside the picture once refraction is removed
    xy = np.nan_to_num(field.camera.project(field.directions[:FAINTEST_FIT]), nan=FAR_PX)
    pose = LensPose(field.camera.scaled(found.focal_scale), attitude, found.mirrored)
    row = part.row[found.star]
    use = row < len(xy)
    beyond = ~np.isin(np.arange(len(xy)), part.row)
    return xy, field.sigma_px[:FAINTEST_FIT], pose, row[use], found.catalogue[use], beyond


def everywhere(sky: Sky, part: Part, found: Identification) -> Identification | None:
    """Extend the identification of a part to the whole frame of a known lens.

    None if the lens puts the identified stars in other places.
    """
    xy, sigma, pose, star, index, beyond = _start(part, found)
    w = sky.directions(index)
    for _ in range(ROUNDS):
        pose = pose.fitted(xy[star], w, np.hypot(sigma[star], _error_px(xy[star] - pose.project(w))))
        spread = _spread_px(xy[star] - pose.project(w))
        there = _stars_on(pose, sky, len(xy))
        gate = GATE_SIGMA * np.hypot(max(spread, MIN_SPREAD_PX), sigma) + GATE_PX
        # a lens that is not known well has other stars than its own in their places farther out
        if spread > BENT_PX:
            gate[beyond] = 0.0
        pair = mutual_nearest(xy, pose.project(there.directions), gate)
        if len(pair[0]) < MIN_STARS:
            return None
        same = np.array_equal(pair[0], star) and np.array_equal(there.index[pair[1]], index)
        star, index, w = pair[0], there.index[pair[1]], there.directions[pair[1]]
        if same:
            break
    return pose.identified(part.whole, xy, there, np.stack(pair), found)


def outwards(sky: Sky, part: Part, found: Identification) -> tuple[Camera, Identification, bool] | None:
    """Extend the identification of a part to the whole frame, and find out its lens on the way.

    Stars near identified ones are matched first. Each ring of them improves the lens (focal length, axis and distortion),
    which then predicts the next ring.

    Returns the camera fitted to its stars, the identification, and whether stars beyond the part bear it out; if they do
    not, the first two are of the first ring.  None if the lens puts the stars of the part in other places.
    """
    xy, sigma, pose, star, index, beyond = _start(part, found)
    w = sky.directions(index)
    middle = part.turn[2] * [1, -1, 1] if found.mirrored else part.turn[2]
    inner = None
    for k in range(math.ceil((math.pi - FIRST_RAD) / NEXT_RAD) + LAST_ROUNDS):
        error = np.hypot(sigma[star], _error_px(xy[star] - pose.project(w)))
        pose = pose.fitted(xy[star], w, error, part.whole.camera)
        spread = max(_spread_px(xy[star] - pose.project(w)), MIN_LENS_SPREAD_PX)
        gate = GATE_SIGMA * np.hypot(spread, sigma) + GATE_RAD * pose.camera.fx
        near = _stars_on(pose, sky, len(xy))
        reach = math.cos(min(FIRST_RAD + k * NEXT_RAD, math.pi))
        near = near.rows(near.directions @ pose.attitude.T @ middle > reach)
        pair = np.stack(mutual_nearest(xy, pose.project(near.directions), gate))
        if pair.shape[1] < MIN_STARS:
            return None
        star, w = pair[0], near.directions[pair[1]]
        if inner is None:
            inner = pose, near, pair
    borne_out = _borne_out(int(beyond[star].sum()), xy[beyond], len(near.index), gate[beyond])
    pose, near, pair = (pose, near, pair) if borne_out or inner is None else inner
    whole = replace(part.whole, camera=pose.camera)
    return pose.camera, pose.identified(whole, xy, near, pair, found), borne_out


def _borne_out(pairs: int, xy: np.ndarray, places: int, gate: np.ndarray) -> bool:
    """Whether this number of pairs of stars xy (n, 2) and places, within gate (n,) px, is more than chance makes."""
    if pairs == 0:
        return False
    area = float(np.prod(np.ptp(xy, axis=0))) * math.pi / 4
    expected = places * float(np.square(gate).sum()) * math.pi / max(area, 1.0)
    if not pairs > expected > 0:
        return pairs > expected
    # Chernoff's bound of the probability of as many
    return pairs - expected - pairs * math.log(pairs / expected) < LOG_CHANCE_PAIRS


def _error_px(residual: np.ndarray) -> float:
    """Extra error: where the lens is poorly known, it dominates, so all stars get the same weight."""
    spread = _spread_px(residual[np.isfinite(residual).all(1)])
    return spread if spread > BENT_PX else FLOOR_PX


def _spread_px(residual: np.ndarray) -> float:
    """Standard deviation (px) that the median of residuals (M, 2) shows."""
    return SIGMA_PER_MAD * float(np.sort(np.abs(residual), axis=None)[residual.size // 2])


def _rms_px(residual: np.ndarray, sigma_px: np.ndarray) -> float:
    """Root mean square of residuals (M, 2) along one axis, with the weights of the fit."""
    weight = 1 / np.square(sigma_px)
    return float(np.sqrt(np.square(residual).sum(1) @ weight / (2 * weight.sum())))


def _within(pixel: np.ndarray, camera: Camera, margin_px: float) -> np.ndarray:
    """Whether pixels (n, 2) lie on the frame or so far beyond it; those that are NaN do not."""
    least, most = -0.5 - margin_px, np.array([camera.width, camera.height]) - 0.5 + margin_px
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixel > least) & (pixel < most)).all(1))


def _stars_on(pose: LensPose, sky: Sky, stars: int) -> OnFrame:
    """The catalogue stars that this number of detections may be."""
    camera, catalogue = pose.camera, sky.catalogue
    axis = (FLIP[2] if pose.mirrored else np.array([0.0, 0.0, 1.0])) @ pose.attitude
    index = rows_near(catalogue.cell_start, axis, min(1.05 * camera.half_diagonal_rad + 0.02, math.pi))
    light = catalogue.vmag_centi[index]
    # more than are on a frame of the widest field
    most = 24 * stars + 600
    if len(index) > most:
        # the limit alone: argpartition takes twenty times as long
        bright = light <= np.partition(light, most)[most]
        index, light = index[bright], light[bright]
    index = index[np.argsort(light, kind="stable")]
    w = sky.directions(index)
    pixel = pose.project(w)
    on = np.flatnonzero(_within(pixel, camera, EDGE_PX))[: 3 * stars + 50]
    single, drawn = _resolved(catalogue, index[on], pixel[on], w[on], camera.fx)
    on = on[single]
    return OnFrame(index[on], w[on], drawn[single])


def _resolved(
    catalogue: Catalogue, index: np.ndarray, pixel: np.ndarray, w: np.ndarray, focal_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which stars (N,), brightest first, are not blended with a brighter one; how far fainter ones move them (px)."""
    single, drawn = np.ones(len(index), bool), np.zeros(len(index))
    brighter, fainter = close_pairs(pixel, BLEND_PX)
    ratio = 10 ** (-0.4 * (catalogue.vmag(index[fainter]) - catalogue.vmag(index[brighter])))
    # from directions and rounded, so that it does not depend on the pose
    apart = np.round(focal_px * np.linalg.norm(w[fainter] - w[brighter], axis=1), 6)
    np.add.at(drawn, brighter, apart * ratio / (1 + ratio))
    single[fainter] = False
    return single, drawn
