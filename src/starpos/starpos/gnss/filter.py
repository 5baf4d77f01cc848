# SPDX-License-Identifier: Apache-2.0
"""A Kalman filter over what GNSS teaches: the equations of a frame, the start while A3 is hardly known, and advice."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, place_of_zenith
from starpos.earth.place import Place
from starpos.earth.vertical import Vertical
from starpos.fix.fix import Fix
from starpos.fix.terms import Origin
from starpos.gnss.receiver import gnss_place
from starpos.gnss.states import Learned, aged, prior
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC

# Origin of the terms of a fix that the states replace.
LEARNED_ORIGINS = (Origin.A3, Origin.INCLINOMETER)


def zenith_of_stars(sighting: Fix, learned: Learned) -> np.ndarray:
    """Up (3,) in ITRS by the plumb line, as camera and inclinometer have it with what was learned."""
    up_in_camera = learned.rotation.T @ learned.up(sighting.tilt)
    return sighting.camera.rotation @ up_in_camera


def zenith_rows(sighting: Fix, learned: Learned, up: np.ndarray) -> np.ndarray:
    """Derivatives (3, n) of `zenith_of_stars` by the states; up (3,): in S."""
    rows = learned.tilted(sighting.tilt)
    rows[:, learned.layout.a3] = rotation.cross_matrix(up)
    return sighting.camera.rotation @ learned.rotation.T @ rows


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a frame with a GNSS place says of the states: value (2,) = rows (2, n) @ (true - state) + noise (2, 2).

    An error of the GNSS place, east and north as an angle at the Earth's centre, makes `value` smaller by as much.
    """

    value: np.ndarray
    rows: np.ndarray
    noise: np.ndarray


def innovation(
    sighting: Fix, gnss: Place, learned: Learned, vertical: Vertical, up_in_camera: np.ndarray | None = None
) -> Innovation:
    """Compare the plumb line that GNSS and the deflection expect with the one by the stars and the tilt.

    up_in_camera (3,): about which the comparison is linear; None: as GNSS has it at this frame.
    """
    at, axes = learned.layout, gnss.axes
    east_north = learned.state[at.gnss]
    deflection = learned.deflection_rad(vertical, gnss.latitude, gnss.longitude)
    expected = rotation.normalised(axes[2] + (deflection - east_north) @ axes[:2])
    # along two directions at the place
    seen = axes[:2] @ (zenith_of_stars(sighting, learned) - expected)
    # the stars' plumb line has no noise of the tilts, by which an unknown turn of A3 would seem to be determined
    up = learned.rotation @ (sighting.camera.rotation.T @ expected if up_in_camera is None else up_in_camera)
    rows = -axes[:2] @ zenith_rows(sighting, learned, up)
    rows[:, at.constant] += np.eye(2)
    rows[:, at.field] += np.eye(2)
    rows[:, at.gnss] -= np.eye(2)
    radii = np.array(curvature_radii_m(gnss.latitude))
    noise = axes[:2] @ zenith_noise(sighting, learned) @ axes[:2].T
    return Innovation(seen, rows, noise + gnss.covariance / np.outer(radii, radii))


def zenith_noise(sighting: Fix, learned: Learned) -> np.ndarray:
    """Covariance (3, 3) of the zenith in ITRS by the stars and the noise of the readings."""
    back = sighting.camera.rotation @ learned.rotation.T @ sighting.tilt.slope
    return sighting.zenith_by_stars + back @ sighting.tilt.noise @ back.T


def place_of_stars(sighting: Fix, learned: Learned, vertical: Vertical) -> Place:
    """The place by the stars alone, on the ellipsoid."""
    zenith = zenith_of_stars(sighting, learned)
    latitude, longitude = place_of_zenith(zenith)
    axes = enu_axes(latitude, longitude)
    east_north = learned.deflection_rad(vertical, latitude, longitude)
    rows = axes[:2] @ zenith_rows(sighting, learned, learned.up(sighting.tilt))
    at = learned.layout
    rows[:, at.constant] -= np.eye(2)
    rows[:, at.field] -= np.eye(2)
    noise = axes[:2] @ zenith_noise(sighting, learned) @ axes[:2].T
    covariance = rows @ learned.covariance @ rows.T + noise
    radii = np.array(curvature_radii_m(latitude))
    latitude, longitude = place_of_zenith(rotation.normalised(axes[2] - east_north @ axes[:2]))
    return gnss_place(sighting.utc_unix_s, latitude, longitude, covariance * np.outer(radii, radii))


# An A3 known so well, across the plumb line and about it, is linear: the squares of what is left are below 0.5 arcsec.
LINEAR_ACROSS_RAD, LINEAR_TURN_RAD = 120 * ARCSEC, 900 * ARCSEC
# Maximum number of times that the start is repeated about its own answer, and its convergence.
ROUNDS, SETTLED_RAD = 6, 1e-6


