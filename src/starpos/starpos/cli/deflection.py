# SPDX-License-Identifier: Apache-2.0
"""`starpos deflection`: the deflection of the vertical at a known site, from a zenith camera's frames and tilts."""

import argparse
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, options
from starpos.earth.place import Place
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, InstrumentError, TiltError
from starpos.instrument.tilt_log import TiltLog
from starpos.night.at_mark import session_of, why_none
from starpos.night.bag import is_bag
from starpos.night.opening import work_of
from starpos.night.reading import Each
from starpos.night.work import Solving, prepare
from starpos.units import ARCSEC, utc_text
from starpos.zenith.adjustment import DeflectionSession, FaceQuality, reduced
from starpos.zenith.sighting import ZenithSighting


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
    return (
        {
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
            "sigma_xi_arcsec": sigma_xi,
            "sigma_eta_arcsec": sigma_eta,
            "faces": int(found.faces.max()) + 1,
            "frames": len(found.sightings),
            "errors": {name: [xi, eta] for name, xi, eta in found.terms},
            "image_motion_arcsec": found.air.motion / ARCSEC,
            "anomalous_refraction_arcsec": found.air.anomalous / ARCSEC,
            "reduced": without,
            "by_face": [_face_json(face) for face in found.face_quality],
            "stars": len(found.stars),
        }
        | console.values(found, "xi_arcsec eta_arcsec covariance_arcsec2 correlations catalogue_factor")
        | console.values(found, "chi2_per_degree misalignment_deg")
    )


def _face_json(face: FaceQuality) -> dict:
    about = console.values(face, "frames off_arcsec stddev_arcsec chi2")
    return {"face": face.number + 1, "heading": face.heading_deg} | about


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
    each, given = _of_bag(args) if _is_bag(args) else _of_files(args)
    session, rows = session_of(each, given, mark, console.complain)
    output, at = console.Output(args, "deflection"), {id(s): k for k, s in enumerate(session.sightings)}
    for name, answer in rows:
        if isinstance(answer, ZenithSighting):
            value = frame_json(name, session, at[id(answer)])
            output.put(value, frame_line(value))
        else:
            output.put({"file": name, "status": "left out", "message": why_none(name, answer)}, "")
    whole = combined_json(session, reduced(session, mark), mark, args.station)
    output.put(whole, combined_text(session, whole))
    return console.UNREADABLE if any(isinstance(a, FrameError) for _, a in rows) else 0


def _of_files(args: argparse.Namespace) -> tuple[Each, Solving]:
    """What goes through the frames of files, and the work on them."""
    if not args.frames or args.tilt is None:
        raise InstrumentError("give frames and --tilt CSV, or a bag")
    read, frames = inputs.reader_of(args), inputs.frames_among(args.frames, args.tilt)
    about = read.one_of(frames)
    given, remarks = work_of(
        inputs.given_of(args, about), about, Path(args.tilt), options.atmosphere_of(args)
    )
    console.complain(*remarks, prepare(given.instruments, about, console.ProgressBar()))
    return inputs.each_of(args, read, frames, lines=False), given


def _is_bag(args: argparse.Namespace) -> bool:
    bag = [path for path in args.frames if is_bag(Path(path))]
    if bag and len(args.frames) > 1:
        raise FrameError(f"{bag[0]}: a bag is a session of its own: give it alone")
    if bag and args.tilt is not None:
        raise TiltError(f"{bag[0]}: a bag has its own tilts: leave out --tilt")
    return bool(bag)


def _of_bag(args: argparse.Namespace) -> tuple[Each, Solving]:
    """What goes through a bag's frames, and the work on them."""
    path = Path(args.frames[0])
    night = inputs.bag_of(path, args, Deflection())
    console.complain(*night.remarks)
    if not isinstance(night.work.tilts, TiltLog):
        raise TiltError(f"{path}: no usable tilt in it: record the topic tilt too")
    if not night.count:
        raise FrameError(f"{path}: no stars and no images in it: record the topic stars too")
    return lambda work: inputs.watched(night.each(work), night.count, lines=False), night.work


def _mark_of(args: argparse.Namespace) -> Place:
    latitude, longitude, height_m = args.site
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and -1000 <= height_m <= 9000):
        raise InstrumentError(
            f"--site {latitude:g} {longitude:g} {height_m:g}: give latitude and longitude in deg and the height in m"
        )
    return Place.on_ellipsoid(latitude, longitude, height_m=height_m)
