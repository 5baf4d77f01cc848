# SPDX-License-Identifier: Apache-2.0
"""A simulated instrument under the stars: its frames, star lists and tilts, with their truth; and nights of them on
disk.
"""

import hashlib
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.special import erf

from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError
from starpos.files import read_regular
from starpos.frames.exposure import GLOBAL_SHUTTER, Shutter
from starpos.frames.frame import Frame, Stars
from starpos.frames.header import focal_mm
from starpos.frames.reading import FITS
from starpos.frames.tables import SIMULATED, TILTS, TRUTH, write_star_list
from starpos.frozen import at_once
from starpos.instrument.camera import PLUMB_BOB, Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.progress import Progress, quiet
from starpos.rotation import full_turn
from starpos.sky.catalogue import Catalogue
from starpos.sky.site import Site, camera_to_enu
from starpos.units import date_obs, unix_of

FWHM_PER_SIGMA = 2.354820045
# stated error of a simulated instrument's A3
STATED_ARCSEC = (5.0, 5.0, 5.0)
STAMP_SIGMAS = 5.0
STRIP_PX = 1 << 20
CENTROID_FLOOR_PX, DETECTED_SNR = 0.02, 6.0


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Telescope, detector and air; by default the paper's.

    zero_point_e_s: electrons per second of a star of V = 0.  seeing_arcsec: each star's own motion, 1 sigma.
    """

    fwhm_px: float = 2.4
    zero_point_e_s: float = 3.0e7
    sky_mag_arcsec2: float = 18.0
    read_noise_e: float = 6.0
    gain_e_dn: float = 1.0
    bias_dn: float = 512.0
    full_well_dn: float = 16383.0
    seeing_arcsec: float = 0.2
    limit_mag: float = 11.0


@dataclass(frozen=True)
class TiltErrors:
    """Errors of an inclinometer reading in rad: white noise, zero per axis, and the step `quantum`.

    scale: relative error of the angle itself, by axis.
    """

    noise: float = np.radians(0.0035)
    zero: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (0.0, 0.0)
    quantum: float = np.radians(0.0035 / 8)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """An instrument at a site, its pointing, and the times of its camera's rows."""

    camera: Camera
    instrument: Instrument
    site: Site
    azimuth_deg: float = 40.0
    altitude_deg: float = 78.0
    roll_deg: float = 15.0
    optics: Optics = field(default_factory=Optics)
    tilt_errors: TiltErrors = field(default_factory=TiltErrors)
    shutter: Shutter = GLOBAL_SHUTTER

    @property
    def attitude(self) -> np.ndarray:
        """Rotation (3, 3) of C into ENU."""
        return camera_to_enu(self.azimuth_deg, self.altitude_deg, self.roll_deg)

    @property
    def heading(self) -> float:
        """Azimuth in rad of the base link's x axis."""
        forward = self.attitude @ np.asarray(self.instrument.link_to_camera)[:, 0]
        return full_turn(np.arctan2(forward[0], forward[1]))

    @property
    def sky_e_s(self) -> float:
        """Electrons per second that the sky gives to each pixel."""
        optics = self.optics
        return optics.zero_point_e_s * 10 ** (-0.4 * optics.sky_mag_arcsec2) * self.camera.scale_arcsec**2

    @property
    def longest_s(self) -> float:
        """Exposure in s at which the sky alone saturates all pixels."""
        return (self.optics.full_well_dn - self.optics.bias_dn) * self.optics.gain_e_dn / self.sky_e_s

    @property
    def tilt(self) -> tuple[float, float]:
        """True theta_x, theta_y in rad."""
        up = self.instrument.calibration.a3 @ self.attitude[2]
        return float(np.arcsin(up[0])), float(np.arcsin(up[1]))


@at_once
@dataclass(frozen=True)
class Exposed:
    """Stars on a frame: pixels (n, 2) at start, middle and end of the exposure; electrons (n,); catalogue index (n,)."""

    start: np.ndarray
    middle: np.ndarray
    end: np.ndarray
    electrons: np.ndarray
    catalogue: np.ndarray


