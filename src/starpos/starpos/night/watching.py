# SPDX-License-Identifier: Apache-2.0
"""A camera that stands still, night by night: whether it has moved, by how much, and how much the air dims its stars."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from starpos import rotation
from starpos.averaging.poses import mean_attitude
from starpos.calibration.plumb_line import huber
from starpos.errors import FixError
from starpos.fix.attitude import Attitude
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.searching import Sight
from starpos.fix.terms import total_covariance
from starpos.frames.frame import Frame, Stars
from starpos.frozen import at_once
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.units import ARCSEC, DAY_S, HOUR_S, SIGMA_PER_MAD

# how far an untouched camera may wander from night to night, 1 sigma per axis: from the stiffest mount to a post in the
# Sun.  Until the nights have shown it, each size up to USUAL_RAD is as probable as any other, and larger ones are so rare
# that a third night already shows a knock
WANDERS_RAD, USUAL_RAD, RARER = np.geomspace(0.3, 60, 30) * ARCSEC, 10 * ARCSEC, 5
# a camera that stands still leaves its own scatter by more in this share of the nights
ALARM_CHANCE = 1e-6
# the sky is measured within SKY_RAD of the axis, the black level beyond DARK_RAD, on each SPARSE-th pixel of each
# SPARSE-th row, by this many pixels and stars at least
SKY_RAD, DARK_RAD, SPARSE, FEWEST = np.radians(30), np.radians(105), 4, 30
# the magnitude that this share of a night's identified stars is brighter than
LIMIT_PERCENTILE = 95
MEAN_HOUR_DEG = 15.0
# sources in the budget of a heading at a known place, `fix/heading.py`, that are new each night
OF_THE_CLOCK = "clock", "time stamp"
# stars that are brighter by this than the faintest identified ones are detected however their brightness errs
SURELY_DETECTED_MAG = 1.0
# the lowest altitude whose light is used, deg, and the fewest stars
LOWEST_DEG, FEWEST_STARS = 5.0, 60
# neighbours share what is not modelled of lens and sky: patches of 1 / PATCHES focal lengths count as one star each, and
# this many are needed
PATCHES, FEWEST_PATCHES = 4, 15
# an error (mag per air mass) beyond which it is unknown; so it is where brightness does not follow light to this share
UNKNOWN_MAG, LINEAR = 0.1, 0.2
# share by which the air mass of low stars may differ from the law of any night
LAW = 0.05
ROUNDS = 10


@at_once
@dataclass(frozen=True)
class Light:
    """N identified stars: V by the catalogue, magnitude by the frame, air mass, places (N, 2) in focal lengths."""

    v: np.ndarray
    measured: np.ndarray
    air_mass: np.ndarray
    off: np.ndarray


def air_mass(altitude_deg: np.ndarray) -> np.ndarray:
    """Air masses at altitudes as they are seen, above 0 (Pickering 2002)."""
    h = np.maximum(altitude_deg, 0.0)
    return np.asarray(1 / np.sin(np.radians(h + 244 / (165 + 47 * h**1.1))))


def light_of(sight: Sight, camera: Camera) -> Light:
    """The sound identified stars of a frame whose attitude at a known place is known."""
    stars, solution = sight.stars, sight.solution
    assert solution.at_place is not None and solution.star is not None
    row, v = np.asarray(solution.star, int), np.asarray(solution.magnitudes, float)
    up = camera.directions(stars.x[row], stars.y[row]) @ solution.at_place.optics.rotation[2]
    altitude = np.degrees(np.arcsin(np.clip(up, -1, 1)))
    good = np.isfinite(v) & (stars.flags[row] == 0) & (stars.flux[row] > 0) & (altitude > LOWEST_DEG)
    row, v, altitude = row[good], v[good], altitude[good]
    off = np.stack([(stars.x[row] - camera.cx) / camera.fx, (stars.y[row] - camera.cy) / camera.fy], -1)
    return Light(v, -2.5 * np.log10(stars.flux[row]), air_mass(altitude), off)


def extinction(lights: Sequence[Light]) -> tuple[float, float]:
    """Extinction in mag per air mass and its error, by frames of one camera and night; NaN where they do not show it.

    The vignetting, a polynomial of the radius, is fitted too, and how much each frame is dimmed as a whole, as by dew.
    """
    v, measured, mass, off = (
        np.concatenate([getattr(f, name) for f in lights]) for name in ("v", "measured", "air_mass", "off")
    )
    unknown = np.nan, np.nan
    if len(v) < FEWEST_STARS:
        return unknown
    frame = np.repeat(range(len(lights)), [len(light.v) for light in lights])
    bright = np.concatenate(
        [light.v < np.percentile(light.v, 95) - SURELY_DETECTED_MAG for light in lights if len(light.v)]
    )
    patch = np.unique(np.floor(off[bright] * PATCHES), axis=0, return_inverse=True)[1].ravel()
    if bright.sum() < FEWEST_STARS or patch.max() < FEWEST_PATCHES:
        return unknown
    r2 = np.square(off[bright]).sum(1)
    zero = frame[bright, None] == np.unique(frame[bright])
    design = np.column_stack([mass[bright], v[bright], r2, r2**2, zero])
    target, weight = measured[bright], np.ones(len(r2))
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        left = target - design @ found
        weight = huber(left / max(SIGMA_PER_MAD * float(np.median(np.abs(left))), 1e-6))
    inverse = np.linalg.pinv(design.T @ (design * weight[:, None] ** 2))
    pulls = np.zeros((patch.max() + 1, design.shape[1]))
    np.add.at(pulls, patch, design * (weight**2 * left)[:, None])
    free = len(pulls) / max(len(pulls) - design.shape[1], 1)
    sigma = np.sqrt(free * np.diag(inverse @ pulls.T @ pulls @ inverse))
    if sigma[0] > UNKNOWN_MAG or abs(found[1] - 1) > LINEAR or found[0] < -2 * sigma[0]:
        return unknown
    return float(found[0]), float(np.hypot(sigma[0], LAW * found[0]))


@dataclass(frozen=True, kw_only=True)
class NightPose:
    """What the frames of a night, or of the part of one in which the camera stood still, say together.

    day: the date of its evening by local mean time.  stars: number of identified ones.
    optics: C in east, north, up.  focal_px: mean of the frames, on the axis.
    limit_mag: V of the faintest stars of the median frame, by the extinction, where it is known, as if at the zenith.
    worst_limit_mag, worst_unix_s: of the frame with the brightest limit.
    extinction, extinction_sigma: mag per air mass.  sky_mag: V of the sky per square arcsec.  NaN: not known.
    """

    day: str
    utc_unix_s: float
    frames: int
    stars: int
    optics: Attitude
    focal_px: float
    limit_mag: float
    worst_limit_mag: float
    worst_unix_s: float
    extinction: float
    extinction_sigma: float
    sky_mag: float

    @property
    def own(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the errors that other nights do not share, the clock's among them."""
        terms = [t for t in self.optics.terms if not t.common or t.name in OF_THE_CLOCK]
        return total_covariance(terms)[3:, 3:]


