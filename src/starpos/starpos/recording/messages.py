# SPDX-License-Identifier: Apache-2.0
"""Converts messages into this package's types: those of rclpy in a node, and those of `rosbags` from a bag.

A message that cannot be right raises the error of its type, in one sentence.
"""

import math
from typing import Any

import numpy as np

from starpos import rotation
from starpos.errors import FrameError, InstrumentError, TiltError
from starpos.fix.camera_attitude import CameraAttitude
from starpos.frames.encodings import pixels_of
from starpos.frames.frame import Frame
from starpos.frames.pictures import picture_pixels
from starpos.frames.shutter import Shutter
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import MOST_CELSIUS, SCA100T_NOISE_RAD, SQUARE, Tilt
from starpos.instrument.lens import stated_lens

# bits of Tilt.flags, as starpos_interfaces defines them
OUT_OF_RANGE, STUCK, SATURATED, TIME_UNKNOWN = 1, 2, 4, 16
UNUSABLE = OUT_OF_RANGE | STUCK | SATURATED | TIME_UNKNOWN
# rad2; a larger variance says nothing, and might overflow
MOST_TILT_VARIANCE = 1.0
# of an attitude's quaternion, and the most that its covariance may say, rad2
OFF_UNIT, MOST_ATTITUDE_VARIANCE = 1e-3, 0.01
# a detector publishes no more
MAX_STARS = 100_000


def stamp_to_unix(stamp: Any) -> float | None:
    """Unix seconds of a stamp, to the microsecond; None for 0, which means that the time is unknown."""
    if stamp.sec == 0 and stamp.nanosec == 0:
        return None
    return stamp.sec + stamp.nanosec * 1e-9


def message_to_stars(message: Any, source: str = "stars") -> Stars:
    """Stars from a StarArray; raises FrameError if sizes, values, order or covariances cannot be right."""
    rows = message.stars
    if len(rows) > MAX_STARS:
        raise FrameError(f"{source}: {len(rows)} stars are more than {MAX_STARS}: send the brightest.")
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
    )


def message_to_shutter(message: Any) -> Shutter | None:
    """Shutter that a StarArray or a Capture tells, None if it is not known; FrameError if it cannot be."""
    # older bags do not have it
    if not getattr(message, "shutter_known", False):
        return None
    return Shutter(message.readout, message.readout_stddev)


def message_to_tilt(message: Any, unknown_stddev_rad: float = SCA100T_NOISE_RAD) -> Tilt:
    """Tilt from a message; an unknown covariance (all zeros) becomes unknown_stddev_rad on both axes.

    A tilt has two axes where the third is NaN, not filled in, or not there, as in the first release's messages.
    An impossible temperature becomes NaN, unknown.  The flags are left to the caller.  Raises TiltError for NaN, no
    stamp, angles that cannot hold together, or an impossible covariance.
    """
    covariance = np.array(message.covariance, float).reshape(2, 2)
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise TiltError("a tilt message has no time stamp: set header.stamp to the time of the sample.")
    if not covariance.any():
        covariance = np.eye(2) * unknown_stddev_rad**2
    elif np.isfinite(covariance).all():
        (xx, xy), (yx, yy) = covariance
        if not (xx > 0 and yy > 0 and math.isclose(xy, yx, abs_tol=1e-9 * xx) and xx * yy > xy * yx):
            raise TiltError(
                "a tilt message's covariance is not symmetric and positive: send zeros where it is unknown."
            )
        if max(xx, yy) > MOST_TILT_VARIANCE:
            raise TiltError("a tilt message's covariance is beyond 1 rad2: send zeros where it is unknown.")
    celsius = message.temperature if abs(message.temperature) <= MOST_CELSIUS else math.nan
    z, z_variance = _third_axis(message)
    return Tilt(
        message.x,
        message.y,
        covariance,
        utc_unix_s=unix_s,
        temperature_c=celsius,
        theta_z=z,
        variance_z=z_variance,
    )


