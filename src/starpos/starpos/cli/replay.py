# SPDX-License-Identifier: Apache-2.0
"""`starpos replay`: solve recorded nights with the code of the node `solver`, without ROS."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from starpos.averaging.average import Average
from starpos.cli import console, inputs, options
from starpos.cli.console import Output, add_formats
from starpos.cli.fix_output import (
    COLUMNS,
    CSV_HELP,
    HEAD,
    JSON_HELP,
    json_about,
    json_of,
    line_of,
    put_combined,
)
from starpos.cli.inputs import NightFolder
from starpos.cli.solve import NO_FIX
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import StarposError
from starpos.fix.checks import BY_PARAMETERS, MODEL_BY_PARAMETERS
from starpos.fix.solution import Solution
from starpos.frames.reading import read_frame
from starpos.frames.tables import TILTS
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.night.opening import frames_in
from starpos.night.reading import stars_of
from starpos.night.remarks import of_a3, of_inclinometer
from starpos.night.together import FrameAnswer, Gathered, extrapolated
from starpos.recording.drivers import Drivers
from starpos.recording.topics import NO_REMAPS, Remaps
from starpos.report.field import INSTRUMENT, is_field, opened
from starpos.session import frames
from starpos.session.frames import Answered, Averaged
from starpos.session.replay import Replay
from starpos.session.settings import Settings
from starpos.units import utc_text


def define(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "bags",
        nargs="+",
        metavar="BAG",
        help="a rosbag2 with stars, tilts and camera_info, or with a robot's images, camera_info and IMU: a folder or a "
        "file; or a field report (ZIP)",
    )
    parser.add_argument(
        "--namespace", metavar="NAME", help="of the instrument, in a bag, or a YAML, of several"
    )
    options.add_parameters(
        parser,
        "of the node solver; for a robot's images and IMU of detector and inclinometer, too",
        "misalignment_stddev:=5.0 or detector:stamp:=start",
    )
    options.add_remaps(parser)
    add_formats(parser, JSON_HELP, CSV_HELP)
    inputs.add_jobs(parser, "bags")
    parser.set_defaults(run=run)


@dataclass(kw_only=True)
class PlayedNight:
    """The result of a bag: frames read, solutions, the average of its place, sentences; trouble: why it broke off."""

    instrument: Instrument
    frames: int = 0
    solutions: list[Solution] = field(default_factory=list)
    average: Average | None = None
    said: list[str] = field(default_factory=list)
    trouble: str = ""

    @property
    def summary(self) -> str:
        """Numbers of frames, answers and fixes."""
        fixes = sum(s.fix is not None for s in self.solutions)
        return f"{self.frames} frames, {len(self.solutions)} answers, {fixes} fixes"


class _Said:
    """Keeps each sentence of a session once."""

    def __init__(self, night: PlayedNight) -> None:
        self._said = night.said

    def came(self, name: str) -> None:
        """A good message is not mentioned."""

    def refuse(self, name: str, sentence: str) -> None:
        self.error(sentence)

    def info(self, message: str) -> None:
        """Each fix has its own line."""

    def warning(self, message: str) -> None:
        """The frame's own line shows it."""

    def error(self, message: str) -> None:
        if message not in self._said:
            self._said.append(message)


