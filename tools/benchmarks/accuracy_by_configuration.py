# SPDX-License-Identifier: Apache-2.0
"""What each inclinometer buys in metres: the table of accuracy by configuration, as Markdown.

Whole nights are simulated and worked as a user would.  Place, date, pointing, mounting (A3), air, clock, Earth rotation
and catalogue are drawn anew for each, and so are the errors of the sensor: noise, zero, drift, temperature, scale, cross
axis, and what is new at each pose.  The instrument knows only their sizes.  Printed are the rms error of one
axis against the astronomic truth, the error that the budget claims, and their ratio squared (1 where claims are true).
"""

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from starpos.averaging.average import average
from starpos.calibration.misalignment import calibrate_at, turn
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.errors import StarposError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument import sensors
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.tilt_log import TiltLog
from starpos.rotation import half_turn
from starpos.simulation.scene import detected, expose, read_tilt
from starpos.sky.catalogue import Catalogue, load_catalogue
from starpos_testing.skies.random_nights import (
    CAMERA,
    EXPOSURE_S,
    LEAN_DEG,
    READINGS,
    SCA100T_CALIBRATED,
    TURN_S,
    NightWorld,
    Zero,
    at_place,
    draw,
    tiltmeter,
)

# GNSS time, PTP or a good NTP server
CLOCK_S = 0.001
SENSORS = {
    "IMU at rest (Bosch BMI088, data sheet)": sensors.presets()["bmi088"],
    "SCA100T-D01 as sold (data sheet)": sensors.presets()["sca100t"],
    "SCL3300, digital, as sold (data sheet)": sensors.presets()["scl3300"],
    "SCA100T, compensated and calibrated": SCA100T_CALIBRATED,
    "tiltmeter of 0.1 arcsec": tiltmeter(0.1),
}
# headings, frames at each, s from frame to frame
GIVEN = {"one frame": (1, 1, 5.0), "a minute": (1, 12, 5.0), "an hour": (1, 30, 120.0)}
TURNED = {"a minute": (4, 3, 5.0), "an hour": (30, 4, 15.0)}
# at each of two leans
CALIBRATED = (4, 6, 5.0)


@dataclass(frozen=True)
class Response:
    """The true response of a sensor: `matrix` (2, 2) times the angles is added to them."""

    errors: InclinometerErrors
    matrix: np.ndarray

    @classmethod
    def drawn(cls, errors: InclinometerErrors, rng: np.random.Generator) -> "Response":
        skew = rng.normal(0, errors.cross)
        off = np.diag(rng.normal(0, errors.scale, 2)) + skew * (1 - np.eye(2))
        return cls(errors, off)


@dataclass(frozen=True)
class Night:
    """What one night gave: errors and claimed sigmas (2,) of east and north in m; `trouble` where it gave nothing."""

    off: np.ndarray
    sigma: np.ndarray
    trouble: str = ""


def photograph(
    world: NightWorld,
    zero: Zero,
    response: Response,
    begin: float,
    shots: tuple[int, int, float],
    rng: np.random.Generator,
    exposure_s: float = EXPOSURE_S,
) -> tuple[list[Stars], list[tuple], list[float]]:
    """Frames at several headings, turned by hand between them; stars, rows of a tilt log, true headings in rad."""
    headings, frames, cadence_s = shots
    stars, rows, faces, now = [], [], [], begin
    # deg C, and deg C per hour
    warmth, trend = rng.normal(0, 2.0), rng.normal(0, 1.0)
    for k in range(headings):
        lean, pose = rng.normal(0, LEAN_DEG, 2), rng.normal(0, 1, 2) * response.errors.pose_rad
        scene = replace(
            world.scene,
            azimuth_deg=world.scene.azimuth_deg + 360 * k / headings,
            altitude_deg=world.scene.altitude_deg + lean[0],
            roll_deg=world.scene.roll_deg + lean[1],
        )
        wrong = pose + response.matrix @ np.array(scene.tilt)
        for _ in range(frames):
            light = expose(scene, world.sky, now, exposure_s, rng)
            stars.append(detected(scene, light, now + exposure_s / 2 + world.clock_s, exposure_s, rng))
            faces.append(scene.heading)
            warm = warmth + trend * (now - begin) / 3600
            off = zero.at(now) + scene.tilt_errors.zero + warm * world.per_c + wrong
            told = replace(scene, tilt_errors=replace(scene.tilt_errors, zero=tuple(off), scale=(0.0, 0.0)))
            for j in range(READINGS):
                moment = now + (j + 0.5) * exposure_s / READINGS + world.clock_s
                rows.append((moment, *read_tilt(told, rng), 15.0 + warm))
            now += cadence_s
        now += TURN_S
    return stars, rows, faces


def log_of(rows: Sequence[tuple], errors: InclinometerErrors) -> TiltLog:
    """The readings as a tilt log."""
    unix_s, theta_x, theta_y, temperature_c = np.array(rows).T
    return TiltLog.of(unix_s, theta_x, theta_y, temperature_c, errors.noise_rad)


def turned(errors: InclinometerErrors, catalogue: Catalogue, rng: np.random.Generator) -> list[Night]:
    """Nights at unknown places of an instrument with unknown A3, one of each length."""
    nights = []
    for shots in TURNED.values():
        world, begin = draw(rng, catalogue, errors, CLOCK_S, CAMERA)
        zero, response = Zero(errors, rng, begin), Response.drawn(errors, rng)
        stars, rows, _ = photograph(world, zero, response, begin, shots, rng)
        solver, tilts = Solver(world.told, catalogue, world.air), log_of(rows, errors)
        nights.append(outcome(partial(turned_fixes, solver, stars, tilts), world))
    return nights


