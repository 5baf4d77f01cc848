# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`: the deflection of the vertical at a known site, from a zenith camera's frames and tilts."""

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, options
from starpos.earth.place import Place
from starpos.errors import FixError, FrameError, InstrumentError, TiltError
from starpos.fix.solution import Solution
from starpos.instrument.instrument import Instrument, with_frame_size
from starpos.night.at_mark import ZenithSighted
from starpos.night.bag import each_frame, is_bag
from starpos.night.reading import First
from starpos.night.remarks import of_inclinometer
from starpos.night.work import OnFile
from starpos.units import ARCSEC, utc_text
from starpos.zenith.adjustment import DeflectionSession, FaceQuality, reduced
from starpos.zenith.doubts import checked_session, remarks
from starpos.zenith.sighting import ZenithSighting

COLUMNS = ("file", "combined", "status", "utc", "face", "heading", "xi_arcsec", "eta_arcsec", "sigma_xi_arcsec",
           "sigma_eta_arcsec", "stars_matched", "residual_arcsec", "faces", "frames")  # fmt: skip
HEAD = "file: face, heading of the frame's top (deg), xi and eta (arcsec) of the frame alone, with the session's A3"


def frame_json(path: str, found: DeflectionSession, k: int) -> dict:
    """Frame k of a session, with the deflection that it alone has."""
    s = found.sightings[k]
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


def frame_line(value: dict) -> str:
    """A line for people of what `frame_json` returns."""
    return (
        f"{value['file']}: face {value['face']}, {value['heading']:.2f}, xi {value['xi_arcsec']:+.3f}, eta "
        f"{value['eta_arcsec']:+.3f} +- {value['sigma_xi_arcsec']:.3f} {value['sigma_eta_arcsec']:.3f}, "
        f"{value['stars_matched']} stars"
    )


def combined_json(
    found: DeflectionSession, without: dict[str, np.ndarray], mark: Place, station: str
) -> dict:
    """The session's value; station: name of the mark, '' for none."""
    sigma_xi, sigma_eta = found.sigma_arcsec
    return {
        "combined": True,
        "status": "ok",
        "station": station,
        "site": {
            "latitude": np.degrees(mark.latitude),
            "longitude": np.degrees(mark.longitude),
            "height_m": mark.height_m,
        },
        "utc": utc_text(found.mid_unix_s),
        "duration_s": found.sightings[-1].utc_unix_s - found.sightings[0].utc_unix_s,
        "xi_arcsec": found.xi_arcsec,
        "eta_arcsec": found.eta_arcsec,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "covariance_arcsec2": found.covariance_arcsec2,
        "faces": int(found.faces.max()) + 1,
        "frames": len(found.sightings),
        "errors": {name: [xi, eta] for name, xi, eta in found.terms},
        "correlations": found.correlations,
        "image_motion_arcsec": found.air.motion / ARCSEC,
        "anomalous_refraction_arcsec": found.air.anomalous / ARCSEC,
        "catalogue_factor": found.catalogue_factor,
        "chi2_per_degree": found.chi2_per_degree,
        "misalignment_deg": found.misalignment_deg,
        "reduced": without,
        "by_face": [_face_json(face) for face in found.face_quality],
        "stars": len(found.stars),
    }


def _face_json(face: FaceQuality) -> dict:
    return {
        "face": face.number + 1,
        "heading": face.heading_deg,
        "frames": face.frames,
        "off_arcsec": face.off_arcsec,
        "stddev_arcsec": face.stddev_arcsec,
        "chi2": face.chi2,
    }


def combined_text(found: DeflectionSession, value: dict) -> str:
    """The session's value in a few lines for people."""
    without = value["reduced"]
    parts = sorted(found.terms, key=lambda term: -np.hypot(*term[1:]))[:5]
    sizes = ", ".join(f"{name} {xi:.3f} {eta:.3f}" for name, xi, eta in parts)
    mark, geoid = without["mark_arcsec"], without["geoid_arcsec"]
    return "\n".join(
        (
            f"xi {found.xi_arcsec:+.3f} +- {value['sigma_xi_arcsec']:.3f}, eta {found.eta_arcsec:+.3f} +- "
            f"{value['sigma_eta_arcsec']:.3f} arcsec at the mark, of {value['frames']} frames in {value['faces']} faces",
            f"without the tide {mark[0]:+.3f} {mark[1]:+.3f}, at the geoid {geoid[0]:+.3f} {geoid[1]:+.3f} (normal "
            "plumb line)",
            f"image motion {value['image_motion_arcsec']:.2f} a frame, anomalous refraction "
            f"{value['anomalous_refraction_arcsec']:.3f}; largest errors (xi, eta): {sizes}",
            *(_face_text(face) for face in value["by_face"]),
        )
    )


