# SPDX-License-Identifier: Apache-2.0
"""`starpos first-night`: from nothing to a saved A3, live, with what to do next after each frame."""

import argparse
import sys
import time
from pathlib import Path

from starpos.cli import console, doctor, options, overwriting
from starpos.cli.inputs import given_of, reader_of
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, TiltError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frames.tables import TILTS
from starpos.instrument import instrument_file
from starpos.instrument.tilt_log import BRACKET_S, TiltLog
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.night import field
from starpos.night.first_night import AROUND_S, LEVEL, FirstNight, Look
from starpos.night.opening import exposures, frames_in
from starpos.night.reading import Instruments, stars_of
from starpos.night.work import Solving
from starpos.sky import catalogue
from starpos.units import utc_text

POLL_S = 0.5
# A file that cannot be read may still be written for so long.
WRITTEN_S = 10.0
# Tilts may come so long after their frame.
TILTS_S = 4.0
AGAIN = "the same command goes on where it was"


def run(args: argparse.Namespace) -> int:
    overwriting.check(args, save=instrument_file.check_replaceable)
    folder = Path(args.folder)
    if not folder.is_dir():
        raise FrameError(
            f"{folder}: there is no such folder: make it, and have frames and {TILTS} arrive there"
        )
    if args.field is not None:
        field.check_name(args.field)
    try:
        night, given = _watched(args, folder)
    except KeyboardInterrupt:
        console.complain(f"stopped: {AGAIN}")
        return console.NOTHING
    found = None if night is None else night.turned
    if found is None:
        console.complain(f"no frame has come for {args.patience:g} s, and A3 is not known yet: {AGAIN}")
        return console.NOTHING
    overwriting.save_instrument(args.save, found.instrument, "A3 by the first night")
    print(f"done: {args.save} is written -> starpos solve FRAMES --tilt {TILTS} --instrument {args.save}")
    if args.field is not None:
        packed = exposures(folder, given, options.atmosphere_of(args), Deflection(), read=reader_of(args))
        count = field.write(Path(args.field), packed)
        print(f"done: {args.field} holds {count} frames -> attach it to an issue `It ran on hardware`")
    return 0


def _watched(args: argparse.Namespace, folder: Path) -> tuple[FirstNight | None, Instruments]:
    """Take frames as they come, until the last step is done or none has come for long."""
    night: FirstNight | None = None
    read = reader_of(args)
    given = Instruments(None)
    seen: set[Path] = set()
    waited = time.monotonic()
    while True:
        new = [path for path in _frames(folder) if path not in seen]
        for path in new:
            try:
                item = read(str(path))
            except FrameError as error:
                if time.time() < path.stat().st_mtime + WRITTEN_S:
                    break
                console.complain(error)
                seen.add(path)
                continue
            seen.add(path)
            waited = time.monotonic()
            if night is None:
                given = given_of(args, item)
                air = options.atmosphere_of(args)
                night = FirstNight(Solver(options.instrument_of(args, item), catalogue.load_catalogue(), air))
            sight = Solving(given)(item)
            step = night.step
            look = night.inspect(sight, _tilts(folder, night, stars_of(item)))
            _tell(step, look, sight.stars)
            if not night.step:
                return night, given
        if time.monotonic() - waited > args.patience:
            return night, given
        time.sleep(POLL_S)


def _frames(folder: Path) -> list[Path]:
    try:
        return frames_in(folder)
    except FrameError:
        return []


def _tilts(folder: Path, night: FirstNight, stars: Stars) -> TiltLog | str:
    """The tilts up to some time after the frame, which are waited for; or why they are missing."""
    end_s = (stars.mid_unix_s or 0.0) + max((stars.exposure_s or 0.0) / 2, AROUND_S)
    begin = time.monotonic()
    while True:
        try:
            log = read_tilt_csv(folder / TILTS, night.instrument.inclinometer.noise_rad)
        except TiltError as error:
            if time.monotonic() > begin + TILTS_S:
                return str(error)
        else:
            if log.utc_unix_s[-1] > end_s or time.monotonic() > begin + TILTS_S:
                return log.until(end_s + BRACKET_S)
        time.sleep(POLL_S)


def _tell(step: str, look: Look, stars: Stars) -> None:
    """Print what a step found, and after the level the clock."""
    at = utc_text(stars.mid_unix_s)[11:19] if stars.mid_unix_s else "--:--:--"

    def line(mark: str, what: str, found: str, todo: str) -> None:
        advice = f"\n{'':12}-> {todo}" if todo else ""
        print(f"{at} {mark} {what:<9}{found}{advice}", flush=True)

    line("ok" if look.done else "..", step, look.found, look.todo)
    if look.done and sys.stdout.isatty():
        print("\a", end="", flush=True)
    if look.done and step == LEVEL:
        clock = doctor.clock()
        line("ok" if clock.state is doctor.State.OK else "!!", "clock", clock.found, clock.cure)
