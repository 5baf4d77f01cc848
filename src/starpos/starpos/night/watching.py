# SPDX-License-Identifier: Apache-2.0
"""The poses of a camera that stands still, night by night: whether it has moved, and by how much."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np

from starpos import rotation
from starpos.averaging.poses import mean_attitude
from starpos.errors import FixError
from starpos.fix.attitude import Attitude
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import Solution
from starpos.fix.terms import total_covariance
from starpos.units import ARCSEC, DAY_S, HOUR_S

# how far the poses of two nights may differ without a knock until they have shown it themselves, 1 sigma per axis, and
# for how many nights that counts
WANDER_RAD, WANDER_NIGHTS = 15 * ARCSEC, 2
# a camera that stands still leaves its own scatter by more once in 1e6 nights
ALARM_SIGMAS = 5.5
# the magnitude that this share of a night's identified stars is brighter than
LIMIT_PERCENTILE = 95
MEAN_HOUR_DEG = 15.0
# sources in the budget of a heading at a known place, `fix/heading.py`, that are new each night
OF_THE_CLOCK = "clock", "time stamp"


@dataclass(frozen=True, kw_only=True)
class NightPose:
    """What the frames of a night, or of the part of one in which the camera stood still, say together.

    day: the date of its evening by local mean time.  stars: number of identified ones.
    optics: C in east, north, up.  focal_px: mean of the frames, on the axis.
    limit_mag: V of the faintest stars; NaN where it is not known.
    """

    day: str
    utc_unix_s: float
    frames: int
    stars: int
    optics: Attitude
    focal_px: float
    limit_mag: float

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


def night_poses(answers: Iterable[tuple[Solution, float]], longitude: float) -> tuple[NightPose, ...]:
    """Poses of a camera in the order of their times, one or more a night.

    answers: of frames with an attitude at a known place, each with its camera's focal length in px.
    longitude: of the place, rad; it says when a night begins.
    """
    late_s = np.degrees(longitude) / MEAN_HOUR_DEG * HOUR_S - DAY_S / 2
    seen = sorted(answers, key=lambda a: _at(a[0]).utc_unix_s)
    groups: list[tuple[str, list[tuple[Solution, float]]]] = []
    for answer in seen:
        evening = datetime.fromtimestamp(_at(answer[0]).utc_unix_s + late_s, timezone.utc)
        day = evening.strftime("%Y-%m-%d")
        if groups and groups[-1][0] == day and _stands([*groups[-1][1], answer]):
            groups[-1][1].append(answer)
        else:
            groups.append((day, [answer]))
    return tuple(_pose(day, group) for day, group in groups)


def _at(answer: Solution) -> AttitudeAtPlace:
    assert answer.at_place is not None
    return answer.at_place


def _stands(answers: Sequence[tuple[Solution, float]]) -> bool:
    """Whether a camera stood still between frames."""
    try:
        mean_attitude([_at(s) for s, _ in answers])
    except FixError:
        return False
    return True


def _pose(day: str, answers: Sequence[tuple[Solution, float]]) -> NightPose:
    mean = mean_attitude([_at(s) for s, _ in answers])
    magnitudes = np.concatenate([np.asarray(s.magnitudes, float) for s, _ in answers])
    known = magnitudes[np.isfinite(magnitudes)]
    return NightPose(
        day=day,
        utc_unix_s=mean.utc_unix_s,
        frames=len(answers),
        stars=sum(len(s.names) for s, _ in answers),
        optics=mean.optics,
        focal_px=float(np.mean([f for _, f in answers])),
        limit_mag=float(np.percentile(known, LIMIT_PERCENTILE)) if len(known) else np.nan,
    )


def kept(poses: Iterable[NightPose]) -> tuple[Kept, ...]:
    """Each pose against the mean of those before it; after an alarm it is against those since.

    The scatter that is allowed for is the one that the nights have shown so far, with WANDER_RAD in the beginning.
    """
    before: list[NightPose] = []
    offs: list[float] = []
    found = []
    for pose in poses:
        turned, covariance, alarm = np.zeros(3), pose.own, False
        if before:
            mean = rotation.mean_rotation(np.array([p.optics.rotation for p in before]))
            turned = rotation.to_vector(pose.optics.rotation @ mean.T)
            # what the nights have shown contains the errors of their frames
            shown2 = (WANDER_NIGHTS * WANDER_RAD**2 + sum(offs)) / (WANDER_NIGHTS + len(offs))
            wander2 = max(shown2 - float(np.trace(pose.own)) / 3, 0.0)
            covariance = (pose.own + np.eye(3) * wander2) * (1 + 1 / len(before))
            alarm = bool(turned @ np.linalg.solve(covariance, turned) > ALARM_SIGMAS**2)
        found.append(
            Kept(
                pose=pose,
                nights=len(before),
                turned=turned,
                sigma=np.sqrt(np.diag(covariance)),
                alarm=alarm,
            )
        )
        if alarm:
            before = []
        elif before:
            offs.append(float(np.mean(turned**2)))
        before.append(pose)
    return tuple(found)
