# SPDX-License-Identifier: Apache-2.0
"""Where to look first.  A prior only proposes; what it proposes is verified as everything else is."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.identification.pose import Field, Poses, directions
from starpos.identification.sky import Sky
from starpos.identification.verify import TEST_STARS, Expected, Hypotheses, own_stars

ERROR_PX = 0.3
BRIGHTEST = 15  # stars of the frame that vote for a shift
REACH = 0.05  # of the frame's width: how far the stars may have moved
ROLL_RAD = 5e-4  # and turned
AGREE_PX = 3.0  # votes for the same shift
MOST = 4  # proposals of a kind
RING_STARS = 8  # of the frame that vote for an azimuth


@dataclass(frozen=True)
class Pointing:
    """The attitude (3, 3), `Sky`'s directions into C, is about this, the focal length focal_px."""

    attitude: np.ndarray
    focal_px: float

    def hypotheses(self, field: Field, sky: Sky) -> tuple[Hypotheses, int]:
        """The shifts that most stars agree on, and among how many they were chosen."""
        one = Poses(self.attitude[None], np.array([self.focal_px]), np.zeros(1, bool))
        expected = Expected.on(field, sky, one)
        xy = field.xy[0, : min(len(field), TEST_STARS)]
        shift = xy[:BRIGHTEST, None] - expected.pixel[0]
        star, near = np.nonzero(np.square(shift).sum(-1) < (2 * REACH * field.half[0]) ** 2)
        shift = shift[star, near]
        pick = _most_voted(np.square(shift[:, None] - shift).sum(-1) < AGREE_PX**2)
        # a shift along x is a turn about the camera's y axis, one along y about its x axis
        turned = [rotation.from_vector([-y, x, 0.0]) @ self.attitude for x, y in shift[pick] / self.focal_px]
        poses = Poses(
            np.array(turned).reshape(-1, 3, 3), np.full(len(pick), self.focal_px), np.zeros(len(pick), bool)
        )
        away = np.sqrt(np.square(xy - xy[star[pick], None]).sum(-1))
        sigma = np.hypot(field.sigma[: len(xy)], ERROR_PX)
        own = own_stars(np.broadcast_to(xy, (len(pick), *xy.shape)), star[pick][:, None], sigma)
        return Hypotheses(poses, own, np.hypot(sigma, ROLL_RAD * away)), len(shift)


@dataclass(frozen=True)
class Plumb:
    """The zenith is known, zenith_sky (3,) among `Sky`'s directions and zenith_camera (3,) in C, to tolerance_rad; which
    way the camera faces is not."""

    zenith_sky: np.ndarray
    zenith_camera: np.ndarray
    tolerance_rad: float

    def hypotheses(self, field: Field, sky: Sky) -> tuple[Hypotheses, int]:
        """`Pointing`s to the azimuths at which most stars are as far from the zenith as the catalogue's."""
        seen, to_camera = _about(
            directions(field.xy[:1, :RING_STARS], np.array([field.focal_px]))[0], self.zenith_camera
        )
        ring = sky.triangles.beacons @ self.zenith_sky
        margin = self.tolerance_rad + 2e-4  # aberration and proper motion are not in it
        low, high = np.cos(seen[:, 0].max() + margin), np.cos(max(seen[:, 0].min() - margin, 0.0))
        w = sky.bright(sky.triangles.beacon[(ring > low) & (ring < high)])
        known, to_sky = _about(w, self.zenith_sky)
        star, near = np.nonzero(np.abs(seen[:, None, 0] - known[:, 0]) < self.tolerance_rad)
        turn = np.sort((seen[star, 1] - known[near, 1]) % (2 * np.pi))
        window = 2 * self.tolerance_rad / max(np.sin(np.median(seen[:, 0])), self.tolerance_rad)
        votes = np.searchsorted(turn, turn + window) - np.arange(len(turn))
        pick = []
        for k in np.argsort(-votes, kind="stable").tolist():
            if all(abs(turn[k] - turn[j]) > window for j in pick):
                pick.append(k)
            if len(pick) == MOST:
                break
        tried, found = 1, []
        for k in pick:
            middle = np.median(turn[k : k + votes[k]])
            attitude = to_camera.T @ rotation.about_axis(2, middle) @ to_sky
            h, count = Pointing(attitude, field.focal_px).hypotheses(field, sky)
            tried += len(turn) * count
            found.append(h)
        return Hypotheses.joined(found, min(len(field), TEST_STARS)), tried


def _about(v: np.ndarray, pole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polar distance and longitude (n, 2) of v (n, 3) about a pole, and the rotation (3, 3) into that frame."""
    x = np.cross(pole, np.eye(3)[np.argmin(np.abs(pole))])
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(pole, x), pole])
    a, b, c = (v @ frame.T).T
    return np.stack([np.arctan2(np.hypot(a, b), c), np.arctan2(b, a)], -1), frame


def _most_voted(agree: np.ndarray) -> np.ndarray:
    """The rows of agree (P, P) with most votes, none of which votes for another."""
    left, pick = np.ones(len(agree), bool), []
    while left.any() and len(pick) < MOST:
        k = int(np.argmax(np.where(left, agree.sum(1), -1)))
        pick.append(k)
        left &= ~agree[k]
    return np.array(pick, int)
