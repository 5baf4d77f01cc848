# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate`: the camera and A3 from stars, written to files that the other commands read."""

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from starpos import rotation
from starpos.calibration.camera import FromSky, Intrinsics, calibrate_camera, hour_by_lens, rms, seen_by
from starpos.calibration.camera_adjustment import UNLEVELLED, UNTIMED, parameters
from starpos.calibration.misalignment import NOTHING_KNOWN, Calibrated, Known, calibrate_at, calibrate_fixed
from starpos.cli import console, inputs, options, overwriting, watch_output
from starpos.cli.inputs import checked_tilts, frames_among, given_or_sought, reader_of, stated_site
from starpos.cli.overwriting import CAMERA_NAME, save_instrument
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, FixError, FrameError, InstrumentError, PlaceError, StarposError
from starpos.files import save
from starpos.fix.checks import FIND_TURN, at_another_lean, may_turn, unnamed_inclinometer
from starpos.fix.heading import confirms_hour
from starpos.fix.searching import Sight, of_one_camera
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frames.reading import why_no_time
from starpos.frames.tables import TILTS, Pointing, read_pointings
from starpos.instrument import instrument_file, platepar
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import up_of
from starpos.instrument.instrument import SAG_ARCSEC_PER_SQRT_HOUR, Calibration, Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.night import horizon
from starpos.night.opening import frames_in
from starpos.night.reading import NO_CAMERA, Instruments, Reader
from starpos.night.remarks import WORTH_SAVING_ARCSEC, of_left_out
from starpos.night.together import axis_of, circles_of
from starpos.night.watching import Answer, kept, night_poses
from starpos.night.work import Solving
from starpos.sky import catalogue
from starpos.units import ARCSEC


def check_site(args: argparse.Namespace) -> None:
    """Raise InstrumentError for options that do not fit together."""
    deflection = (args.xi, args.eta, args.deflection_stddev, args.geoid, args.altitude_m) != (None,) * 5
    if deflection and args.site is None:
        raise InstrumentError("the deflection is for a calibration at a known place: give --site LAT LON")
    if deflection and not args.geodetic:
        raise InstrumentError(
            "--xi, --eta, --deflection-stddev, --geoid and --altitude-m are of a place on WGS 84: say --geodetic, or "
            "leave them out"
        )
    if args.site is None:
        return
    levelled = args.tilt is not None or args.fixed
    # without a level and a file of A3, the place gives the camera its level
    if (args.camera is None or levelled or args.output is not None) and not (
        args.output is not None and levelled
    ):
        raise InstrumentError(
            "--site needs the tilts and a file to write: give --tilt CSV and -o INSTRUMENT.yaml (or --fixed in place of "
            "--tilt), or --camera OUT.yaml alone"
        )
    # one sentence for a place that cannot be
    Place.by_gravity(*args.site)


def check_output(args: argparse.Namespace, instrument: Instrument) -> None:
    """Raise InstrumentError if the file of -o exists and describes another instrument."""
    if args.output is not None:
        instrument_file.check_fits(
            Path(args.output), instrument, fixed=args.fixed, camera_found=args.camera is not None
        )


def run_site(
    args: argparse.Namespace,
    frames: Sequence[Stars | Pointing],
    instrument: Instrument,
    tilts: TiltLog | None,
    known: Known = NOTHING_KNOWN,
) -> None:
    """Find A3, or the vertical of a fixed camera, write and print it; raises FixError if the frames do not determine it.

    known: identifications of the frames so far.
    """
    solver = Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))
    site, bar = options.camera_place_of(args), console.ProgressBar()
    if tilts is None:
        sag = SAG_ARCSEC_PER_SQRT_HOUR if args.sag is None else args.sag
        found = calibrate_fixed(solver, frames, site, sag, bar, known)
        by_files = replace(solver, hour_by_lens=hour_by_lens)
        for n, seen in list(known.items())[:1]:
            stars = frames[n]
            if isinstance(stars, Stars) and not by_files.attitude_at(stars, seen, site).hour_shown:
                console.complain(
                    f"{stars.place}: nothing shows that its hour is right: the vertical holds if the times are UTC"
                )
    elif instrument.vertical is not None:
        raise InstrumentError(
            f"{args.instrument} describes a camera fixed to the ground: give --fixed, or another instrument "
            f"file"
        )
    else:
        found = calibrate_at(solver, frames, tilts, site, options.turn_of(args), bar, known)
        console.complain(unnamed_inclinometer(instrument))
    console.complain(*(f"left out: {s.message}" for s in found.solutions if s.fix is None), found.beyond)
    about = _about_site(found, site)
    if args.misalignment is not None:
        about += _against(instrument.calibration, found.instrument.calibration)
    _save(args, found, about)


