# SPDX-License-Identifier: Apache-2.0
"""Size and CPU time of a simulated full frame in a bag (zstd), against Rice's coding and PNG, all lossless."""

import io
import time

import cv2
import numpy as np
from astropy.io import fits
from rosbags.rosbag2.storage_mcap import zstd

from starpos.simulation.scene import expose, render, scene_of
from starpos.sky.catalogue import load_catalogue


def rice(pixels) -> bytes:
    out = io.BytesIO()
    fits.CompImageHDU(pixels, compression_type="RICE_1").writeto(out)
    return out.getvalue()


def png(pixels) -> bytes:
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def main() -> None:
    rng, start = np.random.default_rng(1), 1793642400.0
    scene = scene_of()
    pixels = render(scene, expose(scene, load_catalogue(), start, 0.5, rng), start, 0.5, rng).pixels
    noise = 1.4826 / np.sqrt(2) * np.median(np.abs(np.diff(pixels.astype(int), axis=1)))
    bits = 8 * pixels.itemsize
    least = np.log2(noise * np.sqrt(2 * np.pi * np.e)) / bits
    print(
        f"{pixels.shape[1]} x {pixels.shape[0]} px of {bits} bits; noise of {noise:.1f} DN leaves {least:.2f}\n"
    )
    print("| | of the size | CPU s |\n| --- | --- | --- |")
    for name, code in {
        "zstd, as in a bag": lambda p: zstd.compress(p.tobytes()),
        "Rice": rice,
        "PNG": png,
    }.items():
        begin = time.process_time()
        size = len(code(pixels))
        print(f"| {name} | {size / pixels.nbytes:.2f} | {time.process_time() - begin:.2f} |")


if __name__ == "__main__":
    main()