def _face_text(face: dict) -> str:
    (xi, eta), (sigma_xi, sigma_eta) = face["off_arcsec"], face["stddev_arcsec"]
    return (
        f"face {face['face']} ({face['heading']:.0f} deg, {face['frames']} frames) minus the others: xi {xi:+.3f} +- "
        f"{sigma_xi:.3f}, eta {eta:+.3f} +- {sigma_eta:.3f}, chi-square {face['chi2']:.1f}"
    )


def run(args: argparse.Namespace) -> int:
    mark = _mark_of(args)
    taken = _of_bag(args, mark) if _is_bag(args) else _of_files(args, mark)
    return console.UNREADABLE if taken is None else _tell(args, taken, mark)


@dataclass(frozen=True, eq=False)
class _Taken:
    """A session's frames: their names, and their sightings or the errors."""

    names: list[str]
    answers: list[ZenithSighting | Solution | FrameError]
    instrument: Instrument


def _of_files(args: argparse.Namespace, mark: Place) -> _Taken | None:
    """The sightings of files; None where no frame can be read, which has been said."""
    if not args.frames or args.tilt is None:
        raise InstrumentError("give frames and --tilt CSV, or a bag")
    read = inputs.reader_of(args)
    frames = inputs.frames_among(args.frames, args.tilt)
    with inputs.workers_of(args, frames) as workers:
        (about,) = workers.map([(First(read), tuple(frames))])
        if about is None:
            # says why
            read(frames[0])
            return None
        instrument, doubt = with_frame_size(options.instrument_of(args, about), about)
        console.complain(doubt)
        given = replace(inputs.given_of(args, about), instrument=instrument)
        tilts = inputs.checked_tilts(os.path.abspath(args.tilt), instrument)
        inputs.prepare(instrument, about)
        work = OnFile(read, ZenithSighted(given, options.atmosphere_of(args), tilts, mark))
        answers = list(inputs.watched(workers.map((work, path) for path in frames), len(frames), lines=False))
    return _Taken(frames, answers, instrument)


def _is_bag(args: argparse.Namespace) -> bool:
    bag = [path for path in args.frames if is_bag(Path(path))]
    if bag and len(args.frames) > 1:
        raise FrameError(f"{bag[0]}: a bag is a session of its own: give it alone")
    if bag and args.tilt is not None:
        raise TiltError(f"{bag[0]}: a bag has its own tilts: leave out --tilt")
    return bool(bag)


def _of_bag(args: argparse.Namespace, mark: Place) -> _Taken:
    """The sightings of a bag's frames."""
    path = Path(args.frames[0])
    found, instruments = inputs.read_bag(path, args)
    console.complain(*found.remarks)
    if found.tilts is None:
        raise TiltError(f"{path}: no usable tilt in it: record the topic tilt too")
    if not found.star_count:
        raise FrameError(f"{path}: no stars and no images in it: record the topic stars too")
    work = ZenithSighted(instruments, options.atmosphere_of(args), found.tilts, mark)
    names, answers = [], []
    for name, item in inputs.watched(each_frame(found), found.star_count, lines=False):
        names.append(name)
        answers.append(item if isinstance(item, FrameError) else work(item))
    assert instruments.instrument is not None
    return _Taken(names, answers, instruments.instrument)


def _tell(args: argparse.Namespace, taken: _Taken, mark: Place) -> int:
    """Adjust the session and print it; returns the exit status."""
    output = console.Output(args, COLUMNS, HEAD)
    console.complain(*of_inclinometer(taken.instrument))
    rows = list(zip(taken.names, taken.answers, strict=True))
    for name, answer in rows:
        if not isinstance(answer, ZenithSighting):
            console.complain(_why(name, answer))
    sightings = [answer for answer in taken.answers if isinstance(answer, ZenithSighting)]
    try:
        session = checked_session(sightings, taken.instrument, options.atmosphere_of(args), mark)
    except FixError as error:
        console.complain(error)
        return console.NOTHING
    scale = taken.instrument.inclinometer.scale
    console.complain(*remarks(session, len(rows), scale))
    at = {id(s): k for k, s in enumerate(session.sightings)}
    for name, answer in rows:
        if isinstance(answer, ZenithSighting):
            value = frame_json(name, session, at[id(answer)])
            output.put(value, frame_line(value))
        else:
            output.put({"file": name, "status": "left out", "message": _why(name, answer)}, "")
    without = reduced(session, mark)
    whole = combined_json(session, without, mark, args.station)
    output.put(whole, combined_text(session, whole))
    return console.UNREADABLE if any(isinstance(a, FrameError) for a in taken.answers) else 0


def _mark_of(args: argparse.Namespace) -> Place:
    latitude, longitude, height_m = args.site
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height_m <= 9000):
        raise InstrumentError(
            f"--site {latitude:g} {longitude:g} {height_m:g}: give latitude and longitude in deg and the height in m"
        )
    return Place.on_ellipsoid(latitude, longitude, height_m=height_m)


def _why(path: str, answer: Solution | FrameError) -> str:
    said = str(answer) if isinstance(answer, FrameError) else answer.message
    return said if path in said else f"{path}: {said}"