def run_elevations(
    args: argparse.Namespace, pointings: Sequence[Pointing], instrument: Instrument, tilts: TiltLog
) -> None:
    """Find A3's axis from pointings without a roll, write and print it; raises FixError if they do not determine it."""
    solver = Solver(instrument, catalogue.load_catalogue(), options.atmosphere_of(args))
    rows = circles_of(solver, pointings, tilts)
    console.complain(*(f"left out: {row}" for row in rows if isinstance(row, StarposError)))
    site = options.camera_place_of(args)
    found = axis_of(solver, pointings, tilts, site=site)
    console.complain(of_left_out(found.left_out), unnamed_inclinometer(instrument))
    scatter = np.sqrt(1 + found.scatter2)
    if scatter > SCATTERED and found.stddev_arcsec > WORTH_SAVING_ARCSEC:
        raise FixError(
            f"A3 is not written: the elevations scatter by {scatter:.0f} times their stated errors, and determine it to "
            f"{found.stddev_arcsec:.0f} arcsec only: check the place, the clock, and the tilts' axes, signs and units"
        )
    calibration = found.calibration(instrument.calibration, options.turn_of(args))
    about = (
        f"A3 of {calibration.frames} elevations in {found.directions} directions at {_text_of(site)} "
        "(by gravity): "
        "{:.5f} {:.5f} {:.5f} deg\n".format(*calibration.misalignment_deg)
        + f"the frame's centre in the inclinometer is known to {found.stddev_arcsec:.2f} arcsec; elevations "
        f"alone do not determine the turn about it, which does not matter for pointings without a roll\n"
    )
    _save(args, Calibrated(replace(instrument, calibration=calibration), found.stddev_arcsec, ()), about)


def _save(args: argparse.Namespace, found: Calibrated, about: str) -> None:
    """Write what was found as -o and --valid-days ask, and print it."""
    instrument = found.instrument
    if args.valid_days is not None:
        lasting = replace(instrument.calibration, valid_days=args.valid_days)
        instrument = replace(instrument, calibration=lasting)
    save_instrument(args.output, instrument, about, camera_found=args.camera is not None)
    console.tell(args, _json_of_site(found, args.output), about.rstrip())


def _text_of(site: Place) -> str:
    """Astronomic latitude and longitude in deg."""
    latitude, longitude = np.degrees(site.plumb)
    return f"{latitude:+.6f} {longitude:+.6f}"


def _about_site(found: Calibrated, site: Place) -> str:
    c = found.instrument.calibration
    if found.instrument.vertical is not None:
        sag = found.instrument.inclinometer.drift_rad_per_sqrt_hour / ARCSEC
        return (
            f"the vertical of a fixed camera of {c.frames} frames at {_text_of(site)} "
            f"(by gravity), known to {found.plumb_stddev_arcsec:.2f} arcsec, and {sag:g} arcsec of sag in an hour\n"
        )
    lines = [
        f"A3 of {c.frames} frames at {_text_of(site)} (by gravity): {{:.5f}} {{:.5f}} {{:.5f}} deg".format(
            *c.misalignment_deg
        ),
        f"the plumb line in the camera is known to {found.plumb_stddev_arcsec:.2f} arcsec; "
        + at_another_lean(c),
    ]
    if may_turn(c):
        lines.append(f"to find that turn as well, {FIND_TURN}")
    return "\n".join(lines) + "\n"


def _against(given: Calibration, found: Calibration) -> str:
    """A line on how far apart two A3 have the plumb line in the camera, at the lean of the calibration."""
    up = up_of(np.radians(found.tilt_deg))
    apart = np.degrees(np.arccos(np.clip(up @ found.a3 @ given.a3.T @ up, -1, 1)))
    return f"the --misalignment given has the plumb line {apart:.2g} deg from there: check the site if it cannot be\n"


def _json_of_site(found: Calibrated, path: str) -> dict:
    c = found.instrument.calibration
    return {
        "instrument": path,
        "misalignment_deg": c.misalignment_deg,
        "covariance_arcsec2": np.asarray(c.covariance_arcsec2),
        "plumb_stddev_arcsec": found.plumb_stddev_arcsec,
        "frames": c.frames,
    }


