# SPDX-License-Identifier: Apache-2.0
"""Files of the Global Meteor Network's RMS: its `.config` and platepar, read as a first lens and a place, and written.

A platepar says where each pixel of a fixed camera looks. Its sky is RMS's own (mean sidereal time, precession of 1976, a
refraction by altitude alone, no aberration): what is written is fitted to the sky as RMS computes it at the frames' time.
"""

import configparser
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import erfa
import numpy as np

from starpos import files, rotation
from starpos.errors import InstrumentError
from starpos.frames.fits import rms_config
from starpos.instrument.camera import EQUIDISTANT, Camera, pixels_over
from starpos.instrument.instrument import Instrument
from starpos.units import DAY_S, UNIX_EPOCH_JD

# a platepar lists the stars of its fit
MAX_BYTES = 4_000_000
# points along a side of the frame at which lenses are compared, and the angle off the axis up to which they are, rad
SIDE, FURTHEST = 41, np.radians(95)
# odd powers of r after the first, and the distortion type that has these four
POWERS, ODD_TERMS = (3, 5, 7, 9), "radial9-odd"
# rounds in which the pointing is found, and what is left of it at the end, rad
ROUNDS, SETTLED = 50, 1e-10


@dataclass(frozen=True)
class RmsCamera:
    """What a file of RMS says of a camera: its lens, and its place on WGS 84 in deg (height above the sea in m)."""

    instrument: Instrument
    latitude_deg: float
    longitude_deg: float
    height_m: float


def is_rms(path: Path | str) -> bool:
    """Whether a file has the name of a platepar (*.cal) or of RMS's configuration (.config)."""
    return Path(path).suffix == ".cal" or Path(path).name.endswith(".config")


def read(path: Path | str) -> RmsCamera:
    """Read a platepar (JSON), or a `.config`; InstrumentError says why a file cannot be used."""
    path = Path(path)
    try:
        text = files.read_regular(path, MAX_BYTES).decode()
        return _of_platepar(json.loads(text)) if path.suffix == ".cal" else _of_config(text)
    except OSError as e:
        raise InstrumentError(f"{path}: not a readable file of RMS ({e.strerror})") from None
    except InstrumentError as e:
        raise InstrumentError(f"{path}: {e}") from None
    except (TypeError, ValueError, LookupError, ArithmeticError, RecursionError, configparser.Error) as e:
        raise InstrumentError(
            f"{path}: not a platepar in JSON, nor RMS's .config: {' '.join(repr(e)[:100].split())}"
        ) from None


def _of_config(text: str) -> RmsCamera:
    parser = rms_config(text)
    place, capture = parser["System"], parser["Capture"]
    width, height, fov_deg = (float(capture[k]) for k in ("width", "height", "fov_w"))
    camera = Camera.from_focal(int(width), int(height), float(width / np.radians(fov_deg)), EQUIDISTANT)
    return _station(camera, *(float(place[k]) for k in ("latitude", "longitude", "elevation")))


def _of_platepar(plate: Mapping[str, Any]) -> RmsCamera:
    xy = pixels_over(int(plate["X_res"]), int(plate["Y_res"]), SIDE)
    aspect, off = _undistorted(plate, xy)
    theta = np.radians(np.hypot(*off.T) / float(plate["F_scale"]))
    use = np.isfinite(theta) & (theta < FURTHEST)
    if use.sum() < len(xy) / 8:
        raise InstrumentError("its distortion leaves hardly any pixel a direction")
    cx, cy, *a = _radial_fit(xy[use], theta[use], np.arctan2(off[use, 1], off[use, 0]), aspect).tolist()
    camera = Camera(
        width=int(plate["X_res"]),
        height=int(plate["Y_res"]),
        fx=a[0],
        fy=a[0] / aspect,
        cx=cx,
        cy=cy,
        distortion=tuple(k / a[0] for k in a[1:]),
        model=EQUIDISTANT,
    )
    return _station(camera, *(float(plate[k]) for k in ("lat", "lon", "elev")))


def _station(camera: Camera, latitude_deg: float, longitude_deg: float, height_m: float) -> RmsCamera:
    if not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180 and np.isfinite(height_m)):
        raise InstrumentError(f"its place {latitude_deg:g} {longitude_deg:g} cannot be")
    return RmsCamera(Instrument(camera.fx, camera=camera), latitude_deg, longitude_deg, height_m)


