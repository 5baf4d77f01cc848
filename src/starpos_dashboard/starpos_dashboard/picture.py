# SPDX-License-Identifier: Apache-2.0
"""Conversion of the annotated frame to a JPEG."""

import cv2
import numpy as np
from sensor_msgs.msg import Image

from starpos.errors import FrameError
from starpos.messages.camera import message_to_frame

ENCODINGS = ("bgr8", "mono8")
LARGEST_PX = 1 << 26
QUALITY = 82


def jpeg(message: Image, side: int) -> bytes:
    """Convert a picture to a JPEG of at most `side` px; FrameError if it is not a consistent picture of 8 bits."""
    if message.encoding not in ENCODINGS:
        raise FrameError(
            f"the frame's encoding is {message.encoding[:32]!r}: only {', '.join(ENCODINGS)} are shown"
        )
    if message.width * message.height > LARGEST_PX:
        raise FrameError(f"the frame has {message.width} x {message.height} px: it is too large to be shown")
    pixels = message_to_frame(message, "the frame").pixels
    height, width = pixels.shape[:2]
    scale = side / max(height, width)
    if scale < 1:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = cv2.resize(np.ascontiguousarray(pixels), size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise FrameError(f"the frame of {width} x {height} px cannot be made a JPEG")
    return data.tobytes()
