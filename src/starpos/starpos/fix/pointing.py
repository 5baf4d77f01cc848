# SPDX-License-Identifier: Apache-2.0
"""A4 from a pointing that a plate solver found, by the same adjustment as from stars.

A few artificial stars are placed around the frame's centre according to the pointing. So aberration, the Earth's
rotation and refraction act on them as on real ones. The errors are the pointing's.
"""

from dataclasses import replace

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.orientation import EarthState
from starpos.earth.refraction import Atmosphere
from starpos.fix.budget import ErrorTerm, Sensitivity, place_of
from starpos.fix.fix import Fix, solve_fix
from starpos.fix.matched import MatchedStars
from starpos.frames.pointings import Pointing
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.mounting import Mounting

# the camera that sees the stars, in place of an unknown one: only its axes count
IDEAL = Camera.from_focal(201, 201, 10_000.0)
STARS, RING_PX = 6, 40.0
# the terms of the errors of stars, which the pointing's error replaces
OF_STARS = ("centroids", "catalogue")


def frame_axes(camera: Camera) -> np.ndarray:
    """Rotation (3, 3) of C into the axes of the frame: z through its centre, y down from there, x to the right."""
    x, y = camera.centre_px
    axis, above = camera.directions([x, x], [y, y - 1.0])
    up = rotation.normalised(above - (above @ axis) * axis)
    return np.stack([np.cross(axis, up), -up, axis])


def pointing_fix(
    pointing: Pointing,
    camera: Camera,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
) -> Fix:
    """The fix of a frame whose pointing and roll are known; FixError if it cannot be."""
    to_frame = frame_axes(camera)
    seen = replace(mounting, a3=mounting.a3 @ to_frame.T, link_to_camera=to_frame @ mounting.link_to_camera)
    angle = 2 * np.pi * np.arange(STARS) / STARS
    xy = np.array(IDEAL.centre_px) + RING_PX * np.stack([np.cos(angle), np.sin(angle)], -1)
    # so large that refraction's and aberration's effect on the ring's shape is negligible
    spread = STARS * (pointing.sigma * IDEAL.fx) ** 2
    stars = MatchedStars(
        xy,
        np.tile(np.eye(2) * spread, (STARS, 1, 1)),
        IDEAL.directions(*xy.T) @ _frame_to_icrs(pointing).T,
        np.zeros(STARS),
    )
    fix = solve_fix(stars, IDEAL, tilt, seen, atmosphere, earth, clock_stddev_s, pointing.stamp_stddev_s)
    g, to_itrs = seen.level(tilt).camera, fix.camera_to_itrs
    # the centre's error turns the frame about two axes across its own, the roll's error about its own axis
    own = np.diag([pointing.sigma, pointing.sigma, pointing.sigma_roll]) ** 2
    sensitivity = Sensitivity.of(place_of(g @ to_itrs.T), fix.link_to_enu)
    return replace(
        fix,
        terms=(
            ErrorTerm("pointing", sensitivity.stars @ symmetric_root(g @ own @ g.T)),
            *(t for t in fix.terms if t.name not in OF_STARS),
        ),
        used=np.zeros(0, int),
        residual_px=np.zeros((0, 2)),
        residual_arcsec=float("nan"),
        jitter_px=0.0,
        camera_to_itrs=to_itrs @ to_frame,
        camera_covariance=to_itrs @ own @ to_itrs.T,
    )


def _frame_to_icrs(pointing: Pointing) -> np.ndarray:
    """Rotation (3, 3) of the frame's axes into the axes of ICRS."""
    ra, dec, roll = pointing.ra, pointing.dec, pointing.roll
    east, north = np.array([-np.sin(ra), np.cos(ra), 0.0]), rotation.unit_vector(ra, dec + np.pi / 2)
    centre, up = rotation.unit_vector(ra, dec), np.cos(roll) * north + np.sin(roll) * east
    return np.stack([np.cross(centre, up), -up, centre], 1)