def _radial_fit(xy: np.ndarray, theta: np.ndarray, phi: np.ndarray, aspect: float) -> np.ndarray:
    """cx, cy and factors (5,) of theta, theta^3, ... with which directions are seen at xy (N, 2); rows are 1 / aspect."""
    radial = theta[:, None] ** np.array([1, *POWERS])
    none, one = np.zeros(len(xy)), np.ones(len(xy))
    design = np.vstack(
        [
            np.column_stack([one, none, radial * np.cos(phi)[:, None]]),
            np.column_stack([none, one, radial * np.sin(phi)[:, None]]),
        ]
    )
    found = np.linalg.lstsq(design, np.append(xy[:, 0], xy[:, 1] * aspect), rcond=None)[0]
    found[1] /= aspect
    return found


def _terms(plate: Mapping[str, Any], way: str) -> tuple[float, float, float, float, float, np.ndarray]:
    """x0, y0 in px, aspect, size and angle of the asymmetry, and coefficients of a radial distortion, `fwd` or `rev`."""
    values = [float(v) for v in plate[f"x_poly_{way}"]]
    half = np.array([plate["X_res"], plate["Y_res"]], float) / 2
    x0, y0 = (
        (0.5, 0.5)
        if plate.get("force_distortion_centre")
        else np.array([values.pop(0), values.pop(0)]) * half
    )
    # RMS wraps the centre into the frame
    x0, y0 = (np.array([x0, y0]) + half) % (2 * half) - half
    aspect = 1.0 if plate.get("equal_aspect") else 1.0 + values.pop(0)
    a1, a2 = (values.pop(0), values.pop(0) * 2 * np.pi) if plate.get("asymmetry_corr") else (0.0, 0.0)
    return x0, y0, aspect, a1, a2, np.array(values)


