# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading from frames with their tilts, for each frame and for all together."""

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.averaging.elevation_axis import FoundAxis
from starpos.averaging.sights import read_sights
from starpos.calibration.misalignment import Calibrated
from starpos.cli import console, fix_output, inputs, options, overwriting, places_file
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.errors import InstrumentError, StarposError, TiltError
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frames.reading import are_photographs
from starpos.frames.tables import Pointing, read_pointings
from starpos.instrument import instrument_file
from starpos.instrument.instrument import UNKNOWN_CLOCK_S, ByGravity, Instrument
from starpos.instrument.phone_log import is_phone_log
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.night import field
from starpos.night.opening import work_of
from starpos.night.reading import NO_CAMERA, Instruments
from starpos.night.remarks import WORTH_SAVING_ARCSEC, Near, worth_saving
from starpos.night.solving import How, NightAnswers, answers_of, answers_of_pointings
from starpos.night.together import FrameAnswer, from_elevations, from_sights
from starpos.night.work import Solving, prepare
from starpos.sky import catalogue
from starpos.units import utc_text

if TYPE_CHECKING:
    from starpos.gnss.states import Learned


def tell(
    args: argparse.Namespace,
    output: console.Output,
    folder: str | None,
    answers: NightAnswers,
    vertical: Vertical,
    place: Place | None = None,
) -> int:
    """Write the answer to each frame of a night, and what they come to together; returns the exit status.

    folder: of the night; None where it is not named.
    place: the known place, whose headings are then reported; None without one.
    """
    statuses = []
    if answers.turned is not None:
        statuses.append(tell_turned(args, folder, answers.turned, answers.remarks))
    if answers.watched is not None:
        console.complain_of(folder, *answers.remarks)
        if args.learned is not None:
            _save_learned(Path(args.learned), answers.watched.learned)
    complaints, near = console.FrameComplaints(), inputs.near_of(args)
    for answer in answers:
        s = answer.solution
        if s.fix is None and s.circle is None and (s.at_place is None or not s.ok):
            complaints(answer.name, s.message)
        if s.remark:
            complaints(answer.name, s.remark)
        output.put(_json_of_answer(args, answer, vertical, place), _line_of_answer(args, answer, place))
    complaints.end()
    whole = answers.together(near)
    headings = whole.gathered.headings
    console.complain_of(folder, whole.why_not, *whole.remarks)
    about = fix_output.about_average(args, whole.where, vertical, near)
    if place is not None:
        average = fix_output.json_of(whole.average, vertical)
        about |= fix_output.with_heading(average, whole.mean, place, options.axes_of(args))
    if whole.where is not None or (headings and place is not None):
        fix_output.put_combined(output, folder, whole, vertical, about)
    # without tilts headings are all that was asked for, and by day they are all there is
    by_day = any(s.bodies for s in headings)
    found = bool(headings) if place is not None and (by_day or not args.tilt) else whole.average is not None
    found |= args.gnss is not None and args.tilt is None and bool(headings)
    status = 0 if found else console.NOTHING
    return max([*statuses, console.UNREADABLE if whole.gathered.unreadable else status])


def _json_of_answer(
    args: argparse.Namespace, answer: FrameAnswer, vertical: Vertical, place: Place | None
) -> dict:
    """The answer to a frame for --json; with --gnss, its heading is at GNSS's place, and it has the key `gnss`."""
    s = answer.solution
    if args.gnss is not None:
        return {"file": answer.name} | json_of_watched(answer) | fix_output.json_about(s)
    values = {"file": answer.name} | fix_output.json_of(s.fix, vertical) | fix_output.json_about(s)
    if s.circle is not None:
        values |= {"utc": utc_text(s.circle.utc_unix_s)}
        values |= {"zenith_distance_deg": np.degrees(s.circle.zenith_distance)}
    return (
        values if place is None else fix_output.with_heading(values, s.at_place, place, options.axes_of(args))
    )


def _line_of_answer(args: argparse.Namespace, answer: FrameAnswer, place: Place | None) -> str:
    s, watched = answer.solution, answer.watched
    if place is not None or s.at_place is not None:
        line = fix_output.heading_line_of(answer.name, s, options.axes_of(args))
    else:
        line = fix_output.line_of(answer.name, s, args.self_calibrate)
    if watched is None or watched.compared is None:
        return line
    check = watched.compared
    return f"{line}; GNSS {check.status}: {check.sentence}"


