# SPDX-License-Identifier: Apache-2.0
"""A first night as it arrives in a folder: a lens out of focus, an exposure too short, leans, four headings."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos import rotation
from starpos.frames.tables import write_star_list
from starpos.simulation.scene import Scene, detected, expose, read_tilt, scene_of
from starpos.sky.catalogue import load_catalogue
from starpos.units import date_obs

# Seconds from frame to frame, and between tilts.
CADENCE_S, TILT_S = 5.0, 0.1
# An instrument is moved for so long, and then stands.
MOVED_S = 15.0
A3_DEG = (0.4, -0.7, 130.0)


@dataclass(frozen=True)
class Stand:
    """The instrument for some frames: leans (deg) about north and east, turn about the vertical (deg), optics."""

    frames: int
    lean_deg: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0
    fwhm_px: float = 2.4
    exposure_s: float = 0.5


def usual() -> list[Stand]:
    """Somebody focuses, lengthens the exposure, raises two feet one after the other, and turns to four headings."""
    widths = (9.0, 6.5, 4.5, 3.1, 2.4, 2.9, 2.4, 2.4, 2.4)
    focus = [Stand(1, fwhm_px=width, exposure_s=0.01) for width in widths]
    still = [Stand(1, exposure_s=0.01), Stand(4)]
    feet = [Stand(2, lean_deg=(2.0, 0.0)), Stand(2, lean_deg=(0.0, 2.0))]
    return [*focus, *still, *feet, *(Stand(3, turn_deg=turn) for turn in (0.0, 90.0, 180.0, 270.0))]


def scene_at(stand: Stand, scene: Scene) -> Scene:
    """The scene with the instrument leaned and turned."""
    north, east = np.radians(stand.lean_deg)
    lean = rotation.from_vector([east, north, 0.0])
    turned = lean @ rotation.about_axis(2, -np.radians(stand.turn_deg)) @ scene.attitude
    z = turned[:, 2]
    azimuth, altitude = np.degrees(np.arctan2(z[0], z[1])), np.degrees(np.arcsin(z[2]))
    upright = replace(scene, azimuth_deg=azimuth, altitude_deg=altitude, roll_deg=0.0)
    m = upright.attitude.T @ turned
    optics = replace(scene.optics, fwhm_px=stand.fwhm_px)
    return replace(upright, roll_deg=np.degrees(np.arctan2(-m[1, 0], m[0, 0])), optics=optics)


def arriving(
    folder: Path, seed: int, begin_s: float, stands: list[Stand], mirrored: bool = False
) -> Iterator[float]:
    """Write tilts and frames of these stands into a folder, in their order; yields the time after each frame.

    mirrored: the level's Y' has the wrong sign.
    """
    rng, catalogue = np.random.default_rng(seed), load_catalogue()
    scene = scene_of(
        size=(2808, 1872), focal_px=46875.0, latitude_deg=47.3, longitude_deg=8.5, misalignment_deg=A3_DEG
    )
    now_s, before, number = begin_s, stands[0], 0
    with (folder / "tilt.csv").open("w") as tilts:
        tilts.write("utc_unix_s,theta_x_deg,theta_y_deg\n")
        for stand in stands:
            at = scene_at(stand, scene)
            moved = (stand.lean_deg, stand.turn_deg) != (before.lean_deg, before.turn_deg)
            before = stand
            for k in range(stand.frames):
                waits_s = MOVED_S if moved and k == 0 else CADENCE_S
                for t in np.arange(now_s, now_s + waits_s, TILT_S):
                    # no readings while it is moved
                    if waits_s == CADENCE_S or t > now_s + MOVED_S - CADENCE_S:
                        x, y = np.degrees(read_tilt(at, rng))
                        tilts.write(f"{t:.3f},{x:.6f},{-y if mirrored else y:.6f}\n")
                tilts.flush()
                now_s += waits_s
                start_s = now_s - CADENCE_S / 2
                stars = detected(
                    at,
                    expose(at, catalogue, start_s, stand.exposure_s, rng),
                    start_s + stand.exposure_s / 2,
                    stand.exposure_s,
                    rng,
                )
                stars = replace(stars, fwhm_px=stand.fwhm_px)
                write_star_list(folder / f"stars_{number:04d}.csv", stars, date_obs(start_s))
                number += 1
                yield now_s
