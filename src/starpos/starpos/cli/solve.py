# SPDX-License-Identifier: Apache-2.0
"""`starpos solve`: position and heading of frames with their tilts, each and all together."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from starpos import catalogue, instrument_file
from starpos.average import Average, average
from starpos.cli import common
from starpos.errors import FixError, FrameError, InstrumentError
from starpos.fix import Fix
from starpos.inclinometer import TiltLog, read_tilt_csv
from starpos.solve import Solution, Solver, Status
from starpos.stars import Stars
from starpos.turning import turn
from starpos.utc import utc_text
from starpos.vertical import Vertical, geodetic

NO_FIX = 1
WORTH_SAVING_ARCSEC = 600.0
COUNTS = ("frames", "poses", "left_out", "moved")  # of an average


def define(parser) -> None:
    common.add_frames(parser)
    parser.add_argument(
        "--tilt", required=True, metavar="CSV", help="utc_unix_s, theta_x_deg, theta_y_deg[, temperature_c]"
    )
    common.add_exif(parser)
    common.add_instrument(parser)
    common.add_air(parser)
    common.add_vertical(parser)
    common.add_self_calibration(parser)
    parser.add_argument(
        "--save", metavar="OUT", help="write the instrument file (YAML) with the A3 of --self-calibrate"
    )
    parser.set_defaults(run=run)


def run(args) -> int:
    common.check_self_calibration(args)
    if args.save is not None and not args.self_calibrate:
        raise InstrumentError("--save writes what --self-calibrate finds: give both")
    vertical = common.vertical_of(args)
    solved, unreadable = [], False
    for path, answer in (_turned if args.self_calibrate else _one_by_one)(args):
        if isinstance(answer, FrameError):
            unreadable = True
            answer = Solution(Status.BAD_INPUT, str(answer), path, None, 0)
        if answer.fix:
            solved.append(answer)
        else:
            common.complain("solve", answer.message)
        if args.json:
            common.print_json({"file": path} | _json_of(answer.fix, vertical) | _json_about(answer))
        else:
            print(_line(path, answer))
    common.tell_extrapolation("solve", solved)
    together = _combine(solved)
    if solved:
        last = solved[-1].fix
        common.tell_unknown("solve", args, vertical.at(last.latitude, last.longitude))
        _print_combined(together, solved, args, vertical)
    return common.UNREADABLE if unreadable else 0 if together else NO_FIX


def _one_by_one(args):
    """(path, Solution or FrameError) of each frame as it is solved."""
    solver = tilts = None
    for path, item in common.frames_of(args.frames, common.clock_of(args)):
        if not isinstance(item, FrameError):
            if solver is None:
                solver, tilts = _solver(args, item)
            item = solver.solve(common.stars_of(item), tilts.average)
        yield path, item


def _turned(args):
    """The same of all frames together, solved with the A3 that they tell."""
    solver, rows = None, []
    for path, item in common.frames_of(args.frames, common.clock_of(args)):
        if not isinstance(item, FrameError):
            if solver is None:
                solver, tilts = _solver(args, item)
            item = common.stars_of(item)
        rows.append((path, item))
    frames = [stars for _, stars in rows if isinstance(stars, Stars)]
    answers = iter(_of_turn(args, solver, frames, tilts) if frames else ())
    for path, item in rows:
        yield path, next(answers) if isinstance(item, Stars) else item


def _of_turn(args, solver: Solver, frames: list[Stars], tilts: TiltLog) -> Sequence[Solution]:
    try:
        turned = turn(solver, frames, tilts.average, common.turn_of(args), solver.progress)
    except FixError as e:
        return [Solution.failed(stars, Status.POOR_FIT, str(e)) for stars in frames]
    error = f"the plumb line in the camera is known to {turned.plumb_stddev_arcsec:.2f} arcsec"
    if turned.plumb_stddev_arcsec > WORTH_SAVING_ARCSEC:
        kept = "" if args.save is None else f" {args.save} is not written:"
        common.complain(
            "solve", f"not calibrated:{kept} the headings hardly tell A3, {error}: turn it further"
        )
        return turned.solutions
    angles = "{:.5f} {:.5f} {:.5f}".format(*turned.instrument.calibration.misalignment_deg)
    common.complain("solve", f"calibrated: --misalignment {angles}; {error}")
    if args.save is not None:
        instrument_file.write(Path(args.save), turned.instrument, f"A3 by turning on the spot: {error}")
    return turned.solutions


def _solver(args, first) -> tuple[Solver, TiltLog]:
    instrument = common.instrument_of(args, first)
    tilts = read_tilt_csv(args.tilt, instrument.inclinometer.noise_rad)
    solver = Solver(instrument, catalogue.load(), common.atmosphere_of(args), progress=common.ProgressBar())
    return solver, tilts


def _combine(solved: list[Solution]) -> Average | None:
    """All fixes as one; None, with a sentence, where they do not belong together."""
    if not solved:
        return None
    try:
        whole = average([s.fix for s in solved])
    except FixError as e:
        common.complain("solve", e)
        return None
    if whole.moved:
        begin = utc_text(whole.began_unix_s)
        common.complain(
            "solve", f"the instrument moved on: the average is of the {whole.frames} frames since {begin}"
        )
    if whole.left_out:
        common.complain(
            "solve", f"{whole.left_out} fixes lie far from the others and are left out of the average"
        )
    return whole


def _json_of(fix: Fix | Average | None, vertical: Vertical) -> dict:
    """The keys of the contract that a fix fills; without one they are null."""
    keys = ("utc", "latitude", "longitude", "heading", "latitude_geodetic", "longitude_geodetic", "sigma_east_m",
            "sigma_north_m", "sigma_heading_deg", "covariance", "covariance_geodetic", "xi_arcsec", "eta_arcsec",
            "deflection_stddev_arcsec", "budget")  # fmt: skip
    if fix is None:
        return dict.fromkeys(keys)
    ground = geodetic(fix.latitude, fix.longitude, fix.heading, fix.covariance, vertical)
    covariance = _in_degrees(fix.covariance)
    sigma = np.sqrt(np.diag(covariance))
    values = (
        utc_text(fix.utc_unix_s),
        np.degrees(fix.latitude),
        np.degrees(fix.longitude),
        np.degrees(fix.heading),
        np.degrees(ground.latitude),
        np.degrees(ground.longitude),
        *sigma,
        covariance,
        _in_degrees(ground.covariance),
        ground.deflection.xi_arcsec,
        ground.deflection.eta_arcsec,
        ground.deflection.stddev_arcsec,
        budget_of(fix, vertical),
    )
    return dict(zip(keys, values, strict=True))


def _in_degrees(covariance: np.ndarray) -> np.ndarray:
    """(east m, north m, heading deg) from (east m, north m, heading rad)."""
    unit = np.array([1.0, 1.0, np.degrees(1.0)])
    return covariance * np.outer(unit, unit)


def budget_of(fix: Fix | Average, vertical: Vertical) -> dict:
    """1 sigma of each source: east m, north m, heading deg; the deflection only concerns the geodetic position."""
    terms = {t.name: np.sqrt(np.diag(t.covariance)[:3]) * [1, 1, np.degrees(1)] for t in fix.terms}
    extra = geodetic(fix.latitude, fix.longitude, 0.0, np.zeros((3, 3)), vertical).covariance
    terms["deflection (geodetic only)"] = np.sqrt(np.diag(extra)) * [1, 1, np.degrees(1)]
    return terms


def _json_about(s: Solution) -> dict:
    a = s.attitude
    return {
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.names),
        "residual_arcsec": s.fix.residual_arcsec if s.fix else None,
        "log_odds": a.log_odds if a else None,
        "status": s.status.value,
    }


def _line(path: str, s: Solution) -> str:
    if s.fix is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    return f"{path}: {_where(s.fix)}, {len(s.names)} of {s.stars_detected} stars"


def _where(fix: Fix | Average) -> str:
    east, north, heading = np.sqrt(np.diag(_in_degrees(fix.covariance)))
    facing = f"heading {np.degrees(fix.heading):.4f} +- {heading:.4f} deg"
    if np.isnan(fix.heading):
        facing = "heading not known since the camera was touched"
    return f"{np.degrees(fix.latitude):+.6f} {np.degrees(fix.longitude):+.6f} +- {north:.0f} m N {east:.0f} m E, {facing}"


def _print_combined(all_together: Average | None, solved: list[Solution], args, vertical: Vertical) -> None:
    if args.json:
        about = {
            "stars_detected": sum(s.stars_detected for s in solved),
            "stars_matched": sum(len(s.names) for s in solved),
            "residual_arcsec": np.sqrt(np.mean([s.fix.residual_arcsec**2 for s in solved])),
            "log_odds": sum(s.attitude.log_odds for s in solved),
            "status": (Status.OK if all_together else Status.POOR_FIT).value,
        }
        common.print_json(
            {"combined": True}
            | (
                dict.fromkeys(COUNTS)
                if all_together is None
                else {k: getattr(all_together, k) for k in COUNTS}
            )
            | _json_of(all_together, vertical)
            | about
        )
        return
    if all_together is None:
        return
    ground = geodetic(all_together.latitude, all_together.longitude, 0.0, all_together.covariance, vertical)
    turned = f" (the last of {all_together.poses} poses)" if all_together.poses > 1 else ""
    print(f"{all_together.frames} frames together: {_where(all_together)}{turned} (astronomic)")
    sigma = np.sqrt(np.diag(ground.covariance))
    print(
        f"geodetic, WGS 84: {np.degrees(ground.latitude):+.6f} {np.degrees(ground.longitude):+.6f} "
        f"+- {sigma[1]:.0f} m N {sigma[0]:.0f} m E (the deflection of the vertical included)"
    )
    for name, (east, north, heading) in budget_of(all_together, vertical).items():
        print(f"  {name:<28} {east:8.2f} m E {north:8.2f} m N {heading * 3600:8.2f} arcsec")
