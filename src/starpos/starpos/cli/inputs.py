# SPDX-License-Identifier: Apache-2.0
"""What commands work on: frames, nights, bags, their instrument and tilts; and the workers that do it."""

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.cli import console, options
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, InstrumentError, StarposError, TiltError, named
from starpos.fix.blind import BlindSolver
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.searching import Sight
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Frame, Stars, no_stars
from starpos.frames.reading import are_photographs, read_frame, why_no_time
from starpos.frames.tables import TILTS, TRUTH
from starpos.instrument.camera import PLUMB_BOB, Camera
from starpos.instrument.instrument import ByGravity, Instrument
from starpos.night.opening import frames_in, work_of
from starpos.night.reading import Each, Instruments, Reader, TiltFile
from starpos.night.remarks import NEAR_KM, Near, of_tilts
from starpos.night.work import Solving, prepare
from starpos.parallel.processes import DoCalls, memory_bytes, processors, workers
from starpos.sky import catalogue

if TYPE_CHECKING:
    from starpos.night.solving import Exposures


# the word of --exif-utc-offset that lets each file say it
FILES_OWN = "file"


def reader_of(args: argparse.Namespace, by_files: bool = False) -> Reader:
    """The reader of frames with the clock and the delay of their shutter that the options give.

    by_files: without a clock by the options, each file's own counts, as its EXIF states it.
    """
    offset_h, clock = args.exif_utc_offset, CameraClock() if by_files else None
    if offset_h is not None:
        clock = CameraClock(None if offset_h == FILES_OWN else offset_h, args.exif_clock_stddev)
    return Reader(clock, tuple(args.shutter_delay or (0.0, 0.0)))


def given_of(args: argparse.Namespace, first: Frame | Stars | None) -> Instruments:
    """The instrument of each frame; the focal length is from its header unless the options give one.

    Raises InstrumentError if the options do not fit together, or the first frame has no focal length either.
    """
    return Instruments(
        options.instrument_of(args, first), by_header=(args.instrument, args.focal_mm) == (None, None)
    )


def given_or_sought(args: argparse.Namespace, first: Stars) -> Instruments:
    """Instruments as by `given_of`; where nothing states the focal length, it is sought by the stars of each lens."""
    if first.focal_px is not None or not is_untold(args):
        return given_of(args, first)
    stand_in = replace(first, focal_px=float(max(first.width, first.height)))
    return Instruments(options.instrument_of(args, stand_in), by_header=True, sought=True)


def is_untold(args: argparse.Namespace) -> bool:
    """Whether the options say nothing of the camera."""
    return (args.instrument, args.focal_mm, args.pixel_um) == (None,) * 3 and args.lens == PLUMB_BOB


@dataclass(frozen=True)
class FrameAtPlace:
    """A frame whose attitude at a known place is known, and its camera with the focal length that its stars show."""

    item: Frame | Stars
    sight: Sight
    at_place: AttitudeAtPlace
    camera: Camera


def seen_at(args: argparse.Namespace, place: Place) -> Iterator[FrameAtPlace]:
    """Frames with their attitudes at a place.

    Frames without an attitude are complained about.  Raises StarposError as `solve` does.
    """
    read = reader_of(args)
    about = read.one_of(args.frames)
    work, remarks = work_of(given_or_sought(args, about), about, None, options.atmosphere_of(args), place)
    console.complain(*remarks)
    if work.instruments.sought:
        BlindSolver(catalogue.load_catalogue(), console.ProgressBar()).prepare()
    for path in args.frames:
        try:
            item = read(path)
        except FrameError as e:
            console.complain(e)
            continue
        sight = work(item)
        answer, at_place = sight.solution, sight.solution.at_place
        if at_place is None or answer.found is None:
            timed = answer.found is None or item.mid_unix_s
            no_time = f"{item.place}: no time of exposure: {why_no_time(item)}"
            console.complain(named(item.place, answer.message) if timed else no_time)
            continue
        instrument = sight.instrument or work.instruments.of(item)
        assert instrument is not None
        camera = instrument.camera_for(item.width, item.height, item.origin_px)
        yield FrameAtPlace(
            item, sight, at_place, camera.scaled(answer.found.focal_scale * at_place.focal_scale)
        )


def identifying(args: argparse.Namespace, frames: Sequence[str], read: Reader, search_s: float) -> Solving:
    """The work that identifies frames with the camera of the options, else of their headers, else of any scale."""
    about = read.first(frames)
    given = Instruments(None, by_header=True)
    if about is not None:
        if about.focal_px is not None or not is_untold(args):
            given = given_of(args, about)
        console.complain(prepare(given, about, console.ProgressBar()))
    # without a frame that can be read, each one reports why it cannot
    return Solving(given, search_s=search_s, progress=console.ProgressBar())


def checked_tilts(path: str, instrument: Instrument) -> TiltFile:
    """The table of tilts, with a complaint where its steps are coarse; raises TiltError, also for radians."""
    file = TiltFile(path, instrument.inclinometer.noise_rad)
    console.complain(of_tilts(file.log, path, instrument.inclinometer))
    return file


def near_of(args: argparse.Namespace) -> Near | None:
    """The place of --near; None without it.  Raises InstrumentError."""
    if args.near is None:
        return None
    latitude, longitude = args.near
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        raise InstrumentError(f"--near {latitude:g} {longitude:g}: give latitude and longitude in deg")
    km = NEAR_KM if args.near_km is None else args.near_km
    if not 0 < km <= 20_000:
        raise InstrumentError(f"--near-km {km:g}: give a distance above 0 and at most 20000")
    return Near(math.radians(latitude), math.radians(longitude), km)