@dataclass(frozen=True)
class Playing:
    """The work on one bag, for any process."""

    params_file: Path | None
    given: Sequence[str]
    namespace: str | None
    remaps: Remaps = NO_REMAPS

    def __call__(self, bag: str) -> PlayedNight:
        if is_field(bag):
            with opened(bag) as (folder, air):
                told = self.given or self.params_file is not None
                given = self.given if told else _parameters_in(folder, air)
                return self._played(lambda replay: _played(replay, folder), given)
        return self._played(lambda replay: replay.play(Path(bag), self.namespace), self.given)

    def _played(self, play: Callable[[Replay], Iterator[frames.Output]], given: Sequence[str]) -> PlayedNight:
        settings = Settings.of(self.params_file, given, self.namespace)
        night = PlayedNight(instrument=settings.instrument(None))
        said = _Said(night)
        replay = Replay(
            settings,
            said,
            said,
            Drivers.of(self.params_file, self.given, self.namespace, self.remaps),
        )
        try:
            for output in play(replay):
                if isinstance(output, Answered):
                    night.solutions.append(_light(output.solution))
                elif isinstance(output, Averaged):
                    night.average = output.place
        except StarposError as error:
            night.trouble = str(error)
        night.frames = replay.frames
        night.said[:0] = replay.remarks
        return night


def _light(solution: Solution) -> Solution:
    """A solution without what only its solver needs."""
    return replace(solution, hint=None)


def _parameters_in(folder: Path, air: Atmosphere) -> list[str]:
    """The solver's parameters, NAME:=VALUE, of an unpacked field report."""
    measured = {"pressure": air.pressure_pa, "temperature": air.temperature_c, "humidity": air.humidity}
    refraction = [f"refraction.{name}:={float(value)}" for name, value in measured.items()]
    return [f"calibration_url:={folder / INSTRUMENT}", *refraction]


def _played(replay: Replay, folder: Path) -> Iterator[frames.Output]:
    """What the session publishes of an unpacked field report."""
    instrument = instrument_file.read(folder / INSTRUMENT)
    stars = [stars_of(read_frame(path)) for path in frames_in(folder)]
    tilts = read_tilt_csv(folder / TILTS, instrument.inclinometer.noise_rad)
    return replay.play_lists(instrument.camera_for(stars[0].width, stars[0].height), stars, tilts)


def run(args: argparse.Namespace) -> int:
    settings = Settings.of(args.params_file, args.param, args.namespace)
    output = Output(args, COLUMNS, HEAD)
    # a wrong parameter is reported once, not for each bag
    Drivers.of(args.params_file, args.param, args.namespace)
    work = Playing(args.params_file, tuple(args.param), args.namespace, options.remaps_of(args))
    with inputs.workers_of(args, len(args.bags)) as workers:
        answers = inputs.watched(workers.map((work, bag) for bag in args.bags), len(args.bags), "bag")
        return max(
            tell(args, output, bag, night, settings.vertical)
            for bag, night in zip(args.bags, answers, strict=True)
        )


def tell(
    args: argparse.Namespace,
    output: Output,
    bag: str,
    night: PlayedNight,
    vertical: Vertical,
) -> int:
    """Write the solutions of a bag and the average of its place; returns the exit status."""
    for sentence in night.said:
        console.complain("replay", f"{bag}: {sentence}")
    gathered = Gathered()
    for solution in night.solutions:
        gathered.gather(FrameAnswer(bag, solution))
        if not solution.fix:
            console.complain("replay", f"{bag}: {solution.message}")
        time = "a frame" if solution.utc_unix_s is None else utc_text(solution.utc_unix_s)
        output.put(
            {"file": bag} | json_of(solution.fix, vertical) | json_about(solution),
            line_of(f"{bag} {time}", solution, turning=False),
        )
    whole, solved = night.average, gathered.solved
    remarks = list(extrapolated(solved))
    if solved:
        remarks += of_inclinometer(night.instrument, MODEL_BY_PARAMETERS)
    if whole:
        remarks += of_a3(night.instrument.calibration, whole, BY_PARAMETERS)
    for remark in remarks:
        console.complain("replay", f"{bag}: {remark}")
    if solved:
        folder = NightFolder((), None, bag if len(args.bags) > 1 else None)
        put_combined(output, folder, whole, gathered, vertical)
    # a trouble names its bag
    console.complain("replay", night.trouble or f"{bag}: {night.summary}")
    return console.UNREADABLE if night.trouble else 0 if solved else NO_FIX
