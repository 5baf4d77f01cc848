# SPDX-License-Identifier: Apache-2.0
"""Frames made of two different skies: no answer may be wrong unless it is flagged.

Each frame has 10 to 90 % of one sky and the rest of another. The share is of the exposure, so that all stars of both are
there but fainter, or of the stars themselves. The other sky is any, or as seen by a camera that was turned by less than
a field. The errors of the centroids, the faintest star and the field of view vary. An answer is bad if it is neither one
of the two skies nor has a warning. Exit status: 1 where there was one. Needs no ROS.
"""

import json
from collections import Counter

import numpy as np
from runner import Progress

from starpos import rotation
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.simulation.montecarlo_fields import Conditions, Field, blended
from starpos.sky.catalogue import Catalogue, load_catalogue

# a narrow and a wide field: size px, focal length px, limits of the faintest star
CAMERAS = ((1872, 1248, 31250.0, (8.0, 10.5)), (1400, 1050, 6500.0, (5.5, 8.0)))
SIGMAS_PX = 0.05, 0.3, 1.0
# an answer is one of the two skies if its centre is so near, in px or in errors of a centroid
NEAR_PX, NEAR_SIGMA = 3.0, 4.0


def sky_of(
    catalogue: Catalogue, c: Conditions, attitude: np.ndarray, faint_mag: float, rng: np.random.Generator
) -> Field:
    """The stars of a frame of this attitude, all of them fainter by faint_mag; its centre is the attitude's third row."""
    index = catalogue.cone(attitude[2], c.camera.half_diagonal_rad * 1.01, c.limit_mag + 4 * c.scatter_mag)
    xy = c.camera.project(catalogue.directions(index) @ attitude.T)
    mag = catalogue.vmag(index) + rng.normal(0, c.scatter_mag, len(index)) + faint_mag
    seen = (xy > 0).all(1) & (xy < [c.camera.width - 1, c.camera.height - 1]).all(1) & (mag < c.limit_mag)
    return Field(xy[seen], mag[seen], attitude[2], "")


def two_skies(catalogue: Catalogue, seed: int, number: int) -> tuple[Stars, Camera, list[np.ndarray], str]:
    """The stars of frame `number`, its camera, the centres (3,) of both skies, and what it is."""
    rng = np.random.default_rng([seed, number])
    width, height, focal_px, limits = CAMERAS[rng.integers(len(CAMERAS))]
    camera = Camera.from_focal(width, height, focal_px)
    sigma_px = float(rng.choice(SIGMAS_PX))
    c = Conditions(camera=camera, limit_mag=rng.uniform(*limits), sigma_px=sigma_px)
    first = rotation.best_rotation(rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3, 3)))[0]
    near = bool(rng.integers(2))
    if near:
        turn = np.exp(rng.uniform(np.log(4 / focal_px), np.log(camera.half_diagonal_rad)))
        axis = rotation.normalised(np.append(rng.normal(size=2), rng.normal() * rng.integers(2)))
        second = rotation.from_vector(turn * axis) @ first
    else:
        second = rotation.best_rotation(rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3, 3)))[0]
    share, exposure = rng.uniform(0.1, 0.9), bool(rng.integers(2))
    parts = []
    for attitude, part in ((first, share), (second, 1 - share)):
        sky = sky_of(catalogue, c, attitude, -2.5 * np.log10(part) if exposure else 0.0, rng)
        seen = rng.random(len(sky)) < (1 - c.missing if exposure else part)
        parts.append(Field(sky.xy[seen], sky.mag[seen], sky.centre, ""))
    xy = np.concatenate([p.xy for p in parts])
    xy, mag = blended(
        xy + rng.normal(0, sigma_px, xy.shape), np.concatenate([p.mag for p in parts]), c.blend_px
    )
    kind = f"{'near' if near else 'any'} {'exposure' if exposure else 'stars'} {sigma_px:g} px"
    name = f"seed {seed} frame {number}, {kind}, share {share:.2f}"
    return Field(xy, mag, None, name).stars(c), camera, [first[2], second[2]], kind


def options(parser) -> None:
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--first", type=int, default=0, help="number of the first frame")
    parser.add_argument("--seed", type=int, default=1)


def run(args) -> int:
    catalogue, tally, progress = load_catalogue(), {}, Progress(args.frames, "frames")
    for number in range(args.first, args.first + args.frames):
        stars, camera, centres, kind = two_skies(catalogue, args.seed, number)
        s = Solver(Instrument(camera.fx), catalogue).identify(stars)
        verdict = "none"
        if s.pointing is not None:
            ra, dec = s.pointing.ra, s.pointing.dec
            centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
            # stars of both that coincide draw the pose of one towards the other
            allowed = max(NEAR_PX, NEAR_SIGMA * float(np.median(stars.sigma))) / camera.fx
            right = min(np.linalg.norm(centre - c) for c in centres) < allowed
            verdict = ("right" if right else "wrong") + (", flagged" if s.warnings else "")
            if verdict == "wrong":
                away = min(np.linalg.norm(centre - c) for c in centres) * camera.fx
                about = f"{len(s.names)} of {len(stars)} stars, {away:.1f} px off"
                print(f"BAD {stars.source}: {about}, log-odds {s.pointing.log_odds:.0f}", flush=True)
        tally.setdefault(kind, Counter())[verdict] += 1
        progress.at(number - args.first + 1, json.dumps(sum(tally.values(), Counter())))
    for kind, counts in sorted(tally.items()):
        print(f"{kind:24s}", json.dumps(dict(counts)))
    whole = sum(tally.values(), Counter())
    print(json.dumps({"frames": args.frames} | dict(whole)))
    return int(whole["wrong"] > 0)