@dataclass(frozen=True)
class NightFolder:
    """Frames with one table of tilts that make one fix together.

    tilt: absolute path, or that photographs have their own; None where none is needed.
    folder: None if the frames were named one by one.
    """

    frames: tuple[str, ...]
    tilt: Path | ByGravity | None
    folder: str | None = None


def frames_among(given: list[str], *tables: str | None) -> list[str]:
    """The frames among files that a shell's *.csv, or *, has taken in: without tables, tilt.csv and truth.json.

    Other files stay, and each one reports why it is not a frame.
    """
    beside = {os.path.realpath(table) for table in tables if table is not None}
    frames = [
        p for p in given if os.path.basename(p) not in (TILTS, TRUTH) and os.path.realpath(p) not in beside
    ]
    return frames or given


def nights_of(
    given: list[str], tilt: str | None, needs_no_tilt: bool = False
) -> list[NightFolder | FrameError]:
    """One night from frames and a table, or without one for photographs, a fixed camera, or a known place.

    Else a night for each folder, or its error.

    `opening.frames_in` finds a folder's frames, in the order of their names.
    Raises FrameError for a path that does not exist, TiltError for frames without a table.
    """
    if tilt is not None:
        return [NightFolder(tuple(given), Path(os.path.abspath(tilt)))]
    if needs_no_tilt:
        return [NightFolder(tuple(given), None)]
    if missing := next((path for path in given if not os.path.exists(path)), None):
        raise FrameError(f"{missing}: there is no such file or folder")
    if are_photographs(given):
        return [NightFolder(tuple(given), ByGravity())]
    if single := next((path for path in given if not os.path.isdir(path)), None):
        raise TiltError(
            f"{single}: no tilts: give --tilt with frames, or nights alone: folders of frames, each with its tilt.csv; "
            f"or --site LAT LON, for the heading at a known place{stated_site([single])}"
        )
    return [_night(folder) for folder in given]


def stated_site(frames: Sequence[str]) -> str:
    """The end of a sentence that asks for --site: what the first frame's header says of it; '' if it says nothing."""
    with suppress(StarposError, OSError, IndexError):
        if said := read_frame(frames[0]).site_cards:
            return f"; {frames[0]} has {said}: if that is right, give it (east is positive)"
    return ""


def _night(folder: str) -> NightFolder | FrameError:
    try:
        frames = tuple(map(str, frames_in(Path(folder))))
    except FrameError as error:
        return error
    tilt = Path(os.path.abspath(os.path.join(folder, TILTS)))
    by_gravity = are_photographs(frames) and not tilt.exists()
    return NightFolder(frames, ByGravity() if by_gravity else tilt, folder)


PIP = "pip install matplotlib rosbags"


def bag_of(path: Path, args: argparse.Namespace, vertical: Vertical) -> "Exposures":
    """One instrument's part of a bag, to be solved; raises StarposError."""
    if find_spec("rosbags") is None:
        raise FrameError(f"{path}: bags are read with rosbags, which is not here: {PIP}")
    from starpos.night import bag
    from starpos.recording.drivers import Drivers
    from starpos.recording.topics import remaps_of

    any_camera = options.instrument_of(args, no_stars(100, 100, focal_px=1000.0))
    told = (args.instrument, args.focal_mm) != (None, None)
    return bag.exposures(
        path,
        args.namespace,
        Drivers.of(args.params_file, args.param, args.namespace, remaps_of(args.remap)),
        Instruments(any_camera, any_size=told),
        options.atmosphere_of(args),
        vertical,
        console.ProgressBar(),
        own_cameras=args.focal_mm is None,
    )


# Frames of a picture's size that are worth the start of a process, which takes a second of CPU time; and its memory.
FRAMES_A_PROCESS, PICTURE_BYTES, PROCESS_BYTES = 8, 1_000_000, 1 << 30


def workers_of(args: argparse.Namespace, paths: Sequence[str]) -> AbstractContextManager[DoCalls]:
    """The workers that --jobs asks for, no more than files; by default as many as pay and have memory."""
    most = len(paths)
    if args.jobs is None:
        pictures = sum(os.path.isfile(path) and os.path.getsize(path) > PICTURE_BYTES for path in paths)
        most = min(pictures // FRAMES_A_PROCESS, memory_bytes() // PROCESS_BYTES)
    return workers(min(args.jobs or processors(), most))


def worked(
    args: argparse.Namespace,
    work: Callable,
    paths: Sequence[str],
    what: str = "frame",
    lines: bool = True,
) -> Iterator[tuple[str, Any]]:
    """Each file with what a work makes of it, in their order, by the workers of --jobs, as `watched`."""
    with workers_of(args, paths) as do_calls:
        answers = watched(do_calls((work, path) for path in paths), len(paths), what, lines)
        yield from zip(paths, answers, strict=True)


def each_of(args: argparse.Namespace, read: Reader, paths: Sequence[str], lines: bool = True) -> Each:
    """Go through frames by the workers of --jobs, as `worked`."""
    return lambda work: worked(args, partial(read.on, work), paths, lines=lines)


def watched(answers: Iterable, number: int, what: str = "frame", lines: bool = True) -> Iterator:
    """The answers unchanged, with a progress bar unless their lines on standard output show it on the same terminal."""
    bar = console.ProgressBar()
    for k, answer in enumerate(answers, 1):
        if not (lines and sys.stdout.isatty()):
            bar(f"{what} {k} of {number}", k / number)
        yield answer