def expose(
    scene: Scene, catalogue: Catalogue, start_unix_s: float, exposure_s: float, rng: np.random.Generator
) -> Exposed:
    """Pixels where the light of each star falls, while the sky turns over the camera at rest."""
    camera, optics = scene.camera, scene.optics
    reach = min(camera.half_diagonal_rad * 1.02, np.pi)
    middle_state = earth_state(start_unix_s + exposure_s / 2)
    index = scene.site.overhead(catalogue, middle_state, scene.attitude[:, 2], reach, optics.limit_mag)
    moments = []
    for t in (start_unix_s, start_unix_s + exposure_s / 2, start_unix_s + exposure_s):
        state = middle_state if t == middle_state.utc_unix_s else earth_state(t)
        above = scene.site.observed(catalogue, index, state)
        pixels = camera.project(above @ scene.attitude)
        # the ground hides the others
        pixels[above[:, 2] < 0] = np.nan
        moments.append(pixels)
    px = np.stack(moments) + rng.normal(0, optics.seeing_arcsec / camera.scale_arcsec, (len(index), 2))
    with np.errstate(invalid="ignore"):
        on = ((px[1] > -6) & (px[1] < [camera.width + 5, camera.height + 5])).all(1)
    on &= np.isfinite(px).all((0, 2))
    electrons = optics.zero_point_e_s * exposure_s * 10 ** (-0.4 * catalogue.vmag(index))
    later_s = scene.shutter.later_s(px[1, :, 1], camera.height)
    # the trail is as good as straight
    px = px + (px[2] - px[0]) / exposure_s * later_s[:, None]
    start, middle, end = px[:, on]
    return Exposed(start, middle, end, electrons[on], index[on])


def render(
    scene: Scene, stars: Exposed, start_unix_s: float, exposure_s: float, rng: np.random.Generator
) -> Frame:
    """A 16-bit frame: trailed Gaussian images integrated over pixels, sky, photon and read noise, clipping."""
    camera, optics = scene.camera, scene.optics
    light = np.full(camera.height * camera.width, scene.sky_e_s * exposure_s, np.float32)
    place, amount = _star_light(camera, optics, stars)
    np.add.at(light, place, amount)
    pixels = np.empty(len(light), np.uint16)
    # in strips, because the noise of a whole frame takes 250 MB
    for begin in range(0, len(light), STRIP_PX):
        part = light[begin : begin + STRIP_PX]
        part += rng.standard_normal(len(part), dtype=np.float32) * np.sqrt(
            part + np.float32(optics.read_noise_e**2)
        )
        part *= np.float32(1 / optics.gain_e_dn)
        part += np.float32(optics.bias_dn + 0.5)
        np.clip(part, 0, optics.full_well_dn, out=part)
        pixels[begin : begin + STRIP_PX] = part
    return Frame(
        pixels.reshape(camera.height, camera.width),
        pattern="",
        mid_unix_s=start_unix_s + exposure_s / 2,
        exposure_s=exposure_s,
        source="simulated",
        focal_px=camera.fx,
        shutter=scene.shutter,
    )


def _star_light(camera: Camera, optics: Optics, stars: Exposed) -> tuple[np.ndarray, np.ndarray]:
    """Flat pixel indices and electrons of all stars' trailed images."""
    sigma = optics.fwhm_px / FWHM_PER_SIGMA
    trail = stars.end - stars.start
    longest = np.hypot(*trail.T).max(initial=0.0)
    steps = max(1, int(np.ceil(4 * longest)))
    reach = int(np.ceil(STAMP_SIGMAS * sigma + longest / 2)) + 1
    offset = np.arange(-reach, reach + 1)
    corner = np.round(stars.middle).astype(int)
    moments = (np.arange(steps) + 0.5) / steps
    # (n, steps, 2)
    along = stars.start[:, None] + moments[None, :, None] * trail[:, None]
    profile = []
    for k in range(2):
        # (n, steps, size)
        d = corner[:, k, None, None] + offset - along[:, :, k, None]
        profile.append(0.5 * (erf((d + 0.5) / (sigma * np.sqrt(2))) - erf((d - 0.5) / (sigma * np.sqrt(2)))))
    image = np.einsum("nsx,nsy->nyx", *profile) * (stars.electrons / steps)[:, None, None]
    x = corner[:, 0, None, None] + offset[None, None, :]
    y = corner[:, 1, None, None] + offset[None, :, None]
    on = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return (y * camera.width + x)[on], image[on].astype(np.float32)


def read_tilt(scene: Scene, rng: np.random.Generator) -> tuple[float, float]:
    """One inclinometer reading theta_x, theta_y (rad)."""
    e = scene.tilt_errors
    theta = np.array(scene.tilt) * (1 + np.asarray(e.scale)) + e.zero
    theta += rng.normal(0, 1, 2) * e.noise
    if e.quantum:
        theta = np.round(theta / e.quantum) * e.quantum
    return float(theta[0]), float(theta[1])


