# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`: the deflection of the vertical at a known site, from a zenith camera's frames and tilts."""

import argparse
import os
from dataclasses import replace

import numpy as np

from starpos.cli import console, jobs, options
from starpos.cli.archive import frames_among
from starpos.cli.inputs import checked_tilts, given_of, reader_of
from starpos.cli.output import Output, add_formats
from starpos.errors import FixError, FrameError, InstrumentError
from starpos.fix.solution import Solution
from starpos.instrument.axis import with_frame_size
from starpos.night.reading import First
from starpos.night.remarks import of_inclinometer
from starpos.night.sightings import DeflectionSession, ZenithSighted
from starpos.night.work import OnFile
from starpos.units import ARCSEC
from starpos.utc import utc_text
from starpos.zenith.doubts import remarks
from starpos.zenith.reductions import Reduced, reduced
from starpos.zenith.sighting import Mark, ZenithSighting

NO_DEFLECTION = 1
COLUMNS = ("file", "combined", "status", "utc", "face", "heading", "xi_arcsec", "eta_arcsec", "sigma_xi_arcsec",
           "sigma_eta_arcsec", "stars_matched", "residual_arcsec", "faces", "frames")  # fmt: skip
HEAD = "file: face, heading of the frame's top (deg), xi and eta (arcsec) of the frame alone, with the session's A3"
JSON_HELP = (
    "one JSON object a frame, and one with combined: true: xi_arcsec, eta_arcsec at the mark as the plumb line stood, "
    "covariance_arcsec2 (2 x 2), errors (1 sigma of xi, eta for each source), reduced (without the tide; at the geoid)"
)


def define(parser: argparse.ArgumentParser) -> None:
    options.add_frames(parser)
    add_formats(
        parser, JSON_HELP, "a row of a CSV a frame, and one with combined=True; columns as keys of --json"
    )
    parser.add_argument(
        "--tilt", metavar="CSV", required=True, help="the tiltmeter's readings, as for starpos solve"
    )
    parser.add_argument(
        "--site",
        type=float,
        nargs=3,
        required=True,
        metavar=("LAT", "LON", "HEIGHT"),
        help="the mark on WGS 84: latitude, longitude (deg) and height (m); 1 m off is 0.03 arcsec of the deflection",
    )
    options.add_stamps(parser)
    options.add_instrument(parser)
    options.add_air(parser)
    jobs.add_jobs(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    mark, read = _mark_of(args), reader_of(args)
    output = Output(args, COLUMNS, HEAD)
    frames = frames_among(args.frames, args.tilt)
    with jobs.workers_of(args, len(frames)) as workers:
        (about,) = workers.map([(First(read), tuple(frames))])
        if about is None:
            # says why
            read(frames[0])
            return console.UNREADABLE
        instrument, doubt = with_frame_size(options.instrument_of(args, about), about)
        if doubt:
            console.complain("deflection", doubt)
        given = replace(given_of(args, about), instrument=instrument)
        tilts = checked_tilts("deflection", os.path.abspath(args.tilt), instrument)
        for remark in of_inclinometer(instrument):
            console.complain("deflection", remark)
        jobs.prepare("deflection", instrument, about)
        air = options.atmosphere_of(args)
        work = OnFile(read, ZenithSighted(given, air, tilts, mark))
        answers = list(jobs.watched(workers.map((work, path) for path in frames), len(frames), silent=False))
    rows = dict(zip(frames, answers, strict=True))
    for path, answer in rows.items():
        if not isinstance(answer, ZenithSighting):
            console.complain("deflection", _why(path, answer))
    sightings = [answer for answer in answers if isinstance(answer, ZenithSighting)]
    try:
        session = DeflectionSession.of(sightings, instrument, air, mark)
    except FixError as error:
        console.complain("deflection", error)
        return NO_DEFLECTION
    for said in remarks(session.adjusted, session.sightings, len(frames), instrument.inclinometer.scale):
        console.complain("deflection", said)
    at = {id(s): k for k, s in enumerate(session.sightings)}
    for path, answer in rows.items():
        if isinstance(answer, ZenithSighting):
            value = _frame_json(path, session, at[id(answer)])
            output.put(value, _frame_line(value))
        else:
            output.put({"file": path, "status": "left out", "message": _why(path, answer)}, "")
    whole = _combined_json(session, reduced(session.adjusted, session.sightings, mark))
    output.put(whole, _combined_text(session, whole))
    return console.UNREADABLE if any(isinstance(a, FrameError) for a in answers) else 0


def _mark_of(args: argparse.Namespace) -> Mark:
    latitude, longitude, height_m = args.site
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height_m <= 9000):
        raise InstrumentError(
            f"--site {latitude:g} {longitude:g} {height_m:g}: give latitude and longitude in deg and the height in m"
        )
    return Mark(float(np.radians(latitude)), float(np.radians(longitude)), height_m)


