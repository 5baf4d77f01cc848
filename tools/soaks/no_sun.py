# SPDX-License-Identifier: Apache-2.0
"""Frames by day without the Sun: clouds, lamps, walls, globes, trees, panes. None may have a heading.

Each is of a scene that is drawn anew, by a camera of 25 mm without a filter or a fisheye, whose level and place are
known while the Sun stands 15 to 70 deg high. Its camera at rest takes another one a quarter of an hour later. A lamp may
be as high as the Sun, to the errors of level and glow: such frames are counted as `as_high`. One that has a heading is a
fault. Exit status 1 where there was one. Needs no ROS.
"""

import json
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
from runner import Progress

from starpos import rotation
from starpos.detection.discs import find_disc
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.fix.glows import Glows
from starpos.fix.solver import Solver
from starpos.fix.sun import by_sun
from starpos.frames.frame import no_stars
from starpos.instrument.camera import EQUIDISTANT
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.sky.bodies import SUN, body_at
from starpos.sky.catalogue import load_catalogue
from starpos.sky.site import camera_to_enu
from starpos.units import ARCSEC

BEGIN_UNIX_S, DAYS = 1_735_689_600.0, 700
MIN_ALTITUDE, MAX_ALTITUDE = np.radians(15), np.radians(70)
# what the level and A3 err by: as stated
POSE, A3_ARCSEC = 72 * ARCSEC, 60.0
SECONDS = 900.0
ERRORS = InclinometerErrors(pose_rad=POSE, quantum_rad=0.0, drift_rad_per_sqrt_hour=0.0, scale=0.0)
# size (rows, columns), focal length px, lens, how its camera leans in its level
NARROW = (608, 968), 2133.0, None, -45.0
FISHEYE = (800, 800), 800 / np.pi, EQUIDISTANT, 0.0


def _noise(shape, rng, coarse) -> np.ndarray:
    """A smooth random field of unit variance."""
    rows, columns = (max(2, int(s / coarse) + 2) for s in shape)
    field = cv2.resize(rng.standard_normal((rows, columns)), shape[::-1], interpolation=cv2.INTER_CUBIC)
    return (field - field.mean()) / field.std()


def clouds(shape, rng) -> np.ndarray:
    size = rng.uniform(20, 250)
    field = sum(_noise(shape, rng, size / 2**k) / 1.6**k for k in range(5))
    return rng.uniform(60, 180) + rng.uniform(30, 150) * field


def overcast(shape, rng) -> np.ndarray:
    """The Sun behind a cloud so thick that only a patch is brighter."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    at, wide = rng.uniform(0, shape), rng.uniform(40, 300)
    patch = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / 2 / wide**2 * (1 + 0.3 * _noise(shape, rng, 60)))
    return 90 + rng.uniform(60, 250) * patch + 12 * _noise(shape, rng, 40)


def lamps(shape, rng) -> np.ndarray:
    """One lamp or several, some behind glass, by a dark or a bright sky."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    light = rng.choice([5.0, 40.0, 90.0]) + 6 * _noise(shape, rng, 80)
    for _ in range(rng.integers(1, 6)):
        at, wide, bright = rng.uniform(0, shape), rng.uniform(1, 15), 10 ** rng.uniform(2.3, 4)
        light += bright / (1 + ((y - at[0]) ** 2 + (x - at[1]) ** 2) / wide**2) ** rng.uniform(1.0, 2.0)
    return light


def walls(shape, rng) -> np.ndarray:
    light = np.full(shape, rng.uniform(20, 200))
    for _ in range(rng.integers(1, 8)):
        corner, side = rng.uniform(0, shape), rng.uniform(10, 500, 2)
        box = cv2.boxPoints((tuple(corner[::-1]), tuple(side), float(rng.uniform(0, 90)))).astype(np.int32)
        light = cv2.fillPoly(light, [box], rng.uniform(5, 300))
    return cv2.GaussianBlur(light, (0, 0), rng.uniform(0.6, 3)) * (1 + 0.05 * _noise(shape, rng, 30))


def globes(shape, rng) -> np.ndarray:
    """Round lamps, plates and wheels with a limb."""
    light = np.full(shape, rng.uniform(5, 100))
    for _ in range(rng.integers(1, 4)):
        at, axes = (
            rng.uniform(0, shape)[::-1],
            rng.uniform(4, 120) * np.array([1, rng.choice([1.0, 0.9, 0.6])]),
        )
        light = cv2.ellipse(
            light, (tuple(at), tuple(2 * axes), float(rng.uniform(0, 180))), rng.uniform(120, 400), -1
        )
    return cv2.GaussianBlur(light, (0, 0), rng.uniform(0.6, 2)) * (1 + 0.03 * _noise(shape, rng, 50))


def trees(shape, rng) -> np.ndarray:
    """Bright sky through branches."""
    field = sum(_noise(shape, rng, 60 / 2**k) / 1.3**k for k in range(5))
    sky = rng.uniform(150, 400) * (1 + 0.2 * _noise(shape, rng, 200))
    return np.where(field > rng.uniform(0.0, 2.0), sky, rng.uniform(5, 40))