@dataclass(frozen=True, kw_only=True, eq=False)
class Kept:
    """A night's pose against the poses before it since the last knock.

    nights: number of them; 0 for the first.  turned (3,), sigma (3,): rotation about east, north, up since their mean and
    its errors, rad.
    alarm: whether it is more than the errors and the scatter of the nights so far explain.
    """

    pose: NightPose
    nights: int
    turned: np.ndarray
    sigma: np.ndarray
    alarm: bool

    @property
    def moved_arcsec(self) -> float:
        """Angle of the rotation."""
        return float(np.linalg.norm(self.turned) / ARCSEC)

    @property
    def sigma_arcsec(self) -> float:
        """Its error, 1 sigma along the axis about which it turned most."""
        size = float(np.linalg.norm(self.turned))
        along = self.turned / size if size else np.full(3, 3**-0.5)
        return float(np.linalg.norm(along * self.sigma) / ARCSEC)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A frame's attitude at a known place, its camera's focal length in px, its identified stars, its sky_mag."""

    at_place: AttitudeAtPlace
    stars: int
    focal_px: float
    light: Light
    sky_mag: float = np.nan

    @classmethod
    def of(cls, item: Frame | Stars, sight: Sight, camera: Camera) -> "Answer":
        """The part of a frame's sight, whose attitude is known."""
        assert sight.solution.at_place is not None
        return cls(
            at_place=sight.solution.at_place,
            stars=len(sight.solution.names),
            focal_px=camera.fx,
            light=light_of(sight, camera),
            sky_mag=sky_mag(item, sight, camera),
        )


