# SPDX-License-Identifier: Apache-2.0
"""What `starpos deflection` prints: a frame's line, and the session's value with its errors and its quality."""

import numpy as np

from starpos.night.sightings import DeflectionSession
from starpos.sky.catalogue import Catalogue
from starpos.units import ARCSEC
from starpos.utc import utc_text
from starpos.zenith.quality import FaceQuality, StarQuality
from starpos.zenith.reductions import Reduced
from starpos.zenith.sighting import Mark

COLUMNS = ("file", "combined", "status", "utc", "face", "heading", "xi_arcsec", "eta_arcsec", "sigma_xi_arcsec",
           "sigma_eta_arcsec", "stars_matched", "residual_arcsec", "faces", "frames")  # fmt: skip
HEAD = "file: face, heading of the frame's top (deg), xi and eta (arcsec) of the frame alone, with the session's A3"
JSON_HELP = (
    "one JSON object a frame, and one with combined: true: xi_arcsec, eta_arcsec at the mark as the plumb line stood, "
    "covariance_arcsec2 (2 x 2), errors (1 sigma of xi, eta for each source) and correlations, reduced (without the "
    "tide; at the geoid), by_face and by_star (residuals, leverage); starpos stations and starpos report read it"
)
# number of stars listed, largest leverage first
STARS_LISTED = 50


def frame_json(path: str, session: DeflectionSession, k: int) -> dict:
    """Frame k of a session, with the deflection that it alone has."""
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


def frame_line(value: dict) -> str:
    """A line for people of what `frame_json` returns."""
    return (
        f"{value['file']}: face {value['face']}, {value['heading']:.2f}, xi {value['xi_arcsec']:+.3f}, eta "
        f"{value['eta_arcsec']:+.3f} +- {value['sigma_xi_arcsec']:.3f} {value['sigma_eta_arcsec']:.3f}, "
        f"{value['stars_matched']} stars"
    )


def combined_json(
    session: DeflectionSession, without: Reduced, mark: Mark, station: str, catalogue: Catalogue
) -> dict:
    """The session's value; station: name of the mark, '' for none.  catalogue: of which its stars are rows."""
    found = session.adjusted
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
        "utc": utc_text(session.mid_unix_s),
        "duration_s": session.sightings[-1].utc_unix_s - session.sightings[0].utc_unix_s,
        "xi_arcsec": found.xi_arcsec,
        "eta_arcsec": found.eta_arcsec,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "covariance_arcsec2": found.covariance_arcsec2,
        "faces": int(found.faces.max()) + 1,
        "frames": len(session.sightings),
        "errors": {name: [xi, eta] for name, xi, eta in found.terms},
        "correlations": found.correlations,
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
        "by_face": [_face_json(face) for face in found.face_quality],
        "stars": len(found.stars.stars),
        "by_star": _stars_json(found.stars, catalogue),
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


def _stars_json(stars: StarQuality, catalogue: Catalogue) -> list[dict]:
    """The stars with the largest leverage, in order of it."""
    first = np.argsort(-np.hypot(*stars.leverage_arcsec.T), kind="stable")[:STARS_LISTED]
    names, magnitudes = catalogue.labels(stars.stars[first])
    return [
        {
            "star": name,
            "vmag": vmag,
            "frames": stars.frames[k],
            "mean_arcsec": stars.mean_arcsec[k],
            "rms_arcsec": stars.rms_arcsec[k],
            "leverage_arcsec": stars.leverage_arcsec[k],
        }
        for name, vmag, k in zip(names, magnitudes.tolist(), first.tolist(), strict=True)
    ]


def combined_text(session: DeflectionSession, value: dict) -> str:
    """The session's value in a few lines for people."""
    found, without = session.adjusted, value["reduced"]
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
            *(_star_text(star, value["stars"]) for star in value["by_star"][:1]),
        )
    )


def _face_text(face: dict) -> str:
    (xi, eta), (sigma_xi, sigma_eta) = face["off_arcsec"], face["stddev_arcsec"]
    return (
        f"face {face['face']} ({face['heading']:.0f} deg, {face['frames']} frames) minus the others: xi {xi:+.3f} +- "
        f"{sigma_xi:.3f}, eta {eta:+.3f} +- {sigma_eta:.3f}, chi-square {face['chi2']:.1f}"
    )


def _star_text(star: dict, stars: int) -> str:
    xi, eta = star["leverage_arcsec"]
    return (
        f"of {stars} stars {star['star']} (V {star['vmag']:.1f}, {star['frames']} frames) counts most: 1 sigma of its "
        f"catalogue place would move xi by {xi:.4f}, eta by {eta:.4f}, if the session did not correct it"
    )