def check_save(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of --save exists and describes another instrument."""
    if args.save is not None:
        instrument_file.check_fits(Path(args.save), instrument)


def tell_turned(
    args: argparse.Namespace, folder: str | None, turned: Calibrated, remarks: Sequence[str]
) -> int:
    """Say what was found by turning, and write A3 as --save asks; NOTHING if it is asked for and not written."""
    if not worth_saving(turned):
        console.complain_of(folder, *remarks, *([] if args.save is None else [f"{args.save} is not written"]))
        return 0 if args.save is None else console.NOTHING
    if args.save is not None:
        about = f"A3 by turning on the spot, {remarks[0]}"
        overwriting.save_instrument(args.save, turned.instrument, about)
    kept = "--save OUT keeps A3 and its errors" if args.save is None else f"{args.save} is written"
    console.complain_of(folder, *remarks, kept)
    return 0


def how_of(args: argparse.Namespace) -> How:
    """How a night is solved, with the tables of --gnss and --learned; raises StarposError."""
    turn_deg = options.turn_of(args) if args.self_calibrate else None
    if args.gnss is None:
        return How(turn_deg)
    from starpos.gnss import states
    from starpos.gnss.receiver import read_gnss_csv

    track, faults = read_gnss_csv(args.gnss)
    console.complain(*faults)
    learned = getattr(args, "learned", None)
    return How(turn_deg, track, None if learned is None else states.read_learned(Path(learned)))


def _save_learned(path: Path, learned: "Learned | None") -> None:
    from starpos.gnss import states

    if learned is None or not learned.frames:
        console.complain(f"{path} is not written: no frame with a GNSS place has taught anything")
    else:
        states.save_learned(path, learned)


def json_of_watched(answer: FrameAnswer) -> dict:
    """The keys of --json of a frame that come from its fix, or its heading at GNSS's place, and `gnss`."""
    told, solution = answer.watched, answer.solution
    keys = fix_output.json_on_ground(solution.fix, None if told is None else told.ground)
    if (at_place := solution.at_place) is not None:
        keys = fix_output.with_heading(keys, at_place, at_place.place)
    check = None if told is None else told.compared
    about = None if check is None else console.values(check, "status distance_m bearing_deg sigma_m")
    return keys | {"gnss": about}


def run_pointings(args: argparse.Namespace) -> int:
    """Solve the table of --pointings; returns the exit status."""
    near = inputs.near_of(args)
    pointings, vertical = read_pointings(args.pointings), options.vertical_of(args)
    own_level = options.has_own_level(args)
    if args.tilt is None and not own_level:
        raise InstrumentError("--pointings needs the tilts: give --tilt CSV")
    # pointings need no focal length
    instrument = options.instrument_of(args, NO_CAMERA)
    solver = Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))
    check_save(args, solver.instrument)
    tilts = NO_TILTS if own_level else inputs.checked_tilts(args.tilt, solver.instrument)
    with_roll = any(p.has_roll for p in pointings)
    output = console.Output(args, "fix" if with_roll else "elevations")
    if not with_roll:
        return _from_elevations(args, output, solver, tilts, pointings, vertical, near)
    turn_deg = options.turn_of(args) if args.self_calibrate else None
    return tell(args, output, None, answers_of_pointings(solver, pointings, tilts, turn_deg), vertical)


def _from_elevations(
    args: argparse.Namespace,
    output: console.Output,
    solver: Solver,
    tilts: Tilts,
    pointings: Sequence[Pointing],
    vertical: Vertical,
    near: Near | None,
) -> int:
    """Print each row's zenith distance and the place that they give together; returns the exit status."""
    circles, whole = from_elevations(solver, pointings, tilts, near, args.self_calibrate)
    status, saving = fix_output.tell_elevations(args, output, pointings, circles, whole, vertical, near), 0
    if whole.axis is not None:
        console.complain(
            f"A3 from the elevations: the frame's centre in the inclinometer to {whole.axis.stddev_arcsec:.0f} arcsec"
        )
    if args.save is not None:
        saving = _save_axis(args, solver, whole.axis)
    return max(saving, status)


def _save_axis(args: argparse.Namespace, solver: Solver, axis: FoundAxis | None) -> int:
    """Write the A3 that the elevations determined, as --save asks; console.NOTHING if they did not."""
    if axis is None or axis.stddev_arcsec > WORTH_SAVING_ARCSEC:
        console.complain(f"{args.save} is not written: the elevations hardly determine A3")
        return console.NOTHING
    calibration = axis.calibration(solver.instrument.calibration, options.turn_of(args))
    about = f"A3 of elevations alone: the frame's centre to {axis.stddev_arcsec:.2f} arcsec"
    overwriting.save_instrument(args.save, replace(solver.instrument, calibration=calibration), about)
    return 0


def _run_sights(args: argparse.Namespace) -> int:
    """Solve the table of --sights; returns the exit status."""
    if args.frames:
        raise InstrumentError("give either frames or --sights CSV, not both")
    sights, near, vertical = read_sights(args.sights), inputs.near_of(args), options.vertical_of(args)
    clock_s = UNKNOWN_CLOCK_S if args.clock_stddev is None else args.clock_stddev
    air = options.atmosphere_of(args)
    ephemeris = options.ephemeris_of(args)
    output = console.Output(args, "elevations")
    circles, whole = from_sights(sights, air, clock_s, near, ephemeris)
    return fix_output.tell_elevations(args, output, sights, circles, whole, vertical, near)