def turned_fixes(solver: Solver, stars: list[Stars], tilts: TiltLog) -> list[Fix]:
    """The fixes of frames at several headings."""
    return turn(solver, stars, tilts).fixes


def given(errors: InclinometerErrors, catalogue: Catalogue, rng: np.random.Generator) -> list[Night]:
    """A night after a calibration at a known place, at two leans and four headings, that evening and elsewhere.

    One answer for each length, all of the same instrument at one place.
    """
    world, begin = draw(rng, catalogue, errors, CLOCK_S, CAMERA)
    zero, response = Zero(errors, rng, begin), Response.drawn(errors, rng)
    stars, rows, _ = photograph(world, zero, response, begin, CALIBRATED, rng)
    lower = replace(world, scene=replace(world.scene, altitude_deg=world.scene.altitude_deg - 5))
    more, readings, _ = photograph(lower, zero, response, begin + 3600, CALIBRATED, rng)
    solver, known = Solver(world.told, catalogue, world.air), log_of(rows + readings, errors)
    try:
        found = calibrate_at(solver, stars + more, known, world.site.place)
    except StarposError as e:
        return [lost(e)] * len(GIVEN)
    ready = replace(solver, instrument=found.instrument)
    later = begin + 7200 + 3600 * rng.uniform(1, 6)
    there = at_place(world, rng, later)
    there = replace(
        there, scene=replace(there.scene, altitude_deg=there.scene.altitude_deg + rng.normal(0, 1.0))
    )
    nights = []
    for shots in GIVEN.values():
        frames, levels, _ = photograph(there, zero, response, later, shots, rng)
        nights.append(outcome(partial(single_fixes, ready, frames, log_of(levels, errors)), there))
        later += 3600
    return nights


def single_fixes(solver: Solver, frames: list[Stars], tilts: TiltLog) -> list[Fix]:
    """The fixes of frames, each by itself."""
    return [s.fix for f in frames if (s := solver.solve(f, tilts)).fix]


def lost(why: StarposError) -> Night:
    """A night without an answer."""
    return Night(np.full(2, np.nan), np.full(2, np.nan), str(why))


def outcome(fixes: Callable[[], list[Fix]], world: NightWorld) -> Night:
    """The average of a night's fixes against its truth."""
    try:
        place = average(fixes())
    except StarposError as e:
        return lost(e)
    phi, lam = np.radians([world.site.latitude_deg, world.site.longitude_deg])
    prime, meridian = curvature_radii_m(phi)
    east, north = half_turn(place.longitude - lam) * prime * np.cos(phi), (place.latitude - phi) * meridian
    return Night(np.array([east, north]), np.sqrt(np.diag(place.covariance)[:2]))


def cell(nights: Sequence[Night]) -> tuple[float, float, float]:
    """The rms error and the rms claim of one axis in m, and the mean of the errors squared over the claims."""
    off, sigma = (np.array([getattr(n, name) for n in nights if not n.trouble]) for name in ("off", "sigma"))
    return (
        float(np.sqrt((off**2).mean())),
        float(np.sqrt((sigma**2).mean())),
        float((off**2 / sigma**2).mean()),
    )


def metres(value: float) -> str:
    """Two digits, in m or km."""
    two = float(f"{value:.2g}")
    return f"{two / 1000:g} km" if two >= 1000 else f"{two:g} m"


def worked(task: tuple) -> list[Night]:
    """The nights of one seed."""
    errors, night, seed = task
    return night(errors, load_catalogue(), np.random.default_rng(seed))


def options(parser) -> None:
    parser.add_argument("--nights", type=int, default=12, metavar="N", help="of each cell (12)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="(1)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")


def run(args) -> int:
    columns = [f"A3 given, {time}" for time in GIVEN] + [f"A3 turned, {time}" for time in TURNED]
    cells: dict[str, list] = {}
    with ProcessPoolExecutor(args.jobs) as pool:
        for row, (name, errors) in enumerate(SENSORS.items()):
            seeds = np.random.SeedSequence([args.seed, row]).spawn(2 * args.nights)
            tasks = [(errors, (given, turned)[k % 2], seed) for k, seed in enumerate(seeds)]
            done = list(pool.map(worked, tasks))
            by_column = [*zip(*done[::2], strict=True), *zip(*done[1::2], strict=True)]
            cells[name] = [cell(nights) for nights in by_column]
            for column, nights in zip(columns, by_column, strict=True):
                if gone := [n.trouble for n in nights if n.trouble]:
                    print(f"{name}, {column}: {len(gone)} nights lost: {gone[0]}", file=sys.stderr)
            print(f"{name}: {cells[name]}", file=sys.stderr, flush=True)
    head = f"| inclinometer | {' | '.join(columns)} |"
    rule = "| --- |" + " --- |" * len(columns)
    print(f"{head}\n{rule}")
    for name, row in cells.items():
        print(f"| {name} | " + " | ".join(metres(c[0]) for c in row) + " |")
    print(f"\nClaimed, and the errors squared over the claims (true claims: 1):\n\n{head}\n{rule}")
    for name, row in cells.items():
        print(f"| {name} | " + " | ".join(f"{metres(c[1])}, {c[2]:.2f}" for c in row) + " |")
    return 0
