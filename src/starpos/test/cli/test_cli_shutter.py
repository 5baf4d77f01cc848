# SPDX-License-Identifier: Apache-2.0
"""Rolling shutters and late ones on the command line."""

import json

import numpy as np
import pytest

from starpos.cli import main
from starpos.frames.exposure import Shutter
from starpos.frames.reading import read_frame
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos_testing.command_line import A3

PLACE, START = ("--latitude", "35", "--longitude", "51"), "2026-11-02T18:00:00"
M_PER_S = 465.1 * np.cos(np.radians(35))
READOUT_S = 0.04


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Two lists of stars of a rolling shutter, 60 deg up, and tilt.csv."""
    folder = tmp_path_factory.mktemp("rolling")
    more = ("--altitude", "60", "--start", START, "--readout", str(READOUT_S), "--tilt-noise", "0.000003")
    assert main(["simulate", str(folder), "-n", "2", "--stars-only", *PLACE, *more]) == 0
    return folder


def solved(capsys, folder, *more):
    """The budget, longitude and status of the average."""
    frames = sorted(map(str, folder.glob("stars_*.csv")))
    optics = () if "--instrument" in more else ("--focal-mm", "600", "--pixel-um", "6.4", *A3)
    capsys.readouterr()
    assert main(["solve", *frames, "--tilt", str(folder / "tilt.csv"), *optics, *more, "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_a_frame_says_what_its_shutter_is_and_options_may_say_otherwise(night, capsys):
    told = solved(capsys, night)
    assert told["budget"]["shutter"] == [0.0, 0.0, 0.0]
    unknown = solved(capsys, night, "--readout", "0", "0.03")
    assert max(unknown["budget"]["shutter"][:2]) > 5
    wrong = solved(capsys, night, "--readout", str(-READOUT_S), "0")
    apart_m = 111_000 * np.hypot(
        wrong["latitude"] - told["latitude"],
        (wrong["longitude"] - told["longitude"]) * np.cos(np.radians(35)),
    )
    assert apart_m > 15


def test_a_frame_that_says_nothing_of_its_shutter_has_a_term(night, tmp_path, capsys):
    for path in (*night.glob("stars_*.csv"), night / "tilt.csv"):
        text = path.read_text().replace(f', "ROLLSHUT": {READOUT_S}', "")
        (tmp_path / path.name).write_text(text)
    assert read_frame(tmp_path / "stars_0000.csv").shutter is None
    unknown = solved(capsys, night, "--readout", "0", "0.03")
    silent = solved(capsys, tmp_path)
    assert silent["budget"]["shutter"] == unknown["budget"]["shutter"]


def test_the_instrument_file_states_the_shutter(night, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    stated = Shutter(READOUT_S, 0.002)
    instrument_file.write(file, Instrument(93750.0, shutter=stated))
    assert instrument_file.read(file).shutter == stated
    budget = solved(capsys, night, "--instrument", str(file))["budget"]
    assert 0 < max(budget["shutter"][:2]) < 10


@pytest.mark.parametrize(
    ("shutter", "sentence"),
    [("5", "shutter is 5"), ("{readout_s: 0.1}", "readout_stddev_s is missing"),
     ("{readout_s: 99, readout_stddev_s: 0}", "is impossible"), ("{row_s: 1}", "unknown key 'row_s'")],
)  # fmt: skip
def test_a_shutter_that_cannot_be_is_refused(tmp_path, capsys, shutter, sentence):
    file = tmp_path / "bad.yaml"
    file.write_text(f"starpos_instrument: 1\ncamera: {{focal_px: 1000}}\nshutter: {shutter}\n")
    (tmp_path / "tilt.csv").write_text("utc_unix_s,theta_x_deg,theta_y_deg\n1,0,0\n")
    (tmp_path / "a.csv").write_text('# {"NAXIS1": 100, "NAXIS2": 80}\nx,y,flux\n1,2,3\n')
    files = (str(tmp_path / "a.csv"), "--tilt", str(tmp_path / "tilt.csv"), "--instrument", str(file))
    assert main(["solve", *files]) == 2
    assert sentence in capsys.readouterr().err


def test_a_shutter_that_opens_late_moves_the_place_west_and_its_error_is_in_the_budget(night, capsys):
    told = solved(capsys, night)
    late = solved(capsys, night, "--shutter-delay", "0.1", "0.05")
    assert (late["longitude"] - told["longitude"]) * 3600 == pytest.approx(-1.504, abs=0.01)
    assert late["budget"]["time stamp"][0] == pytest.approx(0.05 * M_PER_S, rel=0.01)
    assert told["budget"]["time stamp"][0] < 0.001 * M_PER_S


def test_a_shutter_is_no_matter_of_pointings(tmp_path, capsys):
    for option in ("--readout", "--shutter-delay"):
        assert main(["solve", "--pointings", str(tmp_path / "p.csv"), option, "0.1", "0"]) == 2
        assert "do not go together" in capsys.readouterr().err