def run(args: argparse.Namespace) -> int:
    if args.sights is not None:
        return _run_sights(args)
    if len(args.frames) == 1 and field.is_field(args.frames[0]):
        return _of_field(args)
    return _run(args)


def _of_field(args: argparse.Namespace) -> int:
    """Solve a field report, with its instrument and its air where the options name none."""
    if args.tilt is not None:
        raise TiltError(f"{args.frames[0]} has its own tilts: leave --tilt out")
    with field.opened(args.frames[0]) as (folder, air):
        args.frames = [str(folder)]
        if inputs.is_untold(args):
            args.instrument = str(folder / field.INSTRUMENT)
        if (args.pressure_hpa, args.temperature_c, args.humidity, args.wavelength_um) == (None,) * 4:
            args.air = air
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    options.check_frames(args)
    if args.out is not None and not places_file.is_places(args.out):
        raise InstrumentError(f"-o {args.out}: give a name that ends in {' or '.join(places_file.SUFFIXES)}")
    overwriting.check(args, save=instrument_file.check_replaceable, out=overwriting.ours)
    if args.pointings is not None:
        return run_pointings(args)
    vertical = options.vertical_of(args)
    place = options.place_of(args, vertical)
    output = console.Output(args, "fix" if place is None else "heading")
    inputs.near_of(args)
    own_level = options.has_own_level(args)
    how = how_of(args)
    if args.gnss is not None and own_level:
        raise InstrumentError(
            "--gnss teaches an inclinometer, and this camera is its own level: leave --gnss out"
        )
    # the folder of a night has its tilts
    needs_no_tilt = own_level or (
        (place is not None or args.gnss is not None) and not any(map(os.path.isdir, args.frames))
    )
    given = inputs.nights_of(inputs.frames_among(args.frames, args.tilt, args.gnss), args.tilt, needs_no_tilt)
    if args.save is not None and len(given) > 1:
        raise InstrumentError("--save writes the A3 of one night: give one")
    nights = [night for night in given if isinstance(night, inputs.NightFolder)]
    by_gravity = any(isinstance(night.tilt, ByGravity) for night in nights)
    by_log = args.tilt is not None and is_phone_log(Path(args.tilt)) and are_photographs(args.frames)
    read = inputs.reader_of(args, by_gravity or by_log)
    statuses = [_refused(why, given) for why in given if not isinstance(why, inputs.NightFolder)]
    with inputs.workers_of(args, [path for night in nights for path in night.frames]) as do_calls:
        plans = []
        abouts = do_calls((partial(read.first, levelled=by_gravity), night.frames) for night in nights)
        for night, about in zip(nights, abouts, strict=True):
            try:
                plans.append((night, _work(args, night, about, own_level, place)))
            except TiltError as error:
                statuses.append(_refused(error, given))
        on_files = [partial(read.on, how.work(work)) for _, work in plans]
        calls = [(f, path) for f, (night, _) in zip(on_files, plans, strict=True) for path in night.frames]
        # the lines of a turn come at its end, and show no progress
        sights = inputs.watched(do_calls(calls), len(calls), lines=how.one_by_one)
        for night, work in plans:
            # takes the answers of this night, and leaves the rest
            rows = zip(night.frames, sights, strict=False)
            answers = answers_of(rows, work, vertical, how, console.ProgressBar())
            statuses.append(tell(args, output, night.folder, answers, vertical, place))
    if args.out is not None:
        places_file.write(args.out, output.answers)
    return max(statuses)


def _refused(why: StarposError, given: list) -> int:
    """Complain about a night that cannot be worked on; raises the error if it is the only night."""
    if len(given) == 1:
        raise why
    console.complain(why)
    return console.UNREADABLE


def _work(
    args: argparse.Namespace,
    night: inputs.NightFolder,
    about: Stars | None,
    own_level: bool,
    place: Place | None,
) -> Solving:
    """The work on a night's frames, after complaints about what looks wrong; raises TiltError."""
    air = options.atmosphere_of(args)
    # without a frame that can be read, each one reports why it cannot
    if about is None:
        return Solving(Instruments(None), atmosphere=air)
    work, remarks = work_of(inputs.given_or_sought(args, about), about, night.tilt, air, place)
    work = replace(work, ephemeris=options.ephemeris_of(args))
    console.complain(*remarks)
    assert work.instruments.instrument is not None
    if not work.instruments.sought:
        check_save(args, work.instruments.instrument)
    console.complain(prepare(work.instruments, about, console.ProgressBar()))
    return replace(work, tilts=NO_TILTS) if own_level else work
