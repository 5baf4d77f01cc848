# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection --plan`: faces, frames a face and time for a wanted error of the deflection."""

import argparse
import time

from starpos.cli import console, options
from starpos.earth.orientation import earth_state
from starpos.errors import FixError, InstrumentError
from starpos.sky.catalogue import load_catalogue
from starpos.units import ARCSEC
from starpos.zenith.planning import Planner, Routine, SessionPlan, ZenithSky
from starpos.zenith.sighting import Mark

NO_PLAN = 1


def add_plan(parser: argparse.ArgumentParser) -> None:
    """Add --plan and what it takes."""
    plan = parser.add_argument_group("plan a session instead")
    plan.add_argument(
        "--plan",
        type=options.number(0.001, 3),
        metavar="SIGMA",
        help="print the faces, frames and time for this error (arcsec) of xi and of eta; takes --site, --instrument, "
        "the air, and no frames",
    )
    plan.add_argument(
        "--motion",
        type=options.number(0, 5),
        default=0.4,
        metavar="ARCSEC",
        help="image motion of a frame (0.4; starpos deflection prints that of a session)",
    )
    plan.add_argument(
        "--centroid",
        type=options.number(0.001, 5),
        default=0.1,
        metavar="PX",
        help="error of a star's centroid (0.1)",
    )
    plan.add_argument(
        "--limit-mag",
        type=options.number(2, 20),
        default=9.5,
        metavar="V",
        help="faintest stars on a frame (9.5)",
    )
    plan.add_argument(
        "--cadence",
        type=options.number(0.01, 600),
        default=5.0,
        metavar="S",
        help="from frame to frame (5)",
    )
    plan.add_argument(
        "--turning",
        type=options.number(0.01, 3600),
        default=60.0,
        metavar="S",
        help="from the last frame of a face to the first of the next (60)",
    )
    plan.add_argument(
        "--readings",
        type=options.number(1, 10_000, int),
        default=5,
        metavar="N",
        help="of the tiltmeter in a frame (5)",
    )
    plan.add_argument(
        "--level",
        type=options.number(0, 3600),
        default=10.0,
        metavar="ARCSEC",
        help="how well each face is levelled (10)",
    )
    options.add_frame_size(plan)


def run(args: argparse.Namespace, mark: Mark) -> int:
    """Print the plan; returns the exit status."""
    if args.frames or args.tilt is not None:
        raise InstrumentError("--plan is for a session that has no frames yet: leave out frames and --tilt")
    instrument = options.instrument_of(args, None)
    camera = instrument.camera or instrument.camera_for(*(instrument.size or args.size))
    state = earth_state(time.time())
    sky = ZenithSky.of(load_catalogue(), camera, mark.latitude, args.limit_mag, args.centroid, state.year)
    planner = Planner(
        instrument=instrument,
        camera=camera,
        atmosphere=options.atmosphere_of(args),
        mark=mark,
        sky=sky,
        routine=Routine(
            frame_s=args.cadence,
            turning_s=args.turning,
            readings=args.readings,
            level_rad=args.level * ARCSEC,
        ),
        motion_rad=args.motion * ARCSEC,
        state=state,
    )
    try:
        plan = planner.quickest(args.plan)
    except FixError as error:
        console.complain("deflection", error)
        return NO_PLAN
    value = _plan_json(plan, sky)
    if args.json:
        console.print_json(value)
    else:
        print(_plan_text(value))
    return 0


def _plan_json(plan: SessionPlan, sky: ZenithSky) -> dict:
    sigma_xi, sigma_eta = plan.sigma_arcsec
    return {
        "plan": True,
        "rounds": plan.rounds,
        "faces": plan.faces,
        "frames_a_face": plan.frames,
        "frames": plan.faces * plan.frames,
        "duration_s": plan.duration_s,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "stars_a_frame": sky.stars,
        "errors": {name: [xi, eta] for name, xi, eta in plan.terms},
    }


def _plan_text(value: dict) -> str:
    largest = sorted(value["errors"].items(), key=lambda item: -max(item[1]))[:4]
    sizes = ", ".join(f"{name} {xi:.3f} {eta:.3f}" for name, (xi, eta) in largest)
    return (
        f"{value['faces']} faces (a quarter turn from one to the next, {value['rounds']} "
        f"{'round' if value['rounds'] == 1 else 'rounds'}) of {value['frames_a_face']} frames, "
        f"{value['duration_s'] / 60:.0f} min: xi +- {value['sigma_xi_arcsec']:.3f}, eta +- "
        f"{value['sigma_eta_arcsec']:.3f} arcsec, {value['stars_a_frame']:.0f} stars a frame\n"
        f"largest errors (xi, eta): {sizes}"
    )