def scene_of(
    size: tuple[int, int] = (5616, 3744),
    focal_px: float = 93750.0,
    latitude_deg: float = 35.7046,
    longitude_deg: float = 51.4106,
    atmosphere: Atmosphere = Atmosphere(),
    pointing_deg: tuple[float, float, float] = (40.0, 78.0, 15.0),
    misalignment_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tilt_noise_deg: float = 0.0035,
    tilt_zero_deg: tuple[float, float] = (0.0, 0.0),
    readout_s: float = 0.0,
    lens: str = PLUMB_BOB,
) -> Scene:
    """The paper's instrument at a place; plain numbers for what is usually varied.

    Parameters
    ----------
    size : (width, height) of the frames, px
    focal_px : focal length, px
    latitude_deg, longitude_deg : of the place, astronomic
    atmosphere : its air
    pointing_deg : azimuth and altitude of the optical axis, and the camera's roll about it
    misalignment_deg : A3's three angles
    tilt_noise_deg, tilt_zero_deg : noise of the inclinometer's readings, and the error of its zero
    readout_s : time from the row read first to the last
    lens : its model

    Returns
    -------
    Scene
        what `write_night` simulates

    Examples
    --------
    >>> scene = starpos.scene_of((1000, 700), 4635.9375, latitude_deg=52.0, longitude_deg=4.4)
    >>> scene.site.latitude_deg
    52.0
    """
    azimuth_deg, altitude_deg, roll_deg = pointing_deg
    return Scene(
        camera=Camera.from_focal(size[0], size[1], focal_px, lens),
        instrument=Instrument(
            focal_px,
            model=lens,
            calibration=Calibration.of(misalignment_deg, STATED_ARCSEC),
            inclinometer=SCA100T_CALIBRATED,
            inclinometer_model="sca100t_calibrated",
        ),
        site=Site(latitude_deg, longitude_deg, atmosphere),
        azimuth_deg=azimuth_deg,
        altitude_deg=altitude_deg,
        roll_deg=roll_deg,
        tilt_errors=TiltErrors(
            np.radians(tilt_noise_deg),
            tuple(np.radians(tilt_zero_deg)),
            quantum=np.radians(tilt_noise_deg / 8),
        ),
        shutter=Shutter(readout_s, 0.0),
    )


def detected(
    scene: Scene,
    stars: Exposed,
    mid_unix_s: float,
    exposure_s: float,
    rng: np.random.Generator,
    source: str = "simulated",
) -> Stars:
    """The list of a good detector: errors by photon noise with a floor of 0.02 px, stars of SNR above 6 only."""
    optics, camera, sky = scene.optics, scene.camera, scene.sky_e_s * exposure_s
    area = np.pi * optics.fwhm_px**2
    snr = stars.electrons / np.sqrt(stars.electrons + area * (sky + optics.read_noise_e**2))
    sigma = np.hypot(optics.fwhm_px / FWHM_PER_SIGMA / snr, CENTROID_FLOOR_PX)
    xy = stars.middle + rng.normal(0, 1, stars.middle.shape) * sigma[:, None]
    seen = (snr > DETECTED_SNR) & (xy >= 0).all(1) & (xy <= [camera.width - 1, camera.height - 1]).all(1)
    order = np.flatnonzero(seen)[np.argsort(-stars.electrons[seen], kind="stable")]
    return Stars(
        x=xy[order, 0],
        y=xy[order, 1],
        flux=stars.electrons[order],
        snr=snr[order],
        covariance=np.eye(2) * (sigma[order] ** 2)[:, None, None],
        flags=np.zeros(len(order), np.uint8),
        width=camera.width,
        height=camera.height,
        mid_unix_s=mid_unix_s,
        exposure_s=exposure_s,
        source=source,
        focal_px=camera.fx,
        shutter=scene.shutter,
    )


TILT_RATE_HZ = 10.0
MAX_BYTES = 1 << 31


