# SPDX-License-Identifier: Apache-2.0
"""Stars and their shutter from a StarArray, trails from a TrailArray, a camera's attitude from an Attitude."""

from dataclasses import replace
from typing import Any

import numpy as np

from starpos import rotation
from starpos.errors import FrameError
from starpos.fix.attitude import UNKNOWN_TURN, CameraAttitude
from starpos.frames.exposure import Shutter
from starpos.frames.frame import DISC, SATURATED, Disc, FrameTrail, Stars
from starpos.messages.stamp import stamp_to_unix

# a detector publishes no more
MAX_STARS = 100_000


def message_to_stars(message: Any, source: str = "stars") -> Stars:
    """Stars from a StarArray; raises FrameError if sizes, values, order or covariances cannot be right."""
    if len(message.stars) > MAX_STARS:
        raise FrameError(
            f"{source}: {len(message.stars)} stars are more than {MAX_STARS}: send the brightest."
        )
    rows = [s for s in message.stars if not s.flags & DISC]
    disc = None
    for s in reversed([s for s in message.stars if s.flags & DISC][:DISCS]):
        disc = replace(_message_to_disc(s, source), other=disc)
    return Stars(
        x=np.array([s.x for s in rows]),
        y=np.array([s.y for s in rows]),
        flux=np.array([s.flux for s in rows]),
        snr=np.array([s.snr for s in rows]),
        covariance=np.array([s.covariance for s in rows], float).reshape(-1, 2, 2),
        flags=np.array([s.flags for s in rows], np.uint8),
        width=message.width,
        height=message.height,
        mid_unix_s=stamp_to_unix(message.header.stamp),
        exposure_s=message.exposure or None,
        source=source,
        stamp_stddev_s=message.stamp_stddev,
        # older bags do not have it
        clock_stddev_s=getattr(message, "clock_stddev", 0.0),
        shutter=message_to_shutter(message),
        disc=disc,
    )


def _message_to_disc(star: Any, source: str) -> Disc:
    """The disc that a star with the flag DISC stands for; FrameError if a value is impossible."""
    covariance = np.array(star.covariance, float).reshape(2, 2)
    if not (_is_possible(covariance, star.x, star.y, star.flux) and star.flux > 0):
        raise FrameError(f"{source}: the disc's place, area or covariance is impossible: measure it again.")
    return Disc(
        x=star.x,
        y=star.y,
        covariance=covariance,
        radius_px=float(np.sqrt(star.flux / np.pi)),
        sharp=not star.flags & SATURATED,
    )


def _is_possible(covariance: np.ndarray, *values: float) -> bool:
    """Whether values are finite, and a matrix is a covariance."""
    return bool(
        np.isfinite([*values, *covariance.flat]).all()
        and np.allclose(covariance, covariance.T)
        and np.linalg.eigvalsh(covariance)[0] > 0
    )


def message_to_shutter(message: Any) -> Shutter | None:
    """Shutter stated in a StarArray or a Capture, None if unknown; FrameError if impossible."""
    # older bags do not have it
    if not getattr(message, "shutter_known", False):
        return None
    return Shutter(message.readout, message.readout_stddev)


MAX_TRAILS = 1000
# flags of a Trail
FIRST_CUT, SECOND_CUT, UNSTEADY = 1, 2, 4


def message_to_trails(message: Any) -> list[FrameTrail]:
    """Trails from a TrailArray; raises FrameError if ends or covariances cannot be right."""
    if len(message.trails) > MAX_TRAILS:
        raise FrameError(
            f"trails: {len(message.trails)} trails are more than {MAX_TRAILS}: send the brightest."
        )
    trails = []
    for t in message.trails:
        ends, covariance = np.array(t.ends, float), np.array(t.covariance, float).reshape(4, 4)
        if not (_is_possible(covariance, *ends, t.snr) and (ends[:2] != ends[2:]).any()):
            raise FrameError("trails: ends, covariance or SNR of a trail are impossible: measure it again.")
        trails.append(
            FrameTrail(
                ends=ends.reshape(2, 2),
                covariance=covariance,
                snr=float(t.snr),
                cut=np.array([bool(t.flags & FIRST_CUT), bool(t.flags & SECOND_CUT)]),
                steady=not t.flags & UNSTEADY,
            )
        )
    return trails


# Of the discs of a frame two count.
DISCS = 2
# of an attitude's quaternion, and the most that its covariance may say, rad2, but about the Sun seen alone
OFF_UNIT, MAX_ATTITUDE_VARIANCE = 1e-3, 0.01


def message_to_attitude(message: Any, source: str = "attitude") -> CameraAttitude:
    """Attitude of a camera from a message; raises FrameError unless stamp, quaternion and covariance can be right."""
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise FrameError(
            f"{source}: the message has no time stamp: set header.stamp to the middle of the exposure."
        )
    q = message.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w])
    if not abs(np.linalg.norm(quaternion) - 1) < OFF_UNIT:
        raise FrameError(
            f"{source}: the quaternion {quaternion.tolist()} is not of length 1: send a rotation."
        )
    covariance = np.array(message.covariance, float).reshape(3, 3)
    errors = message.stamp_stddev, message.clock_stddev
    if not np.isfinite([*covariance.flat, *errors]).all() or min(errors) < 0:
        raise FrameError(
            f"{source}: the covariance or an error of its time is not a finite number of at least 0."
        )
    variances = np.linalg.eigvalsh(covariance)
    known = variances[:2] if variances[2] > UNKNOWN_TURN else variances
    if not (
        np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-9 * variances[2])
        and variances[0] > 0
        and known.sum() < MAX_ATTITUDE_VARIANCE
    ):
        raise FrameError(f"{source}: the covariance is not symmetric, positive and below 0.01 rad2.")
    return CameraAttitude(
        utc_unix_s=unix_s,
        stamp_stddev_s=message.stamp_stddev,
        clock_stddev_s=message.clock_stddev,
        frame_id=message.header.frame_id,
        camera_to_gcrs=rotation.from_quaternion(quaternion),
        covariance=covariance,
        stars=message.stars_matched,
        log_odds=message.log_odds,
    )
