# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --gnss`: what is printed, what is kept, and which options do not go together."""

import csv

import pytest
from cli_calls import AIR, PLACE, WIDE, objects

import starpos
from starpos.cli import main
from starpos.instrument.instrument import Instrument
from starpos_testing.command_line import SENSOR, run
from starpos_testing.skies.scenes import FOCAL_PX

HEAD = "utc_unix_s,latitude,longitude,altitude_m,sigma_east_m,sigma_north_m,status"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Two frames of one pose, and a receiver that stands still next to them."""
    folder = tmp_path_factory.mktemp("drive")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    command = [
        "simulate",
        str(folder),
        "--stars-only",
        "--size",
        "1000",
        "700",
        *WIDE,
        *place,
        *AIR,
        "-n",
        "3",
    ]
    assert main([*command, "--misalignment", "1.5", "-2", "130"]) == 0
    with (folder / "tilt.csv").open() as f:
        times = [float(row["utc_unix_s"]) for row in csv.DictReader(f)]
    rows = [
        f"{t:.3f},{PLACE['latitude']},{PLACE['longitude']},,2.5,2.5,0"
        for t in range(int(min(times)) - 3, int(max(times)) + 4)
    ]
    (folder / "gnss.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    return folder


def solve(capsys, drive, *more, tilt=True):
    frames = sorted(drive.glob("stars_*.csv"))
    tilts = ("--tilt", drive / "tilt.csv") if tilt else ()
    return run(capsys, "solve", *frames, *tilts, "--gnss", drive / "gnss.csv", *AIR, *WIDE, *SENSOR, *more)


def test_the_first_frame_has_a_heading_and_no_place_and_what_it_taught_is_kept(drive, tmp_path, capsys):
    kept = tmp_path / "learned.json"
    _, out, _ = solve(capsys, drive, "--learned", kept, "--json")
    first = objects(out)[0]
    assert first["latitude"] is None and first["heading"] is not None
    assert first["gnss"] == {"status": "learning", "distance_m": None, "bearing_deg": None, "sigma_m": None}
    assert kept.is_file()
    _, out, _ = solve(capsys, drive, "--learned", kept, "--json")
    again = objects(out)[0]
    assert again["latitude"] == pytest.approx(PLACE["latitude"], abs=0.1)


def test_without_tilts_there_are_headings(drive, capsys):
    status, out, _ = solve(capsys, drive, "--json", tilt=False)
    each = [line for line in objects(out) if "file" in line]
    assert status == 0 and len(each) == 3
    assert all(line["heading"] is not None and line["latitude"] is None for line in each)


@pytest.mark.parametrize(
    ("options", "said"),
    [(("--self-calibrate",), "do not go together"), (("--site", "47", "8"), "give one of the two")],
)
def test_options_that_contradict_each_other_are_refused(drive, capsys, options, said):
    status, _, errors = solve(capsys, drive, *options)
    assert status == 2 and said in errors[0]


def test_the_library_says_which_rows_of_gnss_are_left_out(drive, tmp_path):
    head, *rows = (drive / "gnss.csv").read_text().splitlines()
    broken = rows[0].split(",")
    broken[1] = "nan"
    (tmp_path / "gnss.csv").write_text("\n".join([head, *rows, ",".join(broken)]) + "\n")
    night = starpos.open_night(drive, instrument=Instrument(FOCAL_PX)).solve(gnss=tmp_path / "gnss.csv")
    assert any("gnss.csv: 1 row" in remark for remark in night.remarks), night.remarks


def test_learned_needs_gnss(drive, tmp_path, capsys):
    frames = sorted(drive.glob("stars_*.csv"))
    status, _, errors = run(
        capsys, "solve", *frames, "--tilt", drive / "tilt.csv", "--learned", tmp_path / "a.json"
    )
    assert status == 2 and "give both" in errors[0]


def test_without_gnss_its_code_is_not_asked_and_no_key_is_new(drive, capsys, monkeypatch):
    frames = sorted(drive.glob("stars_*.csv"))
    command = (
        "solve",
        *frames,
        "--tilt",
        drive / "tilt.csv",
        *AIR,
        *WIDE,
        *SENSOR,
        "--misalignment",
        "1.5",
        "-2",
    )
    command = (*command, "130", "--json")
    before = run(capsys, *command)

    def never(*_):
        raise AssertionError("GNSS was asked")

    for name in ("watch.GnssWatch.__init__", "receiver.GnssTrack.__init__", "receiver.read_gnss_csv"):
        monkeypatch.setattr(f"starpos.gnss.{name}", never)
    assert run(capsys, *command) == before
    for line in objects(before[1]):
        assert line["status"] == "ok" and "gnss" not in line


@pytest.mark.parametrize(
    ("north_deg", "said"),
    [(0.0, "No alarm: GNSS never disagreed."), (0.5, "km north of where the stars put us")],
)
def test_the_report_draws_the_drive_and_tells_the_alarm(drive, tmp_path, capsys, request, north_deg, said):
    pytest.importorskip("matplotlib")
    if not north_deg:
        request.getfixturevalue("unpainted")
    rows = (drive / "gnss.csv").read_text().splitlines()[1:]
    cells = [row.split(",") for row in rows]
    moved = [",".join([t, str(float(latitude) + north_deg), *rest]) for t, latitude, *rest in cells]
    gnss, out = tmp_path / "moved.csv", tmp_path / "report"
    gnss.write_text("\n".join([HEAD, *moved]) + "\n")
    a3 = ("--misalignment", "1.5", "-2", "130", "--misalignment-stddev", "0.01")
    status, _, errors = run(capsys, "report", drive, "--gnss", gnss, *AIR, *WIDE, *SENSOR, *a3, "-o", out)
    assert status == 0, errors
    page = (out / "index.html").read_text()
    assert "The drive beside GNSS" in page and said in page
    # the receiver's own table is no frame
    assert "bad input" not in page
    assert not north_deg or (out / "drive.png").stat().st_size > 10_000
