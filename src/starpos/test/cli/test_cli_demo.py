# SPDX-License-Identifier: Apache-2.0
"""`starpos demo`: a hidden place is found by the commands that it prints."""

import re

from starpos.cli import demo, main


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
