# SPDX-License-Identifier: Apache-2.0
"""The Sun on real frames of all-sky cameras, of known time and place: what docs/how-to/by_day.md says of them.

    git clone https://github.com/LEX2016WoKaGru/pyclamster FOLDER
    python tools/data/real_suns.py FOLDER

Two cameras of the University of Hamburg, without filters; a person has marked the Sun on these frames, too, and their
names say where. The lens and its pose are unknown. So they are fitted to the ephemeris of all frames but one, whose
heading error is what the lens of the others misses the Sun by, across its azimuth. Needs no ROS. Keeps nothing of the
source.
"""

import argparse
import re
import subprocess
import tempfile
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from starpos.detection.background import plane_of
from starpos.detection.discs import find_disc
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.frames.frame import Disc
from starpos.frames.reading import read_frame
from starpos.sky.bodies import SUN, body_at

# latitude, longitude: as the repository's scripts of the same names have them
SITES = {"wettermast": (53.519917, 10.105139), "wolf": (53.99777, 9.56673)}
FRAME = re.compile(r"_(\d{8}_\d{6})_?UTCp1_sunrow(\d+)_suncol(\d+)\.jpg$")
AIR = Atmosphere.measured(101_000.0, 18.0)
# where the fit begins: focal length and centre, px, with what they may differ by; the share of the lens's cubic term
LENS, SPREAD = np.array([590.0, 0.0, 960.0, 960.0]), np.array([60.0, 0.05, 15.0, 15.0])
SCALES = [60.0, 0.05, 15.0, 15.0, 0.02, 0.02, 0.02]
MIN_FRAMES = 8


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame with the Sun: its direction (3,) in east, north, up, where it was marked by hand (2,), what was found."""

    sun: np.ndarray
    by_hand: np.ndarray
    found: Disc | None


def sights(repository: Path, name: str) -> list[Sight]:
    """The frames of a camera."""
    place, made = Place.on_ellipsoid(*SITES[name]), []
    folder = f"examples/images/{name}/calibration/"
    git = ["git", "-C", str(repository)]
    paths = subprocess.run(
        [*git, "ls-tree", "--name-only", "HEAD", folder], capture_output=True, text=True, check=True
    ).stdout.split()
    for path in paths:
        if not (said := FRAME.search(path)):
            continue
        local = datetime.strptime(said[1], "%Y%m%d_%H%M%S").replace(tzinfo=timezone.utc)
        true = place.axes @ body_at(SUN, earth_state(local.timestamp() - 3600)).from_place(place.zenith)
        with tempfile.NamedTemporaryFile(suffix=".jpg") as file:
            subprocess.run([*git, "show", f"HEAD:{path}"], stdout=file, check=True)
            disc = find_disc(plane_of(read_frame(file.name))[0])
        made.append(Sight(AIR.raised(true)[0], np.array([float(said[3]), float(said[2])]), disc))
    return made


def places_of(lens: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of directions (N, 3) east, north, up: focal length, cubic term, centre (2), pose as a vector (3)."""
    v = sun * [-1, 1, 1] @ Rotation.from_rotvec(lens[4:]).as_matrix().T
    from_axis, around = np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2]), np.arctan2(v[:, 1], v[:, 0])
    r = lens[0] * from_axis * (1 + lens[1] * from_axis**2)
    return lens[2:4] + r[:, None] * np.stack([np.cos(around), np.sin(around)], -1)


def fitted(xy: np.ndarray, sun: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
    """The lens and its pose by places (N, 2) px, near others, or for a camera that looks up, whatever its azimuth."""

    def off(lens: np.ndarray) -> np.ndarray:
        return np.concatenate([(places_of(lens, sun) - xy).ravel(), (lens[:4] - LENS) / SPREAD])

    azimuths = np.arange(-np.pi, np.pi, np.pi / 4)
    begun = [[*LENS, 0.0, 0.0, a] for a in azimuths] if near is None else [near]
    fits: list[OptimizeResult] = [
        least_squares(off, b, loss="soft_l1", f_scale=3.0, x_scale=SCALES) for b in begun
    ]
    return min(fits, key=lambda fit: fit.cost).x


def headings(xy: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Errors (N,) rad of the heading of each frame, and px across, by the lens of the others: (N, 2)."""
    errors, whole = [], fitted(xy, sun)
    for k in range(len(xy)):
        lens = fitted(np.delete(xy, k, 0), np.delete(sun, k, 0), whole)
        zenith = places_of(lens, np.array([[0.0, 0.0, 1.0]]))[0]
        way = xy[k] - zenith
        across = (xy[k] - places_of(lens, sun[k : k + 1])[0]) @ [-way[1], way[0]] / np.hypot(*way)
        errors.append((np.arctan2(across, np.hypot(*way)), across))
    return np.array(errors)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the clone")
    folder = parser.parse_args().folder
    for name in SITES:
        every = sights(folder, name)
        seen = [s for s in every if s.found is not None]
        sun = np.array([s.sun for s in seen])
        print(f"{name}: the Sun found in {len(seen)} frames of {len(every)}")
        for who, xy in (
            ("found", np.array([[s.found.x, s.found.y] for s in seen])),
            ("by hand", np.array([s.by_hand for s in seen])),
        ):
            off = xy - places_of(fitted(xy, sun), sun)
            print(f"  {who}: {np.sqrt(np.mean(off**2)):.1f} px rms an axis about the fitted lens")
            if who == "found" and len(seen) >= MIN_FRAMES:
                errors = headings(xy, sun)
                claims = np.array([s.found.covariance[0, 0] ** 0.5 for s in seen])
                rms_deg = np.degrees(np.sqrt(np.mean(errors[:, 0] ** 2)))
                share = np.sqrt(np.mean((errors[:, 1] / claims) ** 2))
                print(f"  headings by the others' lens: {rms_deg:.2f} deg rms, {share:.2f} of the claims")


if __name__ == "__main__":
    main()