def reflections(shape, rng) -> np.ndarray:
    """The Sun in panes and water: glints, stretched, with rays."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    light = walls(shape, rng)
    for _ in range(rng.integers(1, 4)):
        at, wide, turn = rng.uniform(0, shape), rng.uniform(1, 10, 2), rng.uniform(0, np.pi)
        dy, dx = y - at[0], x - at[1]
        u, v = (
            (dx * np.cos(turn) + dy * np.sin(turn)) / wide[0],
            (dy * np.cos(turn) - dx * np.sin(turn)) / wide[1],
        )
        light += 10 ** rng.uniform(2.5, 4) / (1 + u**2 + v**2) ** 1.3
        light += rng.uniform(0, 200) * np.exp(-((np.abs(u * v)) ** 0.5) * 3)
    return light


SCENES = clouds, overcast, lamps, walls, globes, trees, reflections


def seen(light: np.ndarray, shape, fisheye: bool, rng) -> np.ndarray:
    """The frame of 8 bits that a camera takes of a scene; a fisheye's picture is round."""
    if fisheye:
        y, x = np.mgrid[: shape[0], : shape[1]]
        light = np.where(np.hypot(y - shape[0] / 2, x - shape[1] / 2) < shape[0] / 2, light, 2.0)
    light = np.clip(light, 1, None)
    return (light + rng.standard_normal(shape) * np.sqrt(light)).clip(0, 255).astype(np.uint8)


def solver_of(focal_px: float, model: str | None, lean_deg: float) -> Solver:
    instrument = Instrument(
        focal_px,
        calibration=Calibration.of((lean_deg, 0.0, 0.0), (A3_ARCSEC,) * 3),
        inclinometer=ERRORS,
        clock_stddev_s=0.02,
        **({} if model is None else {"model": model}),
    )
    return Solver(instrument, load_catalogue(), Atmosphere.measured(90_000.0, 15.0))


def a_day(rng) -> tuple[Place, float, np.ndarray]:
    """A place, a time, and the Sun's direction there."""
    while True:
        place = Place.on_ellipsoid(rng.uniform(-60, 60), rng.uniform(-180, 180))
        when = BEGIN_UNIX_S + rng.uniform(0, DAYS * 86400)
        sun = place.plumb_axes @ body_at(SUN, earth_state(when)).from_place(place.plumb_axes[2])
        if MIN_ALTITUDE < np.arcsin(sun[2]) < MAX_ALTITUDE:
            return place, when, sun


def options(parser) -> None:
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--seed", type=int, default=1)


def run(args) -> int:
    solvers = {c: solver_of(*c[1:]) for c in (NARROW, FISHEYE)}
    tally, progress = {}, Progress(args.scenes, "scenes")
    for number in range(args.first, args.first + args.scenes):
        rng = np.random.default_rng([args.seed, number])
        scene, kind = SCENES[number % len(SCENES)], (NARROW, FISHEYE)[number // len(SCENES) % 2]
        shape, _, model, lean = kind
        place, when, sun = a_day(rng)
        azimuth, altitude = np.degrees([np.arctan2(sun[0], sun[1]), np.arcsin(sun[2])])
        # towards the Sun, as a person who wants a heading would
        aimed = (
            (rng.uniform(0, 360), 90.0 - rng.uniform(0, 3))
            if model
            else (azimuth, altitude + rng.uniform(-5, 5))
        )
        up = (
            rotation.about_axis(0, np.radians(lean))
            @ camera_to_enu(*aimed, rng.uniform(0, 360) if model else 0.0)[2]
        )
        tilt = Tilt(*np.arcsin(up[:2]), np.eye(2) * (30 * ARCSEC) ** 2, utc_unix_s=when)
        disc = find_disc(seen(scene(shape, rng), shape, model is not None, rng))
        counts = tally.setdefault(f"{scene.__name__} {'fisheye' if model else 'narrow'}", Counter())
        counts["scenes"] += 1
        if disc is not None:
            counts["limb" if disc.sharp else "glow"] += 1
            glows = Glows()
            for late_s in (0.0, SECONDS):
                stars = replace(no_stars(*shape[::-1], mid_unix_s=when + late_s, exposure_s=0.0), disc=disc)
                now = replace(tilt, utc_unix_s=when + late_s)
                answer = by_sun(solvers[kind], stars, disc, now, place)
                counts["as_high"] += answer.at_place is not None
                if answer.beside(glows).at_place is not None:
                    counts["headings"] += 1
                    print(f"seed {args.seed} scene {number} {scene.__name__} {shape}", flush=True)
        progress.at(number - args.first + 1, json.dumps(sum(tally.values(), Counter())))
    for name, counts in sorted(tally.items()):
        print(f"{name:24s}", json.dumps(dict(counts)))
    return int(sum(tally.values(), Counter())["headings"] > 0)
