# SPDX-License-Identifier: Apache-2.0
"""CPU time of the steps around detection and identification: a message, a fix, an average, a new field, a start.

Where no program of others does the same step, it stands next to a known piece of work
that it cannot do without, or that is as much: a copy of the frame, astropy's places of the same stars, Python's start.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

# CPU time is compared, so each program gets one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from table import Cost, Row, by_turns, spent_ms

from starpos.averaging.average import average
from starpos.cli import main as starpos
from starpos.cli.demo import KNOWN
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.fix.fix import Fix, solve_fix
from starpos.fix.solver import Solver
from starpos.fix.star_fit import MatchedStars
from starpos.frames.exposure import GLOBAL_SHUTTER
from starpos.frames.frame import Frame, Stars
from starpos.identification import triangles
from starpos.instrument.inclinometer import Tilt
from starpos.simulation.scene import Scene, detected, expose, read_tilt, scene_of
from starpos.sky.catalogue import load_catalogue

START_S, EXPOSURE_S, CLOCK_S = 1793642400.0, 0.5, 1e-3
FULL_FRAME = (3744, 5616)
FIXES = 200


class Shot:
    """An exposure of the paper's instrument: its star list, its tilt, and a solver that is warm."""

    def __init__(self, number: int = 0):
        rng, self.scene = np.random.default_rng(number), scene_of()
        start = START_S + 5.0 * number
        light = expose(self.scene, load_catalogue(), start, EXPOSURE_S, rng)
        self.stars: Stars = detected(self.scene, light, start + EXPOSURE_S / 2, EXPOSURE_S, rng)
        x, y = read_tilt(self.scene, rng)
        sigma = self.scene.tilt_errors.noise
        self.tilt = Tilt(x, y, np.eye(2) * sigma**2, utc_unix_s=self.stars.mid_unix_s)
        self.solver = Solver(self.scene.instrument, load_catalogue(), self.scene.site.atmosphere)

    def identify(self):
        """Identify the stars with nothing known."""
        return self.solver.identify(self.stars)

    def fix(self) -> Callable[[], Fix]:
        """The step from identified stars to their fix."""
        found, state = self.identify().found, earth_state(self.stars.mid_unix_s)
        scene: Scene = self.scene
        catalogue, every = self.solver.catalogue, np.ones(len(found.star), bool)
        places = catalogue.directions(found.catalogue, state.year, state.observer_au)
        matched = MatchedStars.of(self.stars, found, every, scene.camera, catalogue, state.year, places)
        about = replace(
            self.solver.circumstances(self.stars, scene.camera, state),
            clock_stddev_s=CLOCK_S,
            shutter=GLOBAL_SHUTTER,
        )
        return partial(solve_fix, matched, self.tilt, about)


def with_astropy(shot: Shot) -> Callable[[], object]:
    """The directions of the same stars above the same place, once, by astropy: a fix needs several such sets."""
    import astropy.units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.time import Time
    from astropy.utils import iers

    # the table that came with astropy will do
    iers.conf.auto_download, iers.conf.auto_max_age = False, None
    catalogue, index = shot.solver.catalogue, shot.identify().found.catalogue
    places = SkyCoord(
        ra=catalogue.ra_mas[index] / 3.6e6 * u.deg, dec=catalogue.dec_mas[index] / 3.6e6 * u.deg
    )
    site, air = shot.scene.site, Atmosphere()
    frame = AltAz(
        obstime=Time(shot.stars.mid_unix_s, format="unix"),
        location=EarthLocation.from_geodetic(site.longitude_deg, site.latitude_deg),
        pressure=air.pressure_pa * u.Pa,
        temperature=air.temperature_c * u.deg_C,
        relative_humidity=air.humidity,
        obswl=0.55 * u.um,
    )
    return lambda: places.transform_to(frame)