def corrected(
    state: np.ndarray, covariance: np.ndarray, rows: np.ndarray, noise: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States (..., n) and covariances (..., n, n) of filters after a measurement, by rows, noise and value of it."""
    across = covariance @ rows.swapaxes(-1, -2)
    gain = np.linalg.solve(rows @ across + noise, across.swapaxes(-1, -2)).swapaxes(-1, -2)
    # Joseph's form stays symmetric and positive
    kept = np.eye(state.shape[-1]) - gain @ rows
    covariance = kept @ covariance @ kept.swapaxes(-1, -2) + gain @ noise @ gain.swapaxes(-1, -2)
    return state + (gain @ value[..., None])[..., 0], (covariance + covariance.swapaxes(-1, -2)) / 2


def updated(learned: Learned, seen: Innovation) -> Learned:
    """What is known after a frame with a GNSS place."""
    state, covariance = corrected(learned.state, learned.covariance, seen.rows, seen.noise, seen.value)
    return replace(learned, state=state, covariance=covariance, frames=learned.frames + 1)


def chi2(learned: Learned, seen: Innovation) -> float:
    """Squared distance in sigma between the GNSS place and the star fix: chi-square, two degrees of freedom."""
    spread = seen.rows @ learned.covariance @ seen.rows.T + seen.noise
    return float(seen.value @ np.linalg.solve(spread, seen.value))


def is_linear(learned: Learned, tilt: Tilt) -> bool:
    """Whether A3 is known well enough for a linear filter."""
    covariance, up = learned.covariance[learned.layout.a3, learned.layout.a3], tilt.up
    turn = float(up @ covariance @ up)
    return turn < LINEAR_TURN_RAD**2 and float(np.trace(covariance)) - turn < 2 * LINEAR_ACROSS_RAD**2


@dataclass(frozen=True, eq=False)
class GnssFrame:
    """A frame with a GNSS place; new_pose: whether the camera was touched before it.

    up_in_camera (3,): up in C by GNSS at the first frame of the pose.
    """

    sighting: Fix
    gnss: Place
    new_pose: bool
    up_in_camera: np.ndarray


def begun(instrument: Instrument, frames: Sequence[GnssFrame], vertical: Vertical) -> Learned:
    """What frames teach of an instrument whose A3 may be anything: repeated about its own answer until that settles."""
    first = frames[0]
    stddev = stddev_rad(vertical, first.gnss.latitude, first.gnss.longitude)
    start = prior(instrument, first.sighting.tilt, stddev, first.sighting.utc_unix_s)
    stated, a3 = start.a3, start.a3
    if instrument.calibration.unknown:
        in_camera = np.array([frame.sighting.camera.rotation.T @ frame.gnss.zenith for frame in frames])
        in_sensor = np.array([frame.sighting.tilt.up for frame in frames])
        stated = a3 = rotation.best_rotation(in_camera, in_sensor)
    at = start.layout
    for _ in range(ROUNDS):
        state = start.state.copy()
        state[at.a3] = rotation.to_vector(stated @ a3.T)
        learned = replace(
            start, a3=a3, state=state, place=(first.gnss.latitude, first.gnss.longitude),
            since_unix_s=first.sighting.utc_unix_s, poses=0,
        )  # fmt: skip
        for frame in frames:
            learned = taught(learned, frame, instrument, vertical)
        a3 = learned.rotation
        if instrument.calibration.unknown:
            stated = a3
        if np.linalg.norm(learned.state[at.a3]) < SETTLED_RAD:
            break
    return learned


def taught(learned: Learned, frame: GnssFrame, instrument: Instrument, vertical: Vertical) -> Learned:
    """The state after a frame that comes later than all before."""
    gnss, sighting = frame.gnss, frame.sighting
    assert learned.place is not None
    moved_m = float(np.linalg.norm(gnss.offset_m(*learned.place))) if frame.new_pose else 0.0
    here = gnss.latitude, gnss.longitude
    learned, _ = aged(learned, instrument, vertical, sighting, here, moved_m, frame.new_pose)
    if frame.new_pose:
        learned = replace(learned, place=here, poses=learned.poses + 1)
    # about A3 as it was taken: its turn by a few frames would mislead
    about = np.zeros(learned.layout.size)
    # one up for all frames of a pose: GNSS's noise, as large as a good inclinometer's, would seem to lean the camera
    # and so to determine A3's turn about the plumb line
    seen = innovation(sighting, gnss, replace(learned, state=about), vertical, frame.up_in_camera)
    return updated(learned, replace(seen, value=seen.value - seen.rows @ learned.state))


def stddev_rad(vertical: Vertical, latitude: float, longitude: float) -> float:
    """1 sigma of each component of what a Vertical does not know of the deflection."""
    return vertical.at(latitude, longitude).stddev_arcsec * ARCSEC


# Correlation of A3 and the deflection above which they are not separated.
ALIKE = 0.8
# Fewer poses average the inclinometer's errors badly.
FEW_POSES = 6


def what_would_tell_more(learned: Learned) -> str:
    """Say in a sentence what would teach most; '' if nothing stands out."""
    at, covariance = learned.layout, learned.covariance
    _, turn = learned.a3_stddev_rad
    if turn > LINEAR_TURN_RAD:
        return f"lean it otherwise at each pose: A3's turn about the plumb line is known to {np.degrees(turn):.2g} deg"
    if _correlation(covariance, at.a3, at.constant) > ALIKE:
        return "turn it to other headings: at one heading A3 cannot be separated from the deflection"
    if learned.poses < FEW_POSES:
        return "let it stand at more poses, newly turned"
    return ""


def _correlation(covariance: np.ndarray, a: slice, b: slice) -> float:
    """Largest correlation of any combination of some states with any of others; 0 where one of them is known."""
    of_a, of_b = covariance[a, a], covariance[b, b]
    if min(np.linalg.eigvalsh(of_a)[0], np.linalg.eigvalsh(of_b)[0]) <= 0:
        return 0.0
    root_a, root_b = np.linalg.cholesky(of_a), np.linalg.cholesky(of_b)
    whitened = np.linalg.solve(root_a, np.linalg.solve(root_b, covariance[b, a]).T)
    return float(np.linalg.svd(whitened, compute_uv=False)[0])