def _third_axis(message: Any) -> tuple[float, float]:
    """Elevation in rad and variance in rad2 of the third axis, NaN where they are not known; TiltError if they cannot be.

    A publisher that knows of two axes only may leave both at 0. Where x and y leave room for no third axis but a level
    one, 0 may as well be what it reads; such a tilt is refused, because the two differ by degrees.
    """
    z, variance = getattr(message, "z", math.nan), getattr(message, "z_variance", math.nan)
    if math.isnan(z):
        return math.nan, math.nan
    if z == variance == 0:
        if math.sin(message.x) ** 2 + math.sin(message.y) ** 2 > 1 - SQUARE:
            raise TiltError(
                "a tilt message leaves z and z_variance at 0, and its x and y alone are those of a sensor on its side: "
                "send z and its variance, or NaN for a sensor of two axes."
            )
        return math.nan, math.nan
    if not math.isfinite(z):
        raise TiltError("a tilt message's z is not a finite number: send NaN for a sensor of two axes.")
    if variance < 0 or variance > MOST_TILT_VARIANCE:
        raise TiltError(
            "a tilt message's z_variance is not from 0 to 1 rad2: send NaN or 0 where it is unknown."
        )
    return z, variance or math.nan


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
    if not (
        np.allclose(covariance, covariance.T, rtol=1e-6, atol=0)
        and np.linalg.eigvalsh(covariance)[0] > 0
        and covariance.trace() < MOST_ATTITUDE_VARIANCE
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


def message_to_camera(
    message: Any, source: str = "camera_info", size: tuple[int, int] | None = None
) -> Camera:
    """Camera of the images that a CameraInfo goes with; raises InstrumentError unless it is calibrated.

    Its model is plumb_bob, also where none is named, rational_polynomial or equidistant. K is that of the whole sensor;
    the camera's is that of the region and the binning that the message states.
    size: width and height of the images, px, for a message that leaves its own at 0.
    """
    k = np.array(message.k, float)
    d = np.array(message.d, float)
    if not np.isfinite(k).all() or not np.isfinite(d).all():
        raise InstrumentError(f"{source}: K or D holds NaN or infinity; calibrate the camera.")
    if not k[0] or not k[4]:
        raise InstrumentError(
            f"{source}: the camera is not calibrated (its focal length is 0); give it a calibration file."
        )
    model, distortion = stated_lens(message.distortion_model, d.tolist(), source)
    if np.any(k[[1, 3, 6, 7]]) or k[8] != 1:
        raise InstrumentError(
            f"{source}: K is not [fx 0 cx, 0 fy cy, 0 0 1]; calibrate the camera without skew."
        )
    region, by_x, by_y = message.roi, max(1, message.binning_x), max(1, message.binning_y)
    width = _image_side(message.width, region.x_offset, region.width, by_x, source)
    height = _image_side(message.height, region.y_offset, region.height, by_y, source)
    if size is not None and leaves_size_open(message):
        width, height = size
    fx, fy, cx, cy = k[[0, 4, 2, 5]].tolist()
    return Camera(
        width=width,
        height=height,
        fx=fx / by_x,
        fy=fy / by_y,
        # the corner of the first pixel, half a pixel from its centre, is the same before and after binning
        cx=(cx - region.x_offset + 0.5) / by_x - 0.5,
        cy=(cy - region.y_offset + 0.5) / by_y - 0.5,
        distortion=distortion,
        model=model,
    )


def leaves_size_open(message: Any) -> bool:
    """Whether a CameraInfo states no size, which is then that of the images."""
    region = message.roi
    return not (message.width or region.width) or not (message.height or region.height)


def _image_side(whole: int, offset: int, cut: int, binned_by: int, source: str) -> int:
    """Pixels along a side of the images: the binned ones of the sensor, or of a part `cut` of it; 0 if not stated."""
    if whole and offset + cut > whole:
        raise InstrumentError(
            f"{source}: the region of interest ends at pixel {offset + cut} of {whole}; width and height are those of "
            "the whole sensor: correct the camera's driver or its calibration file."
        )
    return (cut or max(0, whole - offset)) // binned_by


def message_to_frame(message: Any, source: str = "image_raw") -> Frame:
    """Frame from an Image, on the message's own memory where that holds pixels as a Frame does, else on a copy.

    Raises FrameError if encoding, size, step and data do not fit together.
    """
    pixels, pattern = pixels_of(
        message.encoding,
        message.data,
        message.width,
        message.height,
        message.step,
        bool(message.is_bigendian),
        source,
    )
    return Frame(pixels, pattern=pattern, mid_unix_s=stamp_to_unix(message.header.stamp), source=source)


def message_to_picture(message: Any, source: str = "image_raw/compressed") -> Frame:
    """Frame from a CompressedImage: JPEG, PNG or TIFF; raises FrameError if it is not a whole picture."""
    pixels = picture_pixels(bytes(message.data), source)
    return Frame(pixels, mid_unix_s=stamp_to_unix(message.header.stamp), source=source)
