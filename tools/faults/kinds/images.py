# SPDX-License-Identifier: Apache-2.0
"""Images that are broken or of no sky, through the detector."""

import numpy as np
from accelerated import World

from kinds.registry import HOSTILE, kind
from starpos_common.messages import unix_to_stamp


@kind(0.8)
def images_broken(w: World):
    """Truncated, empty, of a wrong step, of an unknown encoding, without a stamp."""
    shot, image, capture = w.photograph()
    changes = (
        lambda: setattr(image, "data", image.data[: int(w.rng.integers(len(image.data)))]),
        lambda: setattr(image, "step", int(w.rng.integers(10))),
        lambda: setattr(image, "step", 4294967295),
        lambda: setattr(image, "encoding", str(w.rng.choice(["", "yuv422", "32FC1", "x" * 1000]))),
        lambda: setattr(image, "width", 4294967295),
        lambda: setattr(image, "height", 0),
        lambda: setattr(image.header, "stamp", unix_to_stamp(None)),
    )
    changes[w.rng.integers(len(changes))]()
    w.send_image(shot, image, capture)


@kind(0.8)
def images_of_another_size_or_encoding(w: World):
    """Cropped, or its bytes taken for another encoding, another byte order."""
    shot, image, capture = w.photograph()
    choice = w.rng.integers(3)
    if choice == 0:
        image.height -= int(w.rng.integers(1, 600))
        image.data = image.data[: image.height * image.step]
    elif choice == 1:
        image.encoding = str(w.rng.choice(["mono8", "bayer_rggb8", "bayer_gbrg16", "bayer_bggr16"]))
    else:
        image.is_bigendian = 1
    w.send_image(shot, image, capture)


@kind(0.8)
def images_of_nothing_or_noise(w: World):
    """Black, white, noise, or the frame upside down."""
    shot, image, capture = w.photograph()
    pixels = np.frombuffer(image.data, np.uint16).reshape(image.height, image.width).copy()
    choice = w.rng.integers(4)
    if choice == 3:
        pixels = pixels[::-1]
    else:
        pixels[:] = (0, 65535, w.rng.integers(0, 65536, pixels.shape))[choice]
    image.data = type(image.data)("B", pixels.tobytes())
    w.send_image(shot, image, capture)


@kind(0.8)
def images_with_hits_and_lines(w: World):
    """Hot pixels, cosmic hits, a bright line, a blooming column."""
    shot, image, capture = w.photograph()
    pixels = np.frombuffer(image.data, np.uint16).reshape(image.height, image.width).copy()
    for _ in range(w.rng.integers(1, 400)):
        y, x = w.rng.integers(image.height - 4), w.rng.integers(image.width - 4)
        pixels[y : y + w.rng.integers(1, 4), x : x + w.rng.integers(1, 4)] = w.rng.integers(2000, 65536)
    pixels[w.rng.integers(image.height)] = 16383
    pixels[:, w.rng.integers(image.width)] = 16383
    image.data = type(image.data)("B", pixels.tobytes())
    w.send_image(shot, image, capture)


@kind(0.5)
def images_doubled_or_out_of_order(w: World):
    """An image twice; two images the other way round."""
    made = [w.photograph() for _ in range(2)]
    w.tick()
    for shot, _, _ in made:
        w.tilts(shot)
    for shot, image, capture in (made[1], made[0], made[0]):
        w.send_image(shot, image, capture)
        w.spin(0.05)


@kind(0.5)
def captures_missing_or_broken(w: World):
    """No camera/capture for an image, or one of hostile numbers."""
    shot, image, capture = w.photograph()
    if w.rng.random() < 0.5:
        capture.header.stamp = unix_to_stamp(1.0)
    capture.exposure, capture.stamp_stddev, capture.clock_stddev = (
        float(v) for v in w.rng.choice(HOSTILE, 3)
    )
    w.send_image(shot, image, capture)
