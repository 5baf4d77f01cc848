# SPDX-License-Identifier: Apache-2.0
"""CPU time and error of `starpos deflection` for stations of 24 minutes: whole commands, from star lists.

A station: 192 star lists in four faces, two rounds, under a lens of 600 mm; five readings of the tiltmeter a frame.
Centroids scatter by 0.09 px.  `--motion 0 --places 30`: still air, and stars 30 mas from their places in the catalogue.
"""

import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.instrument.camera import Camera
from starpos.sky import catalogue
from starpos.sky.site import Site
from starpos.units import ARCSEC, MAS, utc_text

FACES, FRAMES, CADENCE_S, TURNING_S, LIMIT_MAG = 8, 24, 5.0, 60.0, 9.8
NOISE, LEAN, SCATTER_PX = 0.1 * ARCSEC, 10 * ARCSEC, 0.09
CAMERA, AIR = Camera.from_focal(5616, 3744, 93750.0), ("--pressure-hpa", "900", "--temperature-c", "10")
INSTRUMENT = f"""starpos_instrument: 1
camera: {{focal_mm: 600, pixel_um: 6.4}}
tilt_noise_deg: {np.degrees(NOISE):.9f}
tilt_quantum_deg: 1.0e-9
tilt_drift_arcsec_per_sqrt_hour: 0.01
tilt_temperature_arcsec_per_c: 0
tilt_scale: 1.0e-4
clock_stddev_s: 1.0e-4
shutter: {{readout_s: 0, readout_stddev_s: 0}}
"""


def station(folder: Path, seed: int, motion: float, places: float) -> tuple[np.ndarray, list[str]]:
    """Write a station's star lists, tilts and instrument; its xi and eta in arcsec, and the options of the command.

    motion: 1 sigma of a frame's image motion, rad.  places: of a star's place along each axis of ICRS, rad.
    """
    rng, stars = np.random.default_rng(seed), catalogue.load_catalogue()
    displaced = rng.normal(0, places, (len(stars), 3))
    latitude, longitude = np.degrees(np.arcsin(rng.uniform(-0.9, 0.9))), rng.uniform(-180, 180)
    xi, eta = rng.normal(0, 6, 2)
    cosine, begin = np.cos(np.radians(latitude)), rng.uniform(1.70e9, 1.76e9)
    air = Atmosphere(pressure_pa=90_000.0, temperature_c=10.0)
    site = Site(latitude + xi / 3600, longitude + eta / 3600 / cosine, air)
    a3 = rotation.about_axis(2, np.radians(rng.normal(0, 4))) @ rotation.from_vector(
        [*rng.normal(0, 0.002, 2), 0.0]
    )
    rows, at = ["utc_unix_s,theta_x_deg,theta_y_deg"], begin
    for face in range(FACES):
        level = rotation.from_vector([*rng.normal(0, LEAN, 2), 0.0])
        sensor = level @ rotation.about_axis(2, np.radians(90.0 * face + rng.normal()))
        for k in range(FRAMES):
            at += CADENCE_S
            theta = np.degrees(np.arcsin(sensor[:2, 2]) + rng.normal(0, NOISE, (5, 2)))
            rows += [f"{at - 0.2 + 0.1 * j:.3f},{x:.9f},{y:.9f}" for j, (x, y) in enumerate(theta)]
            moved = rotation.from_vector([*rng.normal(0, motion, 2), 0.0])
            write_list(
                folder / f"stars_{face}_{k:02d}.csv", stars, displaced, site, at, a3.T @ sensor @ moved, rng
            )
        at += TURNING_S
    (folder / "tilt.csv").write_text("\n".join(rows) + "\n")
    (folder / "instrument.yaml").write_text(INSTRUMENT)
    given = [
        "--tilt",
        "tilt.csv",
        "--site",
        f"{latitude:.9f}",
        f"{longitude:.9f}",
        "500",
        "--instrument",
        "instrument.yaml",
    ]
    return np.array([xi, eta]), [*given, *AIR]


def write_list(path, stars, displaced: np.ndarray, site, at: float, axes: np.ndarray, rng) -> None:
    """Write the stars that a camera with these axes (3, 3), rows in east, north, up, sees."""
    state = earth_state(at)
    index = site.overhead(stars, state, axes[2], CAMERA.half_diagonal_rad, LIMIT_MAG)
    seen = site.refracted(
        rotation.normalised(stars.directions(index, state.year, state.observer_au) + displaced[index]), state
    )
    xy = CAMERA.project(seen @ axes.T) + rng.normal(0, SCATTER_PX, (len(index), 2))
    on = ((xy > 2) & (xy < [CAMERA.width - 3, CAMERA.height - 3])).all(1)
    flux = 10 ** (-0.4 * (stars.vmag(index) - 14))
    head = {
        "DATE-OBS": utc_text(at - 0.25).rstrip("Z"),
        "EXPTIME": 0.5,
        "NAXIS1": CAMERA.width,
        "NAXIS2": CAMERA.height,
    }
    text = "\n".join(f"{x:.4f},{y:.4f},{f:.2f},{SCATTER_PX}" for x, y, f in np.column_stack([xy, flux])[on])
    path.write_text(f"# {json.dumps(head)}\nx,y,flux,sigma\n{text}\n")


def options(parser) -> None:
    parser.add_argument("-n", "--stations", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--motion", type=float, default=0.4, metavar="ARCSEC")
    parser.add_argument("--places", type=float, default=0.0, metavar="MAS")


def run(args) -> int:
    spent, errors, nees = [], [], []
    for seed in range(args.seed, args.seed + args.stations):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            true, given = station(folder, seed, args.motion * ARCSEC, args.places * MAS)
            frames = sorted(p.name for p in folder.glob("stars_*.csv"))
            command = [
                sys.executable,
                "-m",
                "starpos",
                "deflection",
                *frames,
                *given,
                "--jobs",
                "1",
                "--json",
            ]
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, check=True, text=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        whole = json.loads(done.stdout.splitlines()[-1])
        error = np.array([whole["xi_arcsec"], whole["eta_arcsec"]]) - true
        errors.append(error)
        nees.append(error @ np.linalg.solve(whole["covariance_arcsec2"], error))
        print(
            f"station {seed}: {spent[-1]:.1f} s, xi {error[0]:+.3f}, eta {error[1]:+.3f} arcsec off",
            flush=True,
        )
    mean = float(np.mean(spent))
    print(
        f"{len(spent)} stations of {FACES * FRAMES} star lists: {mean:.1f} s of CPU each (most {max(spent):.1f}), "
        f"1000 take {mean * 1000 / 2 / 60:.0f} min on two cores; error {np.sqrt(np.mean(np.square(errors))):.3f} arcsec "
        f"a component, NEES {np.mean(nees):.2f}"
    )
    return 0