def sky_mag(item: Frame | Stars, sight: Sight, camera: Camera) -> float:
    """V of the sky around the optical axis per square arcsec, by the identified stars of a fisheye's frame; else NaN.

    The pixels that the lens does not reach are the black level.  A picture of 8 bit has no level that is proportional to
    light.
    """
    stars, answer = sight.stars, sight.solution
    if isinstance(item, Stars) or camera.model != EQUIDISTANT or item.pixels.dtype != np.uint16:
        return np.nan
    y, x = np.mgrid[0 : item.height : SPARSE, 0 : item.width : SPARSE]
    off = np.hypot((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    levels = item.pixels[::SPARSE, ::SPARSE].astype(float)
    dark, sky = levels[off > DARK_RAD], levels[off < SKY_RAD]
    row, v = np.asarray(answer.star, int), np.asarray(answer.magnitudes, float)
    good = np.isfinite(v) & (stars.flags[row] == 0)
    if len(dark) < FEWEST or len(sky) < FEWEST or good.sum() < FEWEST:
        return np.nan
    light = np.median(sky) - np.median(dark)
    zero = np.median(v[good] + 2.5 * np.log10(stars.flux[row[good]]))
    return float(zero - 2.5 * np.log10(light / camera.scale_arcsec**2)) if light > 0 else np.nan


def night_poses(answers: Iterable[Answer], longitude: float) -> tuple[NightPose, ...]:
    """Poses of a camera in the order of their times, one or more a night.

    longitude: of the place, rad; it says when a night begins.
    """
    late_s = np.degrees(longitude) / MEAN_HOUR_DEG * HOUR_S - DAY_S / 2
    seen = sorted(answers, key=lambda a: a.at_place.utc_unix_s)
    groups: list[tuple[str, list[Answer]]] = []
    for answer in seen:
        evening = datetime.fromtimestamp(answer.at_place.utc_unix_s + late_s, timezone.utc)
        day = evening.strftime("%Y-%m-%d")
        if groups and groups[-1][0] == day and _stands([*groups[-1][1], answer]):
            groups[-1][1].append(answer)
        else:
            groups.append((day, [answer]))
    return tuple(_pose(day, group) for day, group in groups)


def _stands(answers: Sequence[Answer]) -> bool:
    """Whether a camera stood still between frames."""
    try:
        mean_attitude([a.at_place for a in answers])
    except FixError:
        return False
    return True


def _pose(day: str, answers: Sequence[Answer]) -> NightPose:
    mean = mean_attitude([a.at_place for a in answers])
    lights = [a.light for a in answers]
    k, sigma = extinction(lights)
    limits = np.array([_limit(light, np.nan_to_num(k)) for light in lights])
    seen, worst = limits[np.isfinite(limits)], int(np.argmin(np.nan_to_num(limits, nan=np.inf)))
    sky = np.array([a.sky_mag for a in answers if np.isfinite(a.sky_mag)])
    return NightPose(
        day=day,
        utc_unix_s=mean.utc_unix_s,
        frames=len(answers),
        stars=sum(a.stars for a in answers),
        optics=mean.optics,
        focal_px=float(np.mean([a.focal_px for a in answers])),
        limit_mag=float(np.median(seen)) if len(seen) else np.nan,
        worst_limit_mag=float(limits[worst]),
        worst_unix_s=answers[worst].at_place.utc_unix_s,
        extinction=k,
        extinction_sigma=sigma,
        sky_mag=float(np.median(sky)) if len(sky) else np.nan,
    )


def _limit(light: Light, extinction: float) -> float:
    """V of the faintest stars of a frame as if at the zenith; NaN without stars."""
    if not len(light.v):
        return np.nan
    return float(np.percentile(light.v + extinction * (light.air_mass - 1), LIMIT_PERCENTILE))


def kept(poses: Iterable[NightPose]) -> tuple[Kept, ...]:
    """Each pose against the weighted mean of those before it; after an alarm it is against those since.

    The sizes of the wander from night to night are weighed by what the nights have shown of them so far.
    """
    # slow to import, and of no use to what shares this module
    from scipy.special import chdtrc

    log_weight = -RARER * np.log(np.maximum(WANDERS_RAD / USUAL_RAD, 1))
    found: list[Kept] = []
    first, nights, sums = np.eye(3), 0, (np.zeros((len(WANDERS_RAD), 3, 3)), np.zeros((len(WANDERS_RAD), 3)))
    for pose in poses:
        turned, covariance, alarm = np.zeros(3), pose.own, False
        each = pose.own + np.eye(3) * WANDERS_RAD[:, None, None] ** 2
        if nights:
            # for each size of the wander its own mean
            before = np.linalg.inv(sums[0])
            off = rotation.to_vector(pose.optics.rotation @ first.T) - np.einsum(
                "sij,sj->si", before, sums[1]
            )
            total = each + before
            chi2 = np.einsum("si,sij,sj->s", off, np.linalg.inv(total), off)
            weight = np.exp(log_weight - log_weight.max())
            weight /= weight.sum()
            turned, covariance = weight @ off, np.tensordot(weight, total, 1)
            alarm = bool(weight @ chdtrc(3, chi2) < ALARM_CHANCE)
            if not alarm:
                log_weight -= (chi2 + np.linalg.slogdet(total)[1]) / 2
        found.append(
            Kept(pose=pose, nights=nights, turned=turned, sigma=np.sqrt(np.diag(covariance)), alarm=alarm)
        )
        if alarm or not nights:
            first, nights, sums = pose.optics.rotation, 0, (0 * sums[0], 0 * sums[1])
        information = np.linalg.inv(each)
        sums = (
            sums[0] + information,
            sums[1] + information @ rotation.to_vector(pose.optics.rotation @ first.T),
        )
        nights += 1
    return tuple(found)
