# SPDX-License-Identifier: Apache-2.0
"""The quality of a session, face by face and star by star: how far each stands off the others, and what it can do."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.units import ARCSEC
from starpos.zenith.faces import mean_headings
from starpos.zenith.lines import Lines
from starpos.zenith.places import StarPlaces
from starpos.zenith.sighting import ZenithSighting


@dataclass(frozen=True, eq=False, kw_only=True)
class StarQuality:
    """The S stars of a session.

    stars (S,): rows of the catalogue.  frames (S,): number of frames that each is in.
    mean_arcsec (S, 2): mean of its residuals, where the frame's stars have it minus where it is seen, east and north.
    rms_arcsec (S,): root mean square of its residuals a coordinate.
    leverage_arcsec (S, 2): largest change of xi and of eta by 1 sigma of its place in the catalogue.
    """

    stars: np.ndarray
    frames: np.ndarray
    mean_arcsec: np.ndarray
    rms_arcsec: np.ndarray
    leverage_arcsec: np.ndarray

    @classmethod
    def of(
        cls, sightings: Sequence[ZenithSighting], places: StarPlaces, lines: Lines, gain: np.ndarray
    ) -> "StarQuality":
        """Collect the residuals of each star; gain (2, 2 N): xi, eta in arcsec by the readings in rad."""
        number = len(places.correction)
        frames, mean, square = np.zeros(number), np.zeros((number, 2)), np.zeros(number)
        lever = np.zeros((2, number, 3))
        for k, (rows, s) in enumerate(zip(places.rows, sightings, strict=True)):
            seen = s.residual_arcsec @ s.enu_to_camera[:2, :2]
            frames[rows] += 1
            mean[rows] += seen
            square[rows] += (seen**2).mean(1)
            turn = gain[:, 2 * k : 2 * k + 2] @ lines.by_camera[k]
            lever[:, rows] += np.einsum("xi,inj->xnj", turn, s.by_star)
        return cls(
            stars=places.stars,
            frames=frames.astype(int),
            mean_arcsec=mean / frames[:, None],
            rms_arcsec=np.sqrt(square / frames),
            leverage_arcsec=np.linalg.norm(lever, axis=2).T,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceQuality:
    """A face against all others.

    number: from 0.  heading_deg: azimuth of the top of the frame.  frames: number of its frames.
    off_arcsec, stddev_arcsec (2,): xi and eta that it alone has more than the others have, with 1 sigma; NaN where they
    cannot be separated from A3.  chi2: of these two.
    """

    number: int
    heading_deg: float
    frames: int
    off_arcsec: np.ndarray
    stddev_arcsec: np.ndarray
    chi2: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Leftover:
    """What the unknowns of an adjustment leave of N frames' readings, for tests of what else there may be.

    by_lean (N, 2, 2), by_second (N, 2): derivatives of the readings by eta and xi, and by a second of the clock, rad.
    projector (2 N, 2 N), weighted (2 N,): weights that the unknowns leave, and the weighted residuals.
    """

    by_lean: np.ndarray
    by_second: np.ndarray
    projector: np.ndarray
    weighted: np.ndarray

    def tested(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The best multiple (m,) of further columns (N, 2, m), its normal matrix, and by how much chi-square falls."""
        flat = columns.reshape(-1, columns.shape[2])
        normal = flat.T @ self.projector @ flat
        right = flat.T @ self.weighted
        step = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
        return step, normal, float(step @ right)

    def excess(self, covariance: np.ndarray) -> float:
        """How many sigma more of an error of this covariance (2 N, 2 N) the residuals have than the weights assume."""
        weighted = self.projector @ covariance
        more = self.weighted @ covariance @ self.weighted - np.trace(weighted)
        spread = np.sqrt(2 * np.sum(weighted * weighted.T))
        return float(more / spread) if spread > 0 else 0.0


def face_qualities(
    leftover: Leftover, sightings: Sequence[ZenithSighting], faces: np.ndarray
) -> tuple[FaceQuality, ...]:
    """Each face of a session against the others; faces (N,): number of each frame's face.

    Empty for fewer than three faces: of two it is unknown which is wrong.
    """
    headings = np.degrees(mean_headings(sightings, faces)).tolist()
    return tuple(_quality(leftover, k, h, faces == k) for k, h in enumerate(headings) if len(headings) > 2)


def _quality(leftover: Leftover, number: int, heading_deg: float, member: np.ndarray) -> FaceQuality:
    step, normal, chi2 = leftover.tested(leftover.by_lean * member[:, None, None])
    known = np.linalg.cond(normal) < 1e9
    stddev = np.sqrt(np.diag(np.linalg.inv(normal))) if known else np.full(2, np.nan)
    return FaceQuality(
        number=number,
        heading_deg=heading_deg,
        frames=int(member.sum()),
        off_arcsec=step[::-1] / ARCSEC,
        stddev_arcsec=stddev[::-1] / ARCSEC,
        chi2=chi2,
    )
