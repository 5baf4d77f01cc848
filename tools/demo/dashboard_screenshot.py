# SPDX-License-Identifier: Apache-2.0
"""Picture of the dashboard in a browser: of one that runs (--url), else of the demo's instrument, which it starts.

Needs Chromium with its driver (apt: chromium, chromium-driver) and selenium (pip).

    python tools/demo/dashboard_screenshot.py                      # makes src/starpos_dashboard/dashboard.png anew
    python tools/demo/dashboard_screenshot.py --url http://127.0.0.1:8042 --out demo/dashboard.png
"""

import argparse
import io
import os
import shutil
import socket
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import demo
import numpy as np
from instrument_run import Place, Processes

from starpos_testing.domain import own_domain

PICTURE = Path(__file__).resolve().parents[2] / "src" / "starpos_dashboard" / "dashboard.png"
# The picture shows this name, as it would show a robot's port.
PORT = Path("ttyUSB0")
SIZE = (1440, 1000)
# How many fixes are on the map.
FIXES = 6
PATIENCE_S = 120.0
LARGEST_BYTES = 150_000
CHROMIUM = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
]
READY = """
  const dots = document.querySelector("#map-view .dots")?.getAttribute("d") ?? "";
  return document.getElementById("status").className === "good" && dots.split("M").length > arguments[0]
    && document.getElementById("frame").checkVisibility() && document.querySelectorAll("section.old").length === 0;
"""


class ScreenshotError(Exception):
    """There is no picture; the text says why in a sentence."""


@contextmanager
def browser(size: tuple[int, int]):
    """Start a Chromium with an empty profile."""
    try:
        from selenium import webdriver
    except ImportError:
        raise ScreenshotError("selenium is not installed: pip install selenium") from None
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        raise ScreenshotError("there is no Chromium: sudo apt install chromium chromium-driver")
    with tempfile.TemporaryDirectory() as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = programs[0]
        for argument in (*CHROMIUM, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"):
            options.add_argument(argument)
        driver = webdriver.Chrome(options, webdriver.ChromeService(programs[1]))
        try:
            yield driver
        finally:
            driver.quit()


def photograph(url: str, path: Path, fixes: int = FIXES, size: tuple[int, int] = SIZE) -> None:
    """Write a PNG of the whole page once it shows a number of fixes and a frame; ScreenshotError if it never does."""
    from selenium.common.exceptions import WebDriverException

    with browser(size) as driver:
        try:
            driver.get(url)
        except WebDriverException:
            raise ScreenshotError(f"{url} does not answer: is the dashboard running?") from None
        end = time.monotonic() + PATIENCE_S
        while not driver.execute_script(READY, fixes):
            if time.monotonic() > end:
                said = driver.find_element("id", "status").text
                raise ScreenshotError(f"no page with {fixes} fixes in {PATIENCE_S:.0f} s; it says: {said}")
            time.sleep(0.2)
        height = driver.execute_script("return document.documentElement.scrollHeight")
        driver.set_window_size(size[0], height + size[1] - driver.execute_script("return innerHeight"))
        # The map is drawn again meanwhile.
        time.sleep(1.0)
        save(driver.get_screenshot_as_png(), path)


def save(png: bytes, path: Path) -> None:
    """Reduce the colours until the file is small enough for a repository."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    for colours in (256, 128, 64, 32):
        few = picture.quantize(colours, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.save(path, optimize=True)
        if path.stat().st_size < LARGEST_BYTES:
            return


@contextmanager
def own_instrument(seed: int):
    """Run the demo's instrument and a dashboard in a ROS domain of their own; gives the page's address."""
    with own_domain(), tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        processes = Processes(Path(scratch))
        try:
            processes.node("starpos_dashboard", "dashboard", {"port": port})
            demo.start(processes, Place.drawn(np.random.default_rng(seed)), seed, PORT)
            yield f"http://127.0.0.1:{port}"
        finally:
            processes.stop()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--url", help="of a dashboard that runs (default: the demo's instrument, started for it)"
    )
    parser.add_argument("--out", type=lambda text: Path(text).resolve(), default=PICTURE)
    parser.add_argument("--seed", type=int, default=4, help="place and sky of the demo's instrument")
    args = parser.parse_args()
    try:
        if args.url:
            photograph(args.url, args.out)
        else:
            with own_instrument(args.seed) as url:
                photograph(url, args.out)
    except ScreenshotError as error:
        print(f"dashboard_screenshot: {error}", file=sys.stderr)
        return 1
    print(f"picture: {args.out}, {args.out.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
