# SPDX-License-Identifier: Apache-2.0
"""Nights to report on, and readers of pages and pictures, for the tests of the report."""

import base64
import json
from html.parser import HTMLParser

import numpy as np

from starpos.cli import main
from starpos_testing.command_line import A3, OPTICS, run

KNOWN = (*OPTICS, *A3)
AIR = ("--pressure-hpa", "1000", "--temperature-c", "5")
PLACE = {"latitude": 47.3, "longitude": -122.8}


def simulate(folder, *more, frames=6, place=PLACE):
    """Simulate a folder with lists of stars, tilt.csv and truth.json."""
    at = [f"--{k}={v}" for k, v in place.items()]
    wide = ("--stars-only", "--size", "1000", "700", *OPTICS, *AIR)
    assert main(["simulate", str(folder), "-n", str(frames), *wide, *at, *map(str, more)]) == 0
    return folder


def solved(capsys, night, *more):
    """The last object of `starpos solve --json`, on all frames together."""
    frames = sorted(night.glob("stars_*.csv"))
    _, out, _ = run(capsys, "solve", *frames, "--tilt", night / "tilt.csv", "--json", *more)
    return json.loads(out.splitlines()[-1])


class Page(HTMLParser):
    """Parser of a page: its text, its references, and its pictures (bytes of PNG by title)."""

    def __init__(self, path):
        super().__init__()
        self.text, self.references, self.pictures, self.tags = "", [], {}, set()
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.add(tag)
        self.references += [attributes[k] for k in ("src", "href", "srcset", "action") if k in attributes]
        if tag == "img":
            kind, _, data = attributes["src"].partition(",")
            assert kind == "data:image/png;base64"
            self.pictures[attributes["alt"]] = base64.b64decode(data, validate=True)

    def handle_data(self, data):
        self.text += data


def assert_drawn(png):
    """Assert that a PNG can be decoded and is not blank."""
    import cv2

    pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None and min(pixels.shape[:2]) > 300
    # Ink on white.
    assert 0.003 < np.mean(pixels.min(2) < 200) < 0.6
