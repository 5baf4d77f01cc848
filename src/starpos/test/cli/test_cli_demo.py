# SPDX-License-Identifier: Apache-2.0
"""`starpos demo`: a hidden place is found by the commands that it prints."""

import json
import re

import numpy as np

from starpos.cli import demo, main
from starpos.frames.exif import Exif
from starpos.simulation import photographs


def test_the_hidden_place_is_found_by_the_printed_commands(tmp_path, capsys, monkeypatch):
    """Lists of stars, and no page: drawing takes longer."""
    monkeypatch.setattr(demo, "DRAWN", ("-n", "2", "--stars-only"))
    monkeypatch.setattr(demo, "find_spec", lambda name: None)
    assert main(["demo", "-o", f"{tmp_path / 'demo'}", "--seed", "3"]) == 0
    said, complaints = capsys.readouterr()
    assert "matplotlib" in complaints
    before, after = said.split("the place that was hidden:")
    latitude, _, off_m = re.fullmatch(r" ([-+.\d]+) ([-+.\d]+), (\d+) m from the one found\n", after).groups()
    assert f"{float(latitude):.3f}" not in before.split("$ starpos solve")[0]
    assert int(off_m) < 1500
    assert (tmp_path / "demo" / "place.geojson").is_file()


def test_it_is_midnight_there():
    assert demo._midnight(90.0)[11:19] == "18:00:00"
    assert demo._midnight(-180.0)[11:19] == "12:00:00"


def test_the_photographs_alone_find_their_place(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(photographs, "POSES_DEG", photographs.POSES_DEG[:2])
    monkeypatch.setattr(demo, "find_spec", lambda name: None)
    assert main(["demo", "--photo", "-o", f"{tmp_path}", "--seed", "5"]) == 0
    said, complaints = capsys.readouterr()
    assert "gravity in the files" in complaints
    found = json.loads((tmp_path / "place.geojson").read_text())["features"][-2]["properties"]
    hidden = np.array([float(x) for x in re.search(r"was hidden: (\S+) (\S+),", said).groups()])
    off_km = 111.2 * np.hypot(*(hidden - [found["latitude"], found["longitude"]]))
    assert 5e3 < found["sigma_north_m"] < 60e3 and off_km < 100
    # nothing of the place is in the files
    exif = Exif.of((tmp_path / "photographs" / "IMG_0001.JPG").read_bytes(), 4032, 3024)
    assert exif.gps_deg is None and exif.text("Image Make") == "Apple"