def _stretched(plate: Mapping[str, Any], r: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Correction of radii r (N,), in half widths, over r, by a radial distortion's coefficients."""
    kind = plate["distortion_type"]
    order, powers = int(kind[len("radial")]), kind.partition("-")[2]
    if powers not in ("all", "odd"):
        raise InstrumentError(f"its distortion is {kind[:40]!r}, which is not understood")
    exponents = np.arange(2, order + 1) if powers == "all" else np.arange(3, order + 1, 2)
    return (r[:, None] ** (exponents - 1)) @ k[: len(exponents)]


def _undistorted(plate: Mapping[str, Any], xy: np.ndarray) -> tuple[float, np.ndarray]:
    """Height over width of a pixel, and places (N, 2) in px that pixels have without distortion, from the centre."""
    x, y = (xy - np.array([plate["X_res"], plate["Y_res"]]) / 2).T
    kind = plate.get("distortion_type", "poly3+radial")
    if kind.startswith("radial"):
        x0, y0, aspect, a1, a2, k = _terms(plate, "fwd")
        x, y = x - x0, (y - y0) * aspect
        r = (np.hypot(x, y) + a1 * (y * np.cos(a2) - x * np.sin(a2))) / (plate["X_res"] / 2)
        return aspect, np.stack([x, y], -1) * (1 + _stretched(plate, r, k))[:, None]
    px, py = (np.array(plate.get(f"{axis}_poly_fwd", plate.get(f"{axis}_poly")), float) for axis in "xy")
    r = np.hypot(x - px[0], y - py[0])
    shared = [np.ones(len(x)), x, y, x**2, x * y, y**2, x**3, x**2 * y, x * y**2, y**3]
    # RMS puts the last two of the first radial terms crosswise
    higher = [r**3, r**5][: len(px) - 12]
    dx = np.stack([*shared, x * r, y * r, *(x * h for h in higher)], -1) @ px
    dy = np.stack([*shared, y * r, x * r, *(y * h for h in higher)], -1) @ py
    return 1.0, np.stack([x + dx, y + dy], -1)


def platepar_of(
    camera: Camera, xy: np.ndarray, icrs: np.ndarray, utc_unix_s: float, place: tuple[float, float, float]
) -> tuple[dict[str, Any], float]:
    """The content of a platepar, and by how many px at most RMS then sees a direction elsewhere than the camera.

    xy (N, 2) in px, icrs (N, 3): where, without aberration and refraction, the light at each pixel comes from.
    place: latitude, longitude in rad on WGS 84, and height above the sea in m.
    Its photometry is not calibrated: RMS's defaults.  InstrumentError for a camera that looks at a celestial pole.
    """
    jd = UNIX_EPOCH_JD + utc_unix_s / DAY_S
    *site, height_m = place
    rays = camera.directions(*xy.T)
    apparent = _refracted(icrs, jd, *site)
    to_sky = rotation.best_rotation(rays, apparent)
    ra, dec = erfa.c2s(to_sky[:, 2])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    right, north = to_sky[:, 0], np.cross(to_sky[:, 2], east)
    seen_at = np.array([ra, dec, np.arctan2(right @ north, -right @ east)])
    pointing = _reference(seen_at, jd, *site)
    plate = _lens_terms(camera) | {
        "version": 2,
        "station_code": "XX0001",
        "lat": float(np.degrees(site[0])),
        "lon": float(np.degrees(site[1])),
        "elev": float(height_m),
        "JD": jd,
        "Ho": float(np.degrees(_sidereal(jd))),
        "UT_corr": 0,
        "refraction": True,
        "measurement_apparent_to_true_refraction": False,
        "mag_0": -2.5,
        "mag_lev": 10.0,
        "mag_lev_stddev": 0.0,
        "gamma": 1.0,
        "vignetting_coeff": 0.001,
        "vignetting_fixed": True,
        "extinction_scale": 0.6,
        "star_list": [],
        "auto_check_fit_refined": False,
        "auto_recalibrated": False,
    }
    plate |= dict(zip(("RA_d", "dec_d", "pos_angle_ref"), np.degrees(pointing).tolist(), strict=True))
    east, north, up = _horizon(jd, *site) @ _precession(erfa.DJ00, jd) @ rotation.unit_vector(*pointing[:2])
    plate["az_centre"] = float(np.degrees(np.arctan2(east, north)) % 360)
    plate["alt_centre"] = float(np.degrees(_raised(np.arcsin(up))))
    off = _distorted(plate, apparent @ to_sky) - xy
    return plate, float(np.hypot(*off.T).max())


def _lens_terms(camera: Camera) -> dict[str, Any]:
    """The keys of a platepar that say what its lens is like, by fits of the camera all over its frame."""
    xy = pixels_over(camera.width, camera.height, SIDE)
    xy = xy[camera.sees(*xy.T)]
    rays = camera.directions(*xy.T)
    theta, phi = np.arccos(np.clip(rays[:, 2], -1, 1)), np.arctan2(rays[:, 1], rays[:, 0])
    near = theta < FURTHEST
    xy, theta, phi = xy[near], theta[near], phi[near]
    aspect, half = camera.fx / camera.fy, camera.width / 2
    cx, cy, scale, *a = _radial_fit(xy, theta, phi, aspect)
    back = [-k / half * (half / scale) ** n for k, n in zip(a, POWERS, strict=True)]
    r = np.hypot(xy[:, 0] - cx, (xy[:, 1] - cy) * aspect) / half
    ahead = np.linalg.lstsq(r[:, None] ** np.array(POWERS), scale * theta / half - r, rcond=None)[0]
    start = [cx / half - 1, cy / (camera.height / 2) - 1, aspect - 1]
    none = [0.5, *[0.0] * 6]
    terms = {
        "x_poly_fwd": [*start, *ahead],
        "x_poly_rev": [*start, *back],
        "y_poly_fwd": none,
        "y_poly_rev": none,
    }
    terms |= {"x_poly": terms["x_poly_fwd"], "y_poly": none}
    middle_x, middle_y = camera.centre_px
    sides = camera.directions(
        [0, camera.width - 1, middle_x, middle_x], [middle_y, middle_y, 0, camera.height - 1]
    )
    across = np.degrees(np.arccos(np.clip(np.sum(sides[::2] * sides[1::2], 1), -1, 1)))
    return {name: [float(v) for v in values] for name, values in terms.items()} | {
        "X_res": camera.width,
        "Y_res": camera.height,
        "F_scale": float(np.radians(scale)),
        "distortion_type": ODD_TERMS,
        "poly_length": len(terms["x_poly_fwd"]),
        "equal_aspect": False,
        "force_distortion_centre": False,
        "asymmetry_corr": False,
        "fov_h": float(np.nan_to_num(across[0], nan=180.0)),
        "fov_v": float(np.nan_to_num(across[1], nan=180.0)),
        "focal_length": 0,
    }


def _distorted(plate: Mapping[str, Any], rays: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of rays (N, 3) about the axis of a platepar with a radial distortion, y down, as RMS has them."""
    x0, y0, aspect, _, _, k = _terms(plate, "rev")
    angle = np.degrees(np.arccos(np.clip(rays[:, 2], -1, 1))) * plate["F_scale"]
    x, y = rays[:, :2].T * angle / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)
    shorter = 1 - _stretched(plate, angle / (plate["X_res"] / 2), k)
    return np.stack(
        [x * shorter + x0 + plate["X_res"] / 2, y * shorter / aspect + y0 + plate["Y_res"] / 2], -1
    )


# RMS's sky, after Meeus; RMS computes it in Astrometry/CyFunctions


def _sidereal(jd: float) -> float:
    """Mean sidereal time in Greenwich, rad."""
    return float(erfa.gmst82(jd, 0.0))


def _precession(start_jd: float, end_jd: float) -> np.ndarray:
    """Rotation (3, 3) of mean equatorial axes from one date to another (IAU 1976)."""
    zeta, z, theta = erfa.prec76(start_jd, 0.0, end_jd, 0.0)
    return rotation.about_axis(2, z) @ rotation.about_axis(1, -theta) @ rotation.about_axis(2, zeta)


def _nutation(jd: float) -> np.ndarray:
    """The rotation (3, 3) by which RMS nutates a pointing."""
    t = (jd - erfa.DJ00) / erfa.DJC
    node, sun, moon = np.radians(
        [125.04452 - 1934.136261 * t, 280.4665 + 36000.7698 * t, 218.3165 + 481267.8813 * t]
    )
    sines, cosines = np.sin([node, 2 * sun, 2 * moon, 2 * node]), np.cos([node, 2 * sun, 2 * moon, 2 * node])
    longitude, obliquity = sines @ [-17.2, -1.32, -0.23, 0.21], cosines @ [9.2, 0.57, 0.1, -0.09]
    longitude, obliquity = np.radians(np.array([longitude, obliquity]) / 3600)
    return rotation.about_axis(2, longitude) @ rotation.about_axis(0, -obliquity)


def _horizon(jd: float, latitude: float, longitude: float) -> np.ndarray:
    """Rotation (3, 3) of equatorial axes of date into east, north, up."""
    time = _sidereal(jd) + longitude
    up, east = rotation.unit_vector(time, latitude), np.array([-np.sin(time), np.cos(time), 0.0])
    return np.stack([east, np.cross(up, east), up])


def _raised(altitude: np.ndarray) -> np.ndarray:
    """Altitudes in rad as they are seen."""
    deg = np.degrees(np.maximum(altitude, np.radians(-0.5)))
    return altitude + np.radians(1.02 / 60 / np.tan(np.radians(deg + 10.3 / (deg + 5.11))))


def _refracted(v: np.ndarray, jd: float, latitude: float, longitude: float) -> np.ndarray:
    """J2000 directions (N, 3) as refraction raises them, still along the axes of J2000."""
    of_date, to_local = _precession(erfa.DJ00, jd), _horizon(jd, latitude, longitude)
    local = v @ (to_local @ of_date).T
    raised = _raised(np.arcsin(np.clip(local[:, 2], -1, 1)))
    across = local[:, :2] / np.maximum(np.hypot(local[:, 0], local[:, 1]), 1e-12)[:, None]
    lifted = np.column_stack([across * np.cos(raised)[:, None], np.sin(raised)])
    return lifted @ to_local @ _precession(jd, erfa.DJ00).T


def _seen_pointing(reference: np.ndarray, jd: float, latitude: float, longitude: float) -> np.ndarray:
    """The right ascension, declination, position angle (3,) with which RMS works, for `reference` in a platepar."""
    ra, dec, angle = reference
    before = _refracted(rotation.unit_vector(ra, dec)[None], jd, latitude, longitude)[0]
    turn = _precession(jd, erfa.DJ00)
    after = _nutation(jd) @ turn @ before
    normal = np.cross(before, after)

    def along_parallel(normal: np.ndarray, axis: np.ndarray) -> float:
        """Angle from a normal to the parallel of declination, about an axis."""
        parallel = np.array([-axis[1], axis[0], 0.0])
        return float(np.arctan2(np.cross(normal, parallel) @ axis, normal @ parallel))

    change = along_parallel(turn @ normal, after) - along_parallel(normal, before)
    return np.array([*erfa.c2s(after), angle + change])


def _reference(seen: np.ndarray, jd: float, latitude: float, longitude: float) -> np.ndarray:
    """The right ascension, declination, position angle (3,) of a platepar with which RMS works with `seen`."""
    found = seen.copy()
    for _ in range(ROUNDS):
        off = rotation.half_turns(seen - _seen_pointing(found, jd, latitude, longitude))
        found += off
        if np.abs(off).max() < SETTLED:
            return np.array([found[0] % (2 * np.pi), found[1], rotation.half_turn(found[2]) % (2 * np.pi)])
    raise InstrumentError("the camera looks at a celestial pole, where a platepar has no position angle")