# elevations that scatter by more, in stated sigmas, contradict what is stated with them
SCATTERED = 3.0


def run(args: argparse.Namespace) -> int:
    if args.watch is not None:
        return _watch(args)
    if args.camera is None and args.site is None:
        raise InstrumentError(
            "nothing to calibrate: give --camera OUT.yaml, --site LAT LON, or both"
            + stated_site(args.frames or ())
        )
    options.check_frames(args)
    _open_night(args)
    if args.pointings is not None and args.camera is not None:
        raise InstrumentError("--pointings hold no stars: give frames for --camera")
    check_site(args)
    overwriting.check(
        args,
        camera=overwriting.camera,
        map=overwriting.picture,
        platepar=overwriting.never,
        output=instrument_file.check_replaceable,
    )
    if args.map is not None and find_spec("matplotlib") is None:
        raise InstrumentError("--map draws with matplotlib, which is not here: pip install matplotlib")
    if args.pointings is not None:
        return _from_pointings(args)
    read, args.frames = reader_of(args), frames_among(args.frames, args.tilt)
    first = read.first(args.frames)
    if first is None:
        # each frame says why it cannot be read
        _sights(args.frames, read, Instruments(None))
        return console.UNREADABLE
    # an error of the axis that all frames share becomes part of the A3 that is found
    given, _ = given_or_sought(args, first).framed(first)
    assert given.instrument is not None
    # an unusable instrument is refused before the work on all frames
    if not given.sought:
        check_output(args, given.instrument)
    sights = _sights(args.frames, read, given)
    unreadable = len(sights) < len(args.frames)
    solver, alike = of_one_camera(Solver(given.instrument, catalogue.load_catalogue()), sights)
    frames = [sight.stars for sight in alike]
    known = {n: sight.found for n, sight in enumerate(alike) if sight.found is not None}
    instrument = solver.instrument
    if given.sought:
        check_output(args, instrument)
    tilts = None if args.tilt is None else checked_tilts(args.tilt, instrument).log
    try:
        if args.camera is not None:
            camera = _camera(args, frames, known, instrument, tilts)
            if args.site is None:
                console.complain("an A3 belongs to the camera it was found with: find it again with this one")
            known = {
                n: k.but(focal_scale=k.focal_scale * instrument.focal_px / camera.fx)
                for n, k in known.items()
            }
            instrument = replace(instrument, camera=camera, focal_px=camera.fx)
        if args.output is not None:
            run_site(args, frames, instrument, tilts, known)
    except (CalibrationError, FixError, PlaceError) as e:
        console.complain(e)
        if not known:
            console.complain(Solving(replace(given, instrument=instrument)).fitting(frames[0]))
        return console.UNREADABLE if unreadable else console.NOTHING
    return console.UNREADABLE if unreadable else 0


def _watch(args: argparse.Namespace) -> int:
    """Print how a fixed camera kept its pose, night by night; returns the exit status."""
    if args.frames:
        raise FrameError("--watch names the folder of the nights: leave out the frames")
    args.frames = _frames_below(Path(args.watch))
    overwriting.check(args, page=overwriting.ours, horizon=overwriting.never)
    site = options.camera_place_of(args)
    answers, stars = [], []
    for seen in inputs.seen_at(args, site):
        answers.append(Answer.of(seen.item, seen.sight, seen.camera))
        if args.horizon is not None:
            stars.append(horizon.expected(seen.sight, seen.camera, catalogue.load_catalogue()))
    nights = kept(night_poses(answers, site.longitude))
    for k, night in enumerate(nights):
        values = watch_output.values_of(night)
        console.tell(args, values, watch_output.line_of(values))
        console.complain(watch_output.dimmed_of(nights[: k + 1]))
        if night.alarm:
            console.complain(watch_output.alarm_of(night))
    if args.page is not None:
        watch_output.write_page(Path(args.page), nights)
    if stars:
        known = [n.pose.extinction for n in nights if np.isfinite(n.pose.extinction)]
        horizon.write(
            Path(args.horizon), horizon.horizon(stars, float(np.median(known)) if known else np.nan)
        )
    return console.NOTHING if not nights or any(n.alarm for n in nights) else 0


