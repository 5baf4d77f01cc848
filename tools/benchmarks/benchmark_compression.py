# SPDX-License-Identifier: Apache-2.0
"""Size and CPU time of a simulated full frame in a bag (zstd), against Rice's coding and PNG, all lossless."""

import io
import time
from collections.abc import Iterator

import cv2
import numpy as np
from astropy.io import fits
from rosbags.rosbag2.storage_mcap import zstd
from table import Cost, Row

from starpos.simulation.scene import expose, render, scene_of
from starpos.sky.catalogue import load_catalogue


def rice(pixels) -> bytes:
    out = io.BytesIO()
    fits.CompImageHDU(pixels, compression_type="RICE_1").writeto(out)
    return out.getvalue()


def png(pixels) -> bytes:
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def bag(pixels) -> bytes:
    return zstd.compress(pixels.tobytes())


CODES = {"zstd, as in a bag": bag, "Rice": rice, "PNG": png}


def full_frame() -> np.ndarray:
    """Draw a frame of the paper's camera."""
    rng, start = np.random.default_rng(1), 1793642400.0
    scene = scene_of()
    return render(scene, expose(scene, load_catalogue(), start, 0.5, rng), start, 0.5, rng).pixels


def coded(pixels: np.ndarray) -> Iterator[tuple[str, float, float]]:
    """Each code with its share of the size and its CPU time in s."""
    for name, code in CODES.items():
        begin = time.process_time()
        size = len(code(pixels))
        yield name, size / pixels.nbytes, time.process_time() - begin


def rows(options) -> Iterator[Row]:
    """The rows of bench.py."""
    costs = {name: Cost(1000 * s, f"{share:.2f} of the size") for name, share, s in coded(full_frame())}
    name, ours = next(iter(costs.items()))
    for peer in ("Rice", "PNG"):
        yield Row(f"a full frame packed, {name}", ours, peer, costs[peer])
