# SPDX-License-Identifier: Apache-2.0
"""Sky and shutter for the CCD simulator of a running indiserver: each exposure shows the sky of a place at its middle.

    indi_sky.py PORT FOLDER EXPOSURE_S SEED PLACE LAG_S LAG_STDDEV_S       PLACE: instrument_run.Place as JSON

The simulator reads its frames from a folder when an exposure is commanded.  The folder has one file, and this process
holds a lease on it (fcntl(2), F_SETLEASE). When the simulator opens the file, the kernel notifies this process, and the
simulator waits until the lease is given back.  As in a single-lens reflex the shutter opens a lag after the command: the
contact of its hot shoe closes (`shutter`, with bounces, for the emulated board, on standard output), and the sky of that
moment is drawn.  The lease is given back when the exposure is over.  Only this process knows the place and the lag.
Prints `ready` on standard error, then the Unix time of each exposure's begin.
"""

import fcntl
import json
import mmap
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from instrument_run import Place

DEVICE = "CCD Simulator"
PIXEL_UM = 6.4
PATIENCE_S = 5.0
# The simulator may read the file once more for the same exposure.
AGAIN_S = 0.3
BOUNCES = 2
ENDS = {signal.SIGINT, signal.SIGTERM}


class Picture:
    """A 16-bit FITS file that is opened once and drawn into; call `lease` before anybody may read it."""

    def __init__(self, path: Path, width: int, height: int, pixel_um: float):
        from astropy.io import fits

        blank = fits.PrimaryHDU(np.zeros((height, width), np.uint16), fits.Header({"PIXSIZE1": pixel_um}))
        blank.writeto(path)
        with fits.open(path, memmap=False) as hdus:
            begin = hdus.fileinfo(0)["datLoc"]
        self._file = os.open(path, os.O_RDWR)
        content = mmap.mmap(self._file, 0)
        self._pixels = np.frombuffer(content, ">u2", width * height, begin).reshape(height, width)

    def draw(self, pixels: np.ndarray):
        # FITS stores them signed, minus 32768.
        np.bitwise_xor(pixels, 0x8000, out=self._pixels, casting="unsafe")

    def lease(self):
        """Wait until the file has no reader; from then on a reader has to wait, and SIGIO announces it."""
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                fcntl.fcntl(self._file, fcntl.F_SETLEASE, fcntl.F_WRLCK)
                return
            except BlockingIOError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.002)

    def release(self):
        fcntl.fcntl(self._file, fcntl.F_SETLEASE, fcntl.F_UNLCK)


def signals() -> int:
    """Make a pipe that gives the number of each SIGIO and each of ENDS as a byte; return its end for reading.

    A mask of the main thread would not do: a signal may come to any thread, also to those that numpy has started.
    """
    told, tell = os.pipe()
    os.set_blocking(tell, False)
    signal.set_wakeup_fd(tell)
    for number in {signal.SIGIO, *ENDS}:
        signal.signal(number, lambda *_: None)
    return told


def set_up(port: str, folder: Path):
    """Make the simulator take its frames from the folder."""
    for setting in (
        "CONNECTION.CONNECT=On",
        f"CCD_DIRECTORY_LOCATION.LOCATION={folder}",
        "CCD_DIRECTORY_TOGGLE.INDI_ENABLED;INDI_DISABLED=On;Off",
    ):
        subprocess.run(["indi_setprop", "-p", port, "-t", "10", f"{DEVICE}.{setting}"], check=True)
    enabled = f'"{DEVICE}.CCD_DIRECTORY_TOGGLE.INDI_ENABLED"==1'
    subprocess.run(["indi_eval", "-p", port, "-t", "10", "-w", enabled], check=True)


def shutter(begin_s: float, exposure_s: float):
    """Have the contact close and open again: it is closed while the shutter is open."""
    print(f"shutter {1e3 * (begin_s - time.time()):.3f} {1e3 * exposure_s:.3f} {BOUNCES}", flush=True)


def main() -> int:
    port, folder, exposure_s, seed, place, lag_s, lag_stddev_s = sys.argv[1:]
    folder, exposure_s, rng = Path(folder), float(exposure_s), np.random.default_rng(int(seed))
    place = Place(**json.loads(place))
    scene = place.scene()
    from starpos.simulation.scene import expose, render
    from starpos.sky.catalogue import load_catalogue

    catalogue = load_catalogue()
    # The first call takes long.
    expose(scene, catalogue, time.time(), exposure_s, rng)
    size = scene.camera.width, scene.camera.height
    picture = Picture(folder / "sky.fits", *size, PIXEL_UM * place.binning)
    set_up(port, folder)
    told = signals()
    picture.lease()
    print("ready", file=sys.stderr, flush=True)
    ended = 0.0
    while os.read(told, 1)[0] == signal.SIGIO:
        now = time.time()
        if now > ended + AGAIN_S:
            begun = now + rng.normal(float(lag_s), float(lag_stddev_s))
            shutter(begun, exposure_s)
            stars = expose(scene, catalogue, begun, exposure_s, rng)
            picture.draw(render(scene, stars, begun, exposure_s, rng).pixels)
            print(f"{begun:.6f}", file=sys.stderr, flush=True)
            ended = begun + exposure_s
            # A signal to end comes at once.
            select.select([told], [], [], max(ended - time.time(), 0.0))
        picture.release()
        picture.lease()
    return 0


if __name__ == "__main__":
    sys.exit(main())