def _frames_below(folder: Path) -> list[str]:
    """The frames of a folder, or of the nights that are folders in it; raises FrameError."""
    try:
        folders = [folder, *sorted(p for p in folder.iterdir() if p.is_dir())]
    except OSError as e:
        raise FrameError(f"{folder}: the folder cannot be read ({e.strerror})") from None
    found: list[str] = []
    for each in folders:
        # a folder of folders has no frames of its own
        with suppress(FrameError):
            found += map(str, frames_in(each))
    if not found:
        raise FrameError(f"{folder}: no frames in it, nor in its folders")
    return found


def _open_night(args: argparse.Namespace) -> None:
    """Put the frames of a folder, or of the nights in it, and its tilt.csv in its place; raises FrameError."""
    folders = [path for path in args.frames if Path(path).is_dir()]
    if not folders:
        return
    if len(args.frames) > 1:
        raise FrameError(
            f"{folders[0]}: calibrate takes one night, or a folder of nights: give one folder, or frames"
        )
    args.frames = _frames_below(Path(folders[0]))
    tilts = Path(folders[0]) / TILTS
    if args.tilt is None and not args.fixed and tilts.is_file():
        args.tilt = str(tilts)


def _from_pointings(args: argparse.Namespace) -> int:
    """Calibrate from the pointings of a plate solver, or from elevations if none has a roll; returns the exit status."""
    pointings = read_pointings(args.pointings)
    whole = [p for p in pointings if p.has_roll]
    elevations = pointings if not whole and args.tilt is not None else []
    if len(whole) < len(pointings) and not elevations:
        console.complain(f"{len(pointings) - len(whole)} pointings without a roll are left out")
    instrument = options.instrument_of(args, NO_CAMERA)
    check_output(args, instrument)
    tilts = None if args.tilt is None else checked_tilts(args.tilt, instrument).log
    if elevations and tilts is not None:
        run_elevations(args, elevations, instrument, tilts)
    else:
        run_site(args, whole, instrument, tilts)
    return 0


def _sights(paths: Sequence[str], read: Reader, given: Instruments) -> list[Sight]:
    """The frames that can be read, identified by every way there is; complaints about the others."""
    progress, work, sights = console.ProgressBar(), Solving(given), list[Sight]()
    for k, path in enumerate(paths):
        try:
            sight = work(read(path))
            sights.append(sight)
            console.complain(sight.solution.remark)
        except FrameError as e:
            console.complain(e)
        progress("frames", (k + 1) / len(paths))
    return sights


def _camera(
    args: argparse.Namespace, frames: list[Stars], known: Known, instrument: Instrument, tilts: TiltLog | None
) -> Camera:
    """Fit the camera of --camera, write, draw and print it."""
    air, first = options.atmosphere_of(args), frames[0]
    given = instrument.camera_for(first.width, first.height, first.origin_px)
    if {(f.width, f.height, f.origin_px) for f in frames} != {(given.width, given.height, first.origin_px)}:
        raise InstrumentError(
            "the frames differ in size or part of the sensor: give frames of one for --camera"
        )
    levels: list[np.ndarray | None] = [None] * len(frames)
    if tilts is not None:
        levels = [_level(stars, instrument, tilts) for stars in frames]
        kept = [n for n, level in enumerate(levels) if level is not None]
        if not kept:
            raise CalibrationError(
                "no frame has a tilt: check that --tilt is of the same night, or leave it out"
            )
        known = {k: known[n] for k, n in enumerate(kept) if n in known}
        frames, levels = [frames[n] for n in kept], [levels[n] for n in kept]
    site = options.camera_place_of(args) if args.site is not None and tilts is None else None
    found = calibrate_camera(
        frames, levels, given, catalogue.load_catalogue(), air, console.ProgressBar(), known, site
    )
    for k in sorted(set(range(len(frames))) - set(found.used)):
        console.complain(f"{frames[k].source}: no part of the sky matches it: it is left out")
    if tilts is None and site is None:
        _tell_what_tilts_would(found.fit, air, frames)
    about = _about(found)
    whole = instrument.whole_of(found.fit.camera, frames[0].origin_px)
    instrument_file.write_camera(Path(args.camera), whole, CAMERA_NAME, about + _covariance_text(found.fit))
    if args.map is not None:
        _draw(args.map, found)
    if args.platepar is not None:
        _write_platepar(args.platepar, found, frames, site, air)
    console.tell(args, _json_of(found, args.camera), about.rstrip())
    return whole


# frames of one platepar may lie apart by this, px
STILL_PX = 3.0