def fixes(options) -> Iterator[Row]:
    """One fix, and from a star list to its fix."""
    shot = Shot()
    hint = shot.solver.solve(shot.stars, shot.tilt).hint
    works = {
        "fix": shot.fix(),
        "astropy": with_astropy(shot),
        "solve": lambda: shot.solver.solve(shot.stars, shot.tilt),
        "hinted": lambda: shot.solver.solve(shot.stars, shot.tilt, hint),
    }
    ms = by_turns(works, options.rounds)
    number = len(shot.identify().names)
    peer, theirs = f"astropy: {number} stars to AltAz, once", Cost(ms["astropy"])
    yield Row(f"one fix (`solve_fix`), {number} stars", Cost(ms["fix"]), peer, theirs)
    yield Row("a star list to its fix, the first", Cost(ms["solve"]), peer, theirs)
    yield Row("a star list to its fix, the next", Cost(ms["hinted"]), peer, theirs)


def averages(options) -> Iterator[Row]:
    """The average of many fixes, for each of them."""
    fix = Shot().fix()()
    many = [replace(fix, utc_unix_s=fix.utc_unix_s + 5.0 * k) for k in range(FIXES)]
    one = Shot().fix()
    ms = by_turns({"average": lambda: average(many), "fix": one}, options.rounds)
    yield Row("averaging, a fix", Cost(ms["average"] / FIXES), "making the fix", Cost(ms["fix"]))


def messages(options) -> Iterator[Row]:
    """A frame of 42 MB into a message; left out without ROS."""
    if importlib.util.find_spec("sensor_msgs") is None:
        print(
            "a frame into a message: skipped, ROS is not here (make build, . tools/env.sh)", file=sys.stderr
        )
        return
    from starpos_common.messages import frame_to_message

    pixels = np.random.default_rng(1).integers(0, 65535, FULL_FRAME, np.uint16)
    frame = Frame(pixels, mid_unix_s=START_S, exposure_s=EXPOSURE_S)
    works = {"message": lambda: frame_to_message(frame, "camera"), "copy": pixels.tobytes}
    ms = by_turns(works, options.rounds)
    yield Row("a 42 MB frame into a message", Cost(ms["message"]), "a copy into new memory", Cost(ms["copy"]))


def new_field(options) -> Iterator[Row]:
    """The triangles of a field that was never used, next to a sort of as many numbers."""
    catalogue, half = load_catalogue(), Shot().scene.camera.half_diagonal_rad
    made: list = []
    ms = spent_ms(lambda: made.append(triangles.build(catalogue, half)))
    number = len(made[-1].corners)
    numbers = np.random.default_rng(1).random(number)
    sort = spent_ms(lambda: np.sort(numbers))
    yield Row(
        f"first use of a field, {number / 1e6:.1f} million triangles",
        Cost(ms),
        "sorting as many numbers",
        Cost(sort),
    )


def night(folder: Path) -> tuple[str, ...]:
    """Write a star list and its tilt; the arguments of `starpos` that solve it."""
    optics = ("--focal-mm", "600", "--pixel-um", "6.4")
    starpos(["simulate", str(folder / "night"), "-n", "1", "--stars-only", *optics])
    [stars] = (folder / "night").glob("stars_*.csv")
    tilt = ("--tilt", str(folder / "night" / "tilt.csv"))
    return ("solve", str(stars), *tilt, *optics, *KNOWN, "--json")


def starts(options) -> Iterator[Row]:
    """From nothing to the first answer of `starpos solve`, its tables in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = night(Path(folder))
        run = partial(subprocess.run, check=True, stdout=subprocess.DEVNULL)
        works = {
            "solve": lambda: run([sys.executable, "-m", "starpos", *arguments]),
            "help": lambda: run([sys.executable, "-m", "starpos", "--help"]),
            "numpy": lambda: run([sys.executable, "-c", "import numpy"]),
        }
        ms = by_turns(works, options.rounds)
    beside = "`python -c 'import numpy'`", Cost(ms["numpy"])
    yield Row("start to the first answer, `starpos solve` of a star list", Cost(ms["solve"]), *beside)
    yield Row("`starpos --help`", Cost(ms["help"]), *beside)


def rows(options) -> Iterator[Row]:
    """The rows of bench.py."""
    for step in (fixes, averages, messages, starts):
        yield from step(options)
    if not options.quick:
        yield from new_field(options)
