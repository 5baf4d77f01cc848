# SPDX-License-Identifier: Apache-2.0
"""A Kalman filter over what GNSS teaches, and its start while A3 is hardly known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.vertical import Vertical
from starpos.gnss.place import GnssPlace
from starpos.gnss.sighting import Innovation, LevelSight, innovation
from starpos.gnss.states import Learned, aged, ageing, prior
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC

# An A3 known so well, across the plumb line and about it, is linear: the squares of what is left are below 0.5 arcsec.
LINEAR_ACROSS_RAD, LINEAR_TURN_RAD = 120 * ARCSEC, 900 * ARCSEC
# Maximum number of times that the start is repeated about its own answer, and its convergence.
ROUNDS, SETTLED_RAD = 6, 1e-6


def updated(learned: Learned, seen: Innovation) -> Learned:
    """What is known after a frame with a GNSS place."""
    across = learned.covariance @ seen.rows.T
    gain = np.linalg.solve(seen.rows @ across + seen.noise, across.T).T
    # Joseph's form stays symmetric and positive
    kept = np.eye(len(learned.state)) - gain @ seen.rows
    covariance = kept @ learned.covariance @ kept.T + gain @ seen.noise @ gain.T
    return replace(
        learned,
        state=learned.state + gain @ seen.value,
        covariance=(covariance + covariance.T) / 2,
        frames=learned.frames + 1,
    )


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

    sighting: LevelSight
    gnss: GnssPlace
    new_pose: bool
    up_in_camera: np.ndarray


def begun(instrument: Instrument, frames: Sequence[GnssFrame], vertical: Vertical) -> Learned:
    """What frames teach of an instrument whose A3 may be anything: repeated about its own answer until that settles."""
    first = frames[0]
    stddev = stddev_rad(vertical, first.gnss.latitude, first.gnss.longitude)
    start = prior(instrument, first.sighting.tilt, stddev, first.sighting.utc_unix_s)
    stated, a3 = start.a3, start.a3
    if instrument.calibration.unknown:
        in_camera = np.array([frame.sighting.camera_to_itrs.T @ frame.gnss.zenith for frame in frames])
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
        turned = learned.rotation
        off = float(np.linalg.norm(learned.state[at.a3]))
        if instrument.calibration.unknown:
            stated = turned
        a3 = turned
        if off < SETTLED_RAD:
            break
    return learned


def taught(learned: Learned, frame: GnssFrame, instrument: Instrument, vertical: Vertical) -> Learned:
    """The state after a frame that comes later than all before."""
    gnss, sighting = frame.gnss, frame.sighting
    assert learned.place is not None
    moved_m = float(np.linalg.norm(gnss.from_place_m(*learned.place))) if frame.new_pose else 0.0
    stddev = stddev_rad(vertical, gnss.latitude, gnss.longitude)
    passed = ageing(
        learned, instrument.inclinometer, sighting.tilt, sighting.utc_unix_s, moved_m, stddev, frame.new_pose
    )
    learned = aged(learned, passed, sighting.utc_unix_s)
    if frame.new_pose:
        learned = replace(learned, place=(gnss.latitude, gnss.longitude), poses=learned.poses + 1)
    # about A3 as it was taken: its turn by a few frames would mislead
    about = np.zeros(learned.layout.size)
    # one up for all frames of a pose: GNSS's noise, as large as a good inclinometer's, would seem to lean the camera
    # and so to determine A3's turn about the plumb line
    seen = innovation(sighting, gnss, replace(learned, state=about), vertical, frame.up_in_camera)
    return updated(learned, replace(seen, value=seen.value - seen.rows @ learned.state))


def stddev_rad(vertical: Vertical, latitude: float, longitude: float) -> float:
    """1 sigma of each component of what a Vertical does not know of the deflection."""
    return vertical.at(latitude, longitude).stddev_arcsec * ARCSEC