def _write_platepar(
    path: str, found: FromSky, frames: Sequence[Stars], site: Place | None, air: Atmosphere
) -> None:
    """Write the camera and the mean pose of its frames for RMS; InstrumentError if they have none."""
    if site is None:
        raise InstrumentError("--platepar needs the place of the camera: give --site LAT LON, without --tilt")
    fit, camera = found.fit, found.fit.camera
    mean = rotation.mean_rotation(fit.attitudes)
    apart = max(np.linalg.norm(rotation.to_vector(a @ mean.T)) for a in fit.attitudes) * camera.fx
    if apart > STILL_PX:
        raise InstrumentError(
            f"--platepar is of a camera that stands still, and in these frames it moved by {apart:.0f} px: give frames "
            "of one pose"
        )
    times = [frames[k].mid_unix_s or 0.0 for k in found.used]
    middle_s = times[len(times) // 2]
    place = site.latitude, site.longitude, 0.0 if np.isnan(site.height_m) else site.height_m
    seen = seen_by(camera, mean, site, air, middle_s)
    plate, worst = platepar.platepar_of(camera, *seen, middle_s, place)
    save(path, (json.dumps(plate, indent=4, sort_keys=True) + "\n").encode(), "the platepar")
    console.complain(
        f"{path}: RMS sees stars within {worst:.2f} px of this camera; the platepar has no photometry"
    )


def _level(stars: Stars, instrument: Instrument, tilts: TiltLog) -> np.ndarray | None:
    """The rotation (3, 3) of C into L of a frame; None, after a complaint, if it has no tilt."""
    try:
        if stars.mid_unix_s is None:
            raise FrameError(f"no time of exposure: {why_no_time(stars)}")
        tilt = tilts.average(stars.mid_unix_s, stars.exposure_s or 0.0)
        instrument.inclinometer.check_live(tilt)
        return instrument.level(tilt).camera
    except StarposError as e:
        console.complain(f"{stars.source} is left out: {e}")
        return None


def _tell_what_tilts_would(fit: Intrinsics, air: Atmosphere, frames: Sequence[Stars]) -> None:
    cost = UNLEVELLED[1] * air.refraction().a
    timeless = any(stars.mid_unix_s is None for stars in frames)
    what = "how refraction shrinks the field" + (
        " and, without times, aberration scales it" if timeless else ""
    )
    cost = np.hypot(cost, UNTIMED * timeless)
    console.complain(
        f"without --tilt {what} is not known: {1e6 * cost:.0f} ppm, {cost * fit.camera.fx:.2g} px, of fx "
        f"and fy, which their sigmas include"
    )


def _about(found: FromSky) -> str:
    """A table of the camera's parameters."""
    fit = found.fit
    lines = [
        f"{len(found.used)} frames, {len(fit.xy)} stars ({fit.rejected} left out): {fit.rms_px:.3f} px rms an axis, "
        f"{rms(fit.before):.3f} px by the given camera with its scale fitted alone"
    ]
    for name, value, sigma, told in zip(
        parameters(fit.camera), fit.values, fit.sigma, fit.determined, strict=True
    ):
        digits = max(0, 1 - int(np.floor(np.log10(sigma))))
        by = "from the stars" if told else "from the prior"
        lines.append(f"  {name:<4} {value:>16.{digits}f} +- {sigma:<12.{digits}f} {by}")
    lines.append(f"predicted positions (attitude and scale aside): +- {fit.worst_sigma_px:.3f} px at worst")
    if np.isfinite(found.lean_rad):
        lean, sigma = np.degrees([found.lean_rad, found.lean_sigma_rad])
        lines.append(
            f"refraction shows the zenith {lean:.2f} +- {sigma:.2f} deg from where time and place put it"
        )
        if not confirms_hour(found.lean_rad, found.lean_sigma_rad):
            lines.append(
                "so the stars do not show whether the hour is right: the pose depends on the stated time"
            )
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
    c, names = fit.camera, parameters(fit.camera)
    return {
        "camera": path,
        **console.values(c, "width height fx fy cx cy model distortion"),
        "sigma": dict(zip(names, fit.sigma, strict=True)),
        "covariance": fit.covariance,
        "told": [name for name, told in zip(names, fit.determined, strict=True) if told],
        "rms_before_px": rms(fit.before),
        **console.values(fit, "rms_px scatter_px worst_sigma_px rejected"),
        "stars": len(fit.xy),
        "frames": len(found.used),
    }
