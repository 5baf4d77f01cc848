# SPDX-License-Identifier: Apache-2.0
"""The camera from the sky: frames are identified with the camera as it is given, the camera is fitted to their stars, and
the better camera finds more of them, to the faint and the corners."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.calibration.intrinsics import (
    PARAMETERS,
    Intrinsics,
    Sighting,
    check_invertible,
    check_sound,
    fewest_stars,
    fit_camera,
    unbent,
)
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.fix.fix import sound_matches
from starpos.fix.solver import ENOUGH_SOUND
from starpos.frames.stars import Stars
from starpos.identification import Identification, PointingPrior, Sky, identify_directions, triangles
from starpos.instrument.camera import Camera
from starpos.progress import Progress, quiet
from starpos.sky.catalogue import Catalogue

# what the coarse matches of the first rounds may tell: a term too many, and the corners' wrong matches make it come true
FREE = (("fx", "fy", "k1"), ("fx", "fy", "cx", "cy", "k1"), ("fx", "fy", "cx", "cy", "k1", "k2"))
# Of few stars nearly all must fit: a wrong lens leaves some over, which of many do not matter
FEW, NEARLY_ALL = 2 * fewest_stars(), 0.9
ROUNDS = 5  # the most, of those in which all may
SETTLED_SHARE = 0.002  # of the stars: so few more are no reason for another round


@dataclass(frozen=True)
class FromSky:
    """The camera that frames told, and which of them (indices) were identified: the fit's, in order."""

    fit: Intrinsics
    used: tuple[int, ...]


def calibrate_camera(
    frames: Sequence[Stars],
    levels: Sequence[np.ndarray | None],
    given: Camera,
    catalogue: Catalogue,
    atmosphere: Atmosphere,
    progress: Progress = quiet,
) -> FromSky:
    """One camera from frames of any attitudes.

    levels: of each frame, C into the local level L (3, 3), None where it is unknown; given: right to 3 % of the focal
    length and a few px of distortion.  Frames that are not identified are left out.  Raises CalibrationError where no
    camera comes of it, InstrumentError for a mirrored frame, TimeError for an impossible time.
    """
    for stars in frames:
        if (stars.width, stars.height) != (given.width, given.height):
            raise CalibrationError(
                f"{stars.source}: the frame is {stars.width} x {stars.height} px but the first or the instrument has "
                f"{given.width} x {given.height}: give frames of one size"
            )
    table = triangles.cached(catalogue, given.half_diagonal_rad, progress)
    skies = [_Frame.of(stars, level, catalogue, table) for stars, level in zip(frames, levels, strict=True)]
    camera, known, before = given, {}, 0
    for k, free in enumerate((*FREE, *[PARAMETERS] * ROUNDS)):
        sightings = {}
        for n, frame in enumerate(skies):
            if sighting := frame.sighting(camera, atmosphere, known.get(n)):
                sightings[n] = sighting
            progress("camera", (k + (n + 1) / len(skies)) / (len(FREE) + ROUNDS))
        if not sightings:
            raise CalibrationError(
                f"none of the sky fits any of the {len(frames)} frames: check the focal length ({given.fx:.0f} px given, "
                "3 % is allowed), clouds and exposure"
            )
        fit = fit_camera(list(sightings.values()), given, atmosphere, free)
        check_invertible(fit.camera)
        camera, known = fit.camera, dict(zip(sightings, fit.attitudes, strict=True))
        count = sum(len(s.xy) for s in sightings.values())
        if k >= len(FREE) and abs(count - before) <= SETTLED_SHARE * count:
            break
        before = count
    there = sum(len(skies[n].stars) for n in sightings)
    if count < FEW and len(fit.xy) < NEARLY_ALL * there:
        raise CalibrationError(
            f"{len(fit.xy)} of {there} stars fit one camera, too few to be sure of it: give frames with {FEW} or more"
        )
    check_sound(fit, given)
    progress("camera", 1.0)
    return FromSky(fit, tuple(sightings))


@dataclass(frozen=True)
class _Frame:
    """A frame's stars and the sky of its date."""

    stars: Stars
    level: np.ndarray | None
    sky: Sky

    @classmethod
    def of(cls, stars: Stars, level, catalogue: Catalogue, table: triangles.TriangleCatalogue) -> "_Frame":
        return cls(stars.take(stars.on_frame), level, Sky.at(catalogue, table, stars.mid_unix_s))

    def sighting(
        self, camera: Camera, atmosphere: Atmosphere, attitude: np.ndarray | None
    ) -> Sighting | None:
        """Its stars as this camera identifies them, first near the attitude where one is known; None: it does not."""
        seen = unbent(camera.directions(self.stars.x, self.stars.y), self.level, atmosphere)
        priors = () if attitude is None else (PointingPrior(attitude, camera.fx),)
        found = identify_directions(seen, self.stars.sigma, camera, self.sky, priors)
        if found is None:
            return None
        if found.mirrored:
            raise InstrumentError(
                f"{self.stars.source}: the frame is mirrored (its rows run bottom-up): flip it"
            )
        return self._of(found, camera)

    def _of(self, found: Identification, camera: Camera) -> Sighting:
        use = sound_matches(self.stars, found, ENOUGH_SOUND)
        star, index = found.star[use], found.catalogue[use]
        return Sighting(
            xy=np.stack([self.stars.x, self.stars.y], -1)[star],
            covariance_px2=self.stars.covariance[star],
            directions=self.sky.directions(index),
            direction_sigma=np.hypot(
                self.sky.catalogue.sigma(index, self.sky.year), found.blend_px[use] / camera.fx
            ),
            attitude=found.attitude,
            level=self.level,
            timed=self.stars.mid_unix_s is not None,
        )
