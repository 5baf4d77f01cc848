# SPDX-License-Identifier: Apache-2.0
"""Conversion of starpos' types to messages; `starpos.messages` converts back."""

import array
import math
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from starpos import rotation
from starpos.errors import TimeError
from starpos.fix.attitude import CameraAttitude
from starpos.frames.exposure import Shutter
from starpos.frames.frame import DISC, SATURATED, Disc, Frame, FrameTrail, Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.messages.stars import FIRST_CUT, SECOND_CUT, UNSTEADY
from starpos_interfaces import msg

# The end of Time.sec, in January 2038.
MAX_UNIX_S = 2**31 - 1e-6


def unix_to_stamp(unix_s: float | None) -> Time:
    """Convert a Unix time (s) to a stamp, rounded to the microsecond (a double holds no more); None gives 0.

    Raises TimeError outside 1970 .. 2038.
    """
    if unix_s is None:
        return Time()
    if not 0 <= unix_s <= MAX_UNIX_S:
        raise TimeError(f"{unix_s} s is not a Unix time between 1970 and 2038: check the clock it came from.")
    seconds, microseconds = divmod(round(unix_s * 1e6), 1_000_000)
    return Time(sec=seconds, nanosec=microseconds * 1000)


def stars_to_message(stars: Stars, frame_id: str) -> msg.StarArray:
    """Convert stars to a StarArray; what looks like the Sun, and the Moon, come last, as stars with the flag DISC."""
    covariance = stars.covariance.reshape(-1, 4)
    columns = zip(
        stars.x.tolist(),
        stars.y.tolist(),
        stars.flux.tolist(),
        stars.snr.tolist(),
        covariance,
        stars.flags.tolist(),
        strict=True,
    )
    return msg.StarArray(
        header=Header(stamp=unix_to_stamp(stars.mid_unix_s), frame_id=frame_id),
        width=int(stars.width),
        height=int(stars.height),
        exposure=float(stars.exposure_s or 0.0),
        stamp_stddev=float(stars.stamp_stddev_s),
        clock_stddev=float(stars.clock_stddev_s),
        stars=[
            *(msg.Star(x=x, y=y, flux=f, snr=s, covariance=c, flags=g) for x, y, f, s, c, g in columns),
            # so that the others are counted as in the frame's own list
            *(_disc_to_message(d) for d in (stars.disc, stars.disc and stars.disc.other) if d is not None),
        ],
        **shutter_fields(stars.shutter),
    )


def trails_to_message(trails: Iterable[FrameTrail], header: Header) -> msg.TrailArray:
    return msg.TrailArray(
        header=header,
        trails=[
            msg.Trail(
                ends=t.ends.ravel(),
                covariance=t.covariance.ravel(),
                snr=t.snr,
                flags=int(t.cut @ (FIRST_CUT, SECOND_CUT)) + (0 if t.steady else UNSTEADY),
            )
            for t in trails
        ],
    )


def _disc_to_message(disc: Disc) -> msg.Star:
    area = math.pi * disc.radius_px**2
    sigma = math.sqrt(float(np.trace(disc.covariance)) / 2)
    return msg.Star(
        x=float(disc.x),
        y=float(disc.y),
        flux=area,
        snr=disc.radius_px / sigma,
        covariance=disc.covariance.ravel(),
        flags=DISC if disc.sharp else DISC | SATURATED,
    )


def shutter_fields(shutter: Shutter | None) -> dict[str, Any]:
    """The fields of a StarArray or a Capture for a shutter; empty if it is not known."""
    if shutter is None:
        return {}
    return {
        "shutter_known": True,
        "readout": float(shutter.readout_s),
        "readout_stddev": float(shutter.readout_stddev_s),
    }


def tilt_to_message(tilt: Tilt, frame_id: str, sequence: int = 0, flags: int = 0) -> msg.Tilt:
    return msg.Tilt(
        header=Header(stamp=unix_to_stamp(tilt.utc_unix_s), frame_id=frame_id),
        x=float(tilt.theta_x),
        y=float(tilt.theta_y),
        covariance=tilt.covariance.ravel(),
        temperature=float(tilt.temperature_c),
        sequence=sequence,
        flags=flags,
        z=float(tilt.theta_z),
        z_variance=float(tilt.variance_z),
    )


def quaternion(turn: np.ndarray) -> Quaternion:
    """Convert a rotation (3, 3)."""
    return Quaternion(**dict(zip("xyzw", rotation.to_quaternion(turn).tolist(), strict=True)))


def attitude_to_message(attitude: CameraAttitude) -> msg.Attitude:
    return msg.Attitude(
        header=Header(stamp=unix_to_stamp(attitude.utc_unix_s), frame_id=attitude.frame_id),
        orientation=quaternion(attitude.camera_to_gcrs),
        covariance=attitude.covariance.ravel(),
        stars_matched=attitude.stars,
        log_odds=float(attitude.log_odds),
        stamp_stddev=float(attitude.stamp_stddev_s),
        clock_stddev=float(attitude.clock_stddev_s),
    )


def camera_to_message(camera: Camera, frame_id: str, unix_s: float | None = None) -> CameraInfo:
    """Convert a camera to a CameraInfo without rectification."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    model, distortion = camera.stated
    return CameraInfo(
        header=Header(stamp=unix_to_stamp(unix_s), frame_id=frame_id),
        width=int(camera.width),
        height=int(camera.height),
        distortion_model=model,
        d=[float(v) for v in distortion],
        k=[float(v) for v in (fx, 0, cx, 0, fy, cy, 0, 0, 1)],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[float(v) for v in (fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0)],
    )


def encoding_of(frame: Frame) -> str:
    """The name in sensor_msgs/Image for a frame's pixels, such as mono16 or bayer_rggb8."""
    layout = "bgr" if frame.pixels.ndim == 3 else f"bayer_{frame.pattern}" if frame.pattern else "mono"
    return f"{layout}{8 * frame.pixels.itemsize}"


def frame_to_message(frame: Frame, frame_id: str) -> Image:
    """Convert a frame to an Image; the pixels are copied once."""
    pixels = np.ascontiguousarray(frame.pixels)
    data = array.array("B")
    data.frombytes(pixels.data.cast("B"))
    message = Image(
        # a message that checks its fields takes an array of bytes as it is; one that does not copies it, its
        # constructor twice
        check_fields=True,
        header=Header(stamp=unix_to_stamp(frame.mid_unix_s), frame_id=frame_id),
        width=frame.width,
        height=frame.height,
        encoding=encoding_of(frame),
        is_bigendian=int(sys.byteorder == "big"),
        step=pixels.strides[0],
    )
    message.data = data
    return message