def write_night(
    folder: Path | str,
    scene: Scene,
    catalogue: Catalogue,
    start_utc: str,
    frames: int,
    cadence_s: float,
    exposure_s: float,
    turn_deg: float,
    stars_only: bool,
    rng: np.random.Generator,
    progress: Progress = quiet,
    pixel_um: float = 1.0,
) -> None:
    """Write `frames` exposures of a scene that turns by turn_deg of azimuth from one to the next.

    Parameters
    ----------
    folder : of the night; a simulated night that is in it is replaced
    scene : instrument, place and pointing of the first frame
    catalogue : of the stars in the sky
    start_utc : start of the first exposure, ISO 8601
    frames, cadence_s, exposure_s : number of exposures, time from start to start, and length of each, s
    turn_deg : turn of azimuth from frame to frame
    stars_only : whether lists of stars (CSV) are written in place of frames (FITS)
    rng : of all noise
    progress : is called with the share of the work that is done
    pixel_um : with the focal length in px it makes the headers' focal length in mm

    Returns
    -------
    None

    Raises
    ------
    FrameError
        the folder holds frames or tilts that were not simulated, or cannot be written

    Examples
    --------
    >>> scene, sky = starpos.scene_of((1000, 700), 4635.9375), starpos.load_catalogue()
    >>> noise = np.random.default_rng(1)
    >>> starpos.write_night("mine", scene, sky, "2026-11-02T18:00:00", 2, 5.0, 0.5, 0.0, True, noise)
    >>> starpos.open_night("mine")
    <mine: 2 frames and tilt.csv, to be solved>
    """
    begin = unix_of(start_utc)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _take_away_simulated(folder)
        truth, tilts, names = [], [], []
        for k in range(frames):
            now = replace(scene, azimuth_deg=scene.azimuth_deg + k * turn_deg)
            start = begin + k * cadence_s
            stars = expose(now, catalogue, start, exposure_s, rng)
            names.append(f"stars_{k:04d}.csv" if stars_only else f"frame_{k:04d}.fits")
            if stars_only:
                listed = detected(now, stars, start + exposure_s / 2, exposure_s, rng)
                write_star_list(folder / names[-1], listed, date_obs(start), pixel_um)
            else:
                frame = render(now, stars, start, exposure_s, rng)
                write_fits(folder / names[-1], frame, date_obs(start), pixel_um)
            samples = max(1, round(exposure_s * TILT_RATE_HZ))
            for j in range(samples):
                moment = start + (j + 0.5) * exposure_s / samples
                tilts.append((moment, *np.degrees(read_tilt(now, rng)), 15.0))
            truth.append({"start_utc": date_obs(start), "mid_unix_s": start + exposure_s / 2,
                          "heading_deg": float(np.degrees(now.heading)), "stars": len(stars.electrons)})  # fmt: skip
            progress("frames", (k + 1) / frames)
        rows = "".join("{:.6f},{:.7f},{:.7f},{:.2f}\n".format(*row) for row in tilts)
        (folder / TILTS).write_text("utc_unix_s,theta_x_deg,theta_y_deg,temperature_c\n" + rows, "utf-8")
        place = {"latitude_deg": scene.site.latitude_deg, "longitude_deg": scene.site.longitude_deg}
        made = {SIMULATED: {name: _digest(folder / name) for name in (*names, TILTS)}}
        (folder / TRUTH).write_text(json.dumps(place | {"frames": truth} | made, indent=1), "utf-8")
    except OSError as e:
        raise FrameError(f"{folder}: the night cannot be written there ({e.strerror})") from None


def _made(folder: Path) -> dict:
    """The files that were simulated, each with its digest; none without a record.  Raises OSError."""
    try:
        said = json.loads(read_regular(folder / TRUTH, MAX_BYTES))
        return {Path(name).name: digest for name, digest in said[SIMULATED].items()}
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, FileNotFoundError):
        return {}


def _take_away_simulated(folder: Path) -> None:
    """Remove the simulated night that a folder holds; FrameError for other or changed files.

    Raises OSError.
    """
    made = _made(folder)
    there = {p.name for p in folder.iterdir() if p.suffix.lower() in (*FITS, ".csv") or p.name == TRUTH}
    strange = [name for name in there - {TRUTH} if made.get(name) != _digest(folder / name)]
    if not made and TRUTH in there:
        strange.append(TRUTH)
    if strange:
        raise FrameError(
            f"{folder / min(strange)}: it is there already, and starpos simulate did not write it in this "
            f"form: "
            "give another folder, or move it away"
        )
    for name in there:
        (folder / name).unlink()


def _digest(path: Path) -> str:
    return hashlib.sha256(read_regular(path, MAX_BYTES)).hexdigest()


def write_fits(path: Path | str, frame: Frame, start_utc: str, pixel_um: float = 1.0) -> None:
    """Write a frame as FITS with DATE-OBS (start of exposure, UTC), EXPTIME and, if known, focal length and shutter."""
    from astropy.io import fits

    header = fits.Header()
    header["DATE-OBS"] = (start_utc, "start of exposure, UTC")
    header["EXPTIME"] = (frame.exposure_s, "s")
    header["ORIGIN"] = ("starpos simulate", "no camera took this frame")
    if frame.focal_px is not None:
        header["FOCALLEN"] = (focal_mm(frame.focal_px, pixel_um), "mm")
        header["XPIXSZ"] = (pixel_um, "um")
    if frame.shutter is not None:
        header["ROLLSHUT"] = (frame.shutter.readout_s, "s from the row read first to the last")
    fits.PrimaryHDU(frame.pixels, header).writeto(path, overwrite=True)