def _why(path: str, answer: Solution | FrameError) -> str:
    said = str(answer) if isinstance(answer, FrameError) else answer.message
    return said if path in said else f"{path}: {said}"


def _frame_json(path: str, session: DeflectionSession, k: int) -> dict:
    s, found = session.sightings[k], session.adjusted
    xi, eta = found.frame_arcsec[k] + [found.xi_arcsec, found.eta_arcsec]
    sigma_xi, sigma_eta = found.frame_stddev_arcsec[k]
    return {
        "file": path,
        "status": "ok",
        "utc": utc_text(s.utc_unix_s),
        "face": int(found.faces[k]) + 1,
        "heading": np.degrees(s.heading),
        "xi_arcsec": xi,
        "eta_arcsec": eta,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "tilt_arcsec": s.tilt.theta[:2] / ARCSEC,
        "stars_matched": len(s.stars),
        "residual_arcsec": s.residual_rms_arcsec,
    }


def _frame_line(value: dict) -> str:
    return (
        f"{value['file']}: face {value['face']}, {value['heading']:.2f}, xi {value['xi_arcsec']:+.3f}, eta "
        f"{value['eta_arcsec']:+.3f} +- {value['sigma_xi_arcsec']:.3f} {value['sigma_eta_arcsec']:.3f}, "
        f"{value['stars_matched']} stars"
    )


def _combined_json(session: DeflectionSession, without: Reduced) -> dict:
    found = session.adjusted
    sigma_xi, sigma_eta = found.sigma_arcsec
    return {
        "combined": True,
        "status": "ok",
        "utc": utc_text(session.mid_unix_s),
        "xi_arcsec": found.xi_arcsec,
        "eta_arcsec": found.eta_arcsec,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "covariance_arcsec2": found.covariance_arcsec2,
        "faces": int(found.faces.max()) + 1,
        "frames": len(session.sightings),
        "errors": {name: [xi, eta] for name, xi, eta in found.terms},
        "image_motion_arcsec": found.air.motion / ARCSEC,
        "anomalous_refraction_arcsec": found.air.anomalous / ARCSEC,
        "catalogue_factor": found.catalogue_factor,
        "chi2_per_degree": found.chi2_per_degree,
        "misalignment_deg": found.misalignment_deg,
        "reduced": {
            "tide_arcsec": without.tide_arcsec,
            "curvature_arcsec": [without.curvature_arcsec, 0.0],
            "mark_arcsec": without.mark_arcsec,
            "geoid_arcsec": without.geoid_arcsec,
        },
    }


def _combined_text(session: DeflectionSession, value: dict) -> str:
    found, without = session.adjusted, value["reduced"]
    parts = sorted(found.terms, key=lambda term: -np.hypot(*term[1:]))[:5]
    sizes = ", ".join(f"{name} {xi:.3f} {eta:.3f}" for name, xi, eta in parts)
    mark, geoid = without["mark_arcsec"], without["geoid_arcsec"]
    return (
        f"xi {found.xi_arcsec:+.3f} +- {value['sigma_xi_arcsec']:.3f}, eta {found.eta_arcsec:+.3f} +- "
        f"{value['sigma_eta_arcsec']:.3f} arcsec at the mark, of {value['frames']} frames in {value['faces']} faces\n"
        f"without the tide {mark[0]:+.3f} {mark[1]:+.3f}, at the geoid {geoid[0]:+.3f} {geoid[1]:+.3f} (normal plumb "
        "line)\n"
        f"image motion {value['image_motion_arcsec']:.2f} a frame, anomalous refraction "
        f"{value['anomalous_refraction_arcsec']:.3f}; largest errors (xi, eta): {sizes}"
    )
