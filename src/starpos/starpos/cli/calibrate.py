# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate`: the camera and A3 from stars, written to files that the other commands read."""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from starpos.calibration.camera import FromSky, calibrate_camera
from starpos.calibration.camera_adjustment import UNLEVELLED, UNTIMED, parameters
from starpos.calibration.intrinsics import Intrinsics, rms
from starpos.cli import calibrate_site, console, options, overwriting
from starpos.cli.archive import frames_among
from starpos.cli.inputs import checked_tilts, given_of, reader_of
from starpos.cli.output import add_formats
from starpos.cli.overwriting import CAMERA_NAME, Written
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, FixError, FrameError, InstrumentError, StarposError
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing, read_pointings
from starpos.frames.reading import why_no_time
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument import camera_file, instrument_update
from starpos.instrument.axis import with_frame_size
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import level_of
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.night.hints import of_one_camera
from starpos.night.reading import NO_CAMERA, First, Given, Reader
from starpos.night.searching import Sight
from starpos.night.work import Identifying
from starpos.sky import catalogue

# Exit status.
NOTHING = 1
# the stars of a frame, and their identification
_Seen = tuple[Stars, Identification | None]


def define(parser: argparse.ArgumentParser) -> None:
    options.add_frames(parser, pointings=True)
    add_formats(parser, "one JSON object for --camera and one for --site instead of text", None)
    parser.add_argument(
        "--camera",
        metavar="OUT",
        help="write the camera's calibration (CameraInfo YAML): focal lengths, principal point, distortion",
    )
    parser.add_argument(
        "--map", metavar="PNG", help="draw the residuals of the given and of the fitted camera (--camera)"
    )
    options.add_stamps(parser)
    options.add_instrument(parser)
    parser.add_argument(
        "--tilt",
        metavar="CSV",
        help="utc_unix_s, theta_x_deg, theta_y_deg[, theta_z_deg, temperature_c, sigma_deg]: refraction is undone",
    )
    options.add_air(parser)
    calibrate_site.define(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.camera is None and args.site is None:
        raise InstrumentError("nothing to calibrate: give --camera OUT.yaml, --site LAT LON, or both")
    if args.map is not None and args.camera is None:
        raise InstrumentError("--map draws the camera's residuals: give --camera OUT.yaml too")
    options.check_frames(args)
    if args.pointings is not None and args.camera is not None:
        raise InstrumentError("--pointings hold no stars: give frames for --camera")
    calibrate_site.check(args)
    overwriting.check(args, *_written(args))
    if args.map is not None and find_spec("matplotlib") is None:
        raise InstrumentError("--map draws with matplotlib, which is not here: pip install matplotlib")
    if args.pointings is not None:
        return _from_pointings(args)
    read, args.frames = reader_of(args), frames_among(args.frames, args.tilt)
    first = First(read)(tuple(args.frames))
    if first is None:
        # each frame says why it cannot be read
        _sights(args.frames, read, Given(None))
        return console.UNREADABLE
    # an error of the axis that all frames share becomes part of the A3 that is found
    instrument, _ = with_frame_size(options.instrument_of(args, first), first)
    # an unusable instrument is refused before the work on all frames
    calibrate_site.check_output(args, instrument)
    sights, unreadable = _sights(args.frames, read, replace(given_of(args, first), instrument=instrument))
    solver, frames = of_one_camera(Solver(instrument, catalogue.load_catalogue()), sights)
    instrument = solver.instrument
    tilts = _tilts(args, instrument)
    try:
        if args.camera is not None:
            camera = _camera(args, frames, instrument, tilts)
            if args.site is None:
                console.complain(
                    "calibrate", "an A3 belongs to the camera it was found with: find it again with this one"
                )
            frames = [
                (s, k and k.but(focal_scale=k.focal_scale * instrument.focal_px / camera.fx))
                for s, k in frames
            ]
            instrument = replace(instrument, camera=camera, focal_px=camera.fx)
        if args.site is not None:
            calibrate_site.run(args, [s for s, _ in frames], instrument, tilts, _known(frames))
    except (CalibrationError, FixError) as e:
        console.complain("calibrate", e)
        return console.UNREADABLE if unreadable else NOTHING
    return console.UNREADABLE if unreadable else 0


def _tilts(args: argparse.Namespace, instrument: Instrument) -> TiltLog | None:
    """The table of --tilt, None without one."""
    if args.tilt is None:
        return None
    return checked_tilts("calibrate", args.tilt, instrument).log


def _from_pointings(args: argparse.Namespace) -> int:
    """Calibrate from the pointings of a plate solver; returns the exit status."""
    pointings = read_pointings(args.pointings)
    whole = [p for p in pointings if p.has_roll]
    if not whole and args.tilt is not None:
        return _from_elevations(args, pointings)
    if len(whole) < len(pointings):
        console.complain("calibrate", f"{len(pointings) - len(whole)} pointings without a roll are left out")
    instrument = options.instrument_of(args, NO_CAMERA)
    calibrate_site.check_output(args, instrument)
    tilts = _tilts(args, instrument)
    try:
        calibrate_site.run(args, whole, instrument, tilts)
    except FixError as e:
        console.complain("calibrate", e)
        return NOTHING
    return 0


def _from_elevations(args: argparse.Namespace, pointings: Sequence[Pointing]) -> int:
    """Calibrate from pointings without a roll, whose elevations determine A3's axis; returns the exit status."""
    instrument = options.instrument_of(args, NO_CAMERA)
    calibrate_site.check_output(args, instrument)
    tilts = checked_tilts("calibrate", args.tilt, instrument).log
    try:
        calibrate_site.run_elevations(args, pointings, instrument, tilts)
    except FixError as e:
        console.complain("calibrate", e)
        return NOTHING
    return 0


def _written(args: argparse.Namespace) -> Iterator[Written]:
    """The files that the options name to be written."""
    if args.camera is not None:
        yield Written("--camera", args.camera, overwriting.camera)
    if args.map is not None:
        yield Written("--map", args.map, overwriting.picture)
    if args.output is not None:
        yield Written("--output", args.output, instrument_update.check_replaceable)


def _sights(paths: Sequence[str], read: Reader, given: Given) -> tuple[list[Sight], bool]:
    """The frames that can be read, identified by every way there is, and whether some cannot be read."""
    progress, unreadable, work = console.ProgressBar(), False, Identifying(given)
    sights: list[Sight] = []
    for k, path in enumerate(paths):
        try:
            sight, _ = work(read(path))
            sights.append(sight)
            if sight.solution.remark:
                console.complain("calibrate", sight.solution.remark)
        except FrameError as e:
            console.complain("calibrate", e)
            unreadable = True
        progress("frames", (k + 1) / len(paths))
    return sights, unreadable


def _known(frames: Sequence[_Seen]) -> dict[int, Identification]:
    """Identifications of frames, by their numbers."""
    return {n: found for n, (_, found) in enumerate(frames) if found is not None}


def _camera(
    args: argparse.Namespace, seen: list[_Seen], instrument: Instrument, tilts: TiltLog | None
) -> Camera:
    """Fit the camera of --camera, write, draw and print it."""
    air, (first, _) = options.atmosphere_of(args), seen[0]
    given = instrument.camera_for(first.width, first.height, first.origin_px)
    if {(f.width, f.height, f.origin_px) for f, _ in seen} != {(given.width, given.height, first.origin_px)}:
        raise InstrumentError(
            "the frames differ in size or part of the sensor: give frames of one for --camera"
        )
    levels: Sequence[np.ndarray | None] = [None] * len(seen)
    if tilts is not None:
        seen, levels = _levelled(seen, instrument, tilts)
    frames, bar = [stars for stars, _ in seen], console.ProgressBar()
    found = calibrate_camera(frames, levels, given, catalogue.load_catalogue(), air, bar, _known(seen))
    for k in sorted(set(range(len(frames))) - set(found.used)):
        console.complain("calibrate", f"{frames[k].source}: no part of the sky matches it: it is left out")
    if tilts is None:
        _tell_what_tilts_would(found.fit, air, frames)
    about = _about(found)
    whole = instrument.whole_of(found.fit.camera, frames[0].origin_px)
    camera_file.write(Path(args.camera), whole, CAMERA_NAME, about + _covariance_text(found.fit))
    if args.map is not None:
        _draw(args.map, found)
    if args.json:
        console.print_json(_json_of(found, args.camera))
    else:
        print(about, end="")
    return whole


def _levelled(
    frames: Sequence[_Seen], instrument: Instrument, tilts: TiltLog
) -> tuple[list[_Seen], list[np.ndarray]]:
    """The frames that have a tilt, with the rotation (3, 3) of C into L for each; complains about the others."""
    kept: list[_Seen] = []
    levels: list[np.ndarray] = []
    for stars, found in frames:
        try:
            if stars.mid_unix_s is None:
                raise FrameError(f"no time of exposure: {why_no_time(stars)}")
            tilt = tilts.average(stars.mid_unix_s, stars.exposure_s or 0.0)
            levels.append(level_of(tilt.up) @ instrument.mounting.a3)
            kept.append((stars, found))
        except StarposError as e:
            console.complain("calibrate", f"{stars.source} is left out: {e}")
    if not kept:
        raise CalibrationError("no frame has a tilt: check that --tilt is of the same night, or leave it out")
    return kept, levels


def _tell_what_tilts_would(fit: Intrinsics, air: Atmosphere, frames: Sequence[Stars]) -> None:
    cost = UNLEVELLED[1] * air.refraction().a
    timeless = any(stars.mid_unix_s is None for stars in frames)
    what = "how refraction shrinks the field" + (
        " and, without times, aberration scales it" if timeless else ""
    )
    cost = np.hypot(cost, UNTIMED * timeless)
    console.complain(
        "calibrate",
        f"without --tilt {what} is not known: {1e6 * cost:.0f} ppm, {cost * fit.camera.fx:.2g} px, of fx "
        f"and fy, which their sigmas include",
    )


def _about(found: FromSky) -> str:
    """A table of the camera's parameters."""
    fit = found.fit
    lines = [
        f"{len(found.used)} frames, {len(fit.xy)} stars ({fit.rejected} left out): {fit.rms_px:.3f} px rms an axis, "
        f"of the given camera, its scale fitted, {rms(fit.before):.3f} px"
    ]
    for name, value, sigma, told in zip(parameters(fit.camera), fit.values, fit.sigma, fit.told, strict=True):
        digits = max(0, 1 - int(np.floor(np.log10(sigma))))
        by = "from the stars" if told else "from the prior"
        lines.append(f"  {name:<4} {value:>16.{digits}f} +- {sigma:<12.{digits}f} {by}")
    lines.append(f"predicted positions (attitude and scale aside): +- {fit.worst_sigma_px:.3f} px at worst")
    return "\n".join(lines) + "\n"


def _covariance_text(fit: Intrinsics) -> str:
    rows = "\n".join(" ".join(f"{v:.6e}" for v in row) for row in fit.covariance)
    return f"covariance of {' '.join(parameters(fit.camera))}, row by row:\n{rows}\n"


def _draw(path: str, found: FromSky) -> None:
    from starpos.calibration import residual_map

    fit = found.fit
    c = fit.camera
    title = (
        f"{c.width} x {c.height} px, fx {c.fx:.2f} fy {c.fy:.2f} cx {c.cx:.1f} cy {c.cy:.1f}, {len(found.used)} frames, "
        f"{len(fit.xy)} stars: residuals from {rms(fit.before):.3f} to {fit.rms_px:.3f} px"
    )
    try:
        residual_map.draw(path, fit, title)
    # ValueError comes from a suffix that matplotlib cannot write
    except (OSError, ValueError) as e:
        raise InstrumentError(f"{path}: the map cannot be written there ({e})") from None


def _json_of(found: FromSky, path: str) -> dict:
    fit = found.fit
    c = fit.camera
    return {
        "camera": path,
        "width": c.width,
        "height": c.height,
        "fx": c.fx,
        "fy": c.fy,
        "cx": c.cx,
        "cy": c.cy,
        "model": c.model,
        "distortion": c.distortion,
        "sigma": dict(zip(parameters(c), fit.sigma, strict=True)),
        "covariance": fit.covariance,
        "told": [name for name, told in zip(parameters(c), fit.told, strict=True) if told],
        "rms_px": fit.rms_px,
        "rms_before_px": rms(fit.before),
        "scatter_px": fit.scatter_px,
        "worst_sigma_px": fit.worst_sigma_px,
        "stars": len(fit.xy),
        "rejected": fit.rejected,
        "frames": len(found.used),
    }
