# SPDX-License-Identifier: Apache-2.0
"""Calibrates a camera with the sky.

Frames are identified with the given camera, the camera is fitted to their stars, and the better camera finds more stars:
fainter ones, and those in the corners.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.calibration.camera_adjustment import Sighting, parameters, unbent
from starpos.calibration.intrinsics import (
    Intrinsics,
    check_invertible,
    check_sound,
    fewest_stars,
    fit_camera,
)
from starpos.calibration.misalignment import NOTHING_KNOWN, Known
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.fix.matched import sound_matches
from starpos.fix.seen import high_enough
from starpos.fix.solver import ENOUGH_SOUND
from starpos.frames.stars import Stars
from starpos.identification import (
    Identification,
    PointingPrior,
    Sky,
    identify_directions,
    triangle_cache,
    wide,
)
from starpos.identification.triangles import TriangleCatalogue
from starpos.instrument.camera import Camera
from starpos.progress import Progress, quiet
from starpos.sky import deeper
from starpos.sky.catalogue import Catalogue

# the first rounds have coarse matches and fit few terms: with more, wrong matches in the corners would confirm themselves
FIRST_FREE = (("fx", "fy", "k1"), ("fx", "fy", "cx", "cy", "k1"), ("fx", "fy", "cx", "cy", "k1", "k2"))
# below FEW times the minimum number of stars nearly all must fit, because a wrong lens leaves some over
FEW, NEARLY_ALL = 2, 0.9
# most rounds in which all terms are fitted
ROUNDS = 5
# a round that finds no more than this share of new stars is the last
SETTLED_SHARE = 0.002


@dataclass(frozen=True)
class FromSky:
    """A camera from frames; used: indices of the frames that were identified, in the order of the fit."""

    fit: Intrinsics
    used: tuple[int, ...]


def calibrate_camera(
    frames: Sequence[Stars],
    levels: Sequence[np.ndarray | None],
    given: Camera,
    catalogue: Catalogue,
    atmosphere: Atmosphere,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> FromSky:
    """One camera from frames of any attitudes.

    levels: for each frame the rotation (3, 3) of C into the local level L, None if unknown.
    given: a camera that is right to 3 % of the focal length and a few px of distortion; a fisheye to 5 px within 30 deg
    of its axis.
    known: the stars of frames, by the frames' numbers, that only a longer search identifies.
    Frames that are not identified are left out.  Raises CalibrationError if no camera can be found, InstrumentError for
    a mirrored frame, TimeError for an impossible time.
    """
    for stars in frames:
        if (stars.width, stars.height) != (given.width, given.height):
            raise CalibrationError(
                f"{stars.source}: the frame is {stars.width} x {stars.height} px but the first or the instrument has "
                f"{given.width} x {given.height}: give frames of one size"
            )
    if wide.is_wide(given) and any(level is None for level in levels):
        raise CalibrationError(
            "without tilts refraction cannot be separated from a fisheye's distortion: give the --tilt of "
            "its frames"
        )
    catalogue = deeper.for_field(catalogue, given, progress)
    table = triangle_cache.cached(catalogue, wide.field_rad(given), progress)
    every = parameters(given)
    skies = [_Frame.of(stars, level, catalogue, table) for stars, level in zip(frames, levels, strict=True)]
    camera, before = given, 0
    attitudes = {n: found.attitude for n, found in known.items() if not found.mirrored}
    for k, free in enumerate((*FIRST_FREE, *[every] * ROUNDS)):
        sightings = {}
        for n, frame in enumerate(skies):
            if sighting := frame.sighting(camera, atmosphere, attitudes.get(n)):
                sightings[n] = sighting
            progress("camera", (k + (n + 1) / len(skies)) / (len(FIRST_FREE) + ROUNDS))
        if not sightings:
            raise CalibrationError(
                f"no part of the sky matches any of the {len(frames)} frames: check the focal length "
                f"({given.fx:.0f} px given, "
                "3 % is allowed), clouds and exposure"
            )
        fit = fit_camera(list(sightings.values()), given, atmosphere, free)
        check_invertible(fit.camera)
        camera, attitudes = fit.camera, dict(zip(sightings, fit.attitudes, strict=True))
        count = sum(len(s.xy) for s in sightings.values())
        if k >= len(FIRST_FREE) and abs(count - before) <= SETTLED_SHARE * count:
            break
        before = count
    there = sum(len(skies[n].stars) for n in sightings)
    few = FEW * fewest_stars(every)
    if count < few and len(fit.xy) < NEARLY_ALL * there:
        raise CalibrationError(
            f"{len(fit.xy)} of {there} stars fit one camera, too few to be sure of it: give frames with {few} or more"
        )
    check_sound(fit, given)
    progress("camera", 1.0)
    return FromSky(fit, tuple(sightings))


@dataclass(frozen=True)
class _Frame:
    """The stars of a frame, and the sky of its date."""

    stars: Stars
    level: np.ndarray | None
    sky: Sky

    @classmethod
    def of(
        cls,
        stars: Stars,
        level: np.ndarray | None,
        catalogue: Catalogue,
        table: TriangleCatalogue,
    ) -> "_Frame":
        return cls(stars.take(stars.on_frame), level, Sky.at(catalogue, table, stars.mid_unix_s))

    def sighting(
        self, camera: Camera, atmosphere: Atmosphere, attitude: np.ndarray | None
    ) -> Sighting | None:
        """The stars that are identified with this camera, first near a known attitude (3, 3); None if none are.

        Raises InstrumentError for a mirrored frame.
        """
        stars = self.stars.take(camera.sees(self.stars.x, self.stars.y))
        seen = unbent(camera.directions(stars.x, stars.y), self.level, atmosphere)
        priors = () if attitude is None else (PointingPrior(attitude, camera.fx),)
        found = identify_directions(seen, stars.sigma, camera, self.sky, priors)
        if found is None:
            return None
        if found.mirrored:
            raise InstrumentError(
                f"{self.stars.source}: the frame is mirrored (its rows run bottom-up): flip it"
            )
        return self._sighting(stars, seen, found, camera)

    def _sighting(self, stars: Stars, seen: np.ndarray, found: Identification, camera: Camera) -> Sighting:
        use = sound_matches(stars, found, ENOUGH_SOUND)
        if wide.is_wide(camera) and self.level is not None:
            use &= high_enough(seen[found.star] @ self.level[2])
        star, index = found.star[use], found.catalogue[use]
        return Sighting(
            xy=np.stack([stars.x, stars.y], -1)[star],
            covariance_px2=stars.covariance[star],
            directions=self.sky.directions(index),
            direction_sigma=np.hypot(
                self.sky.catalogue.sigma(index, self.sky.year), found.blend_px[use] / camera.fx
            ),
            attitude=found.attitude,
            level=self.level,
            timed=self.stars.mid_unix_s is not None,
        )
