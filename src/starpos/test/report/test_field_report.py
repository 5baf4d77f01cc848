# SPDX-License-Identifier: Apache-2.0
"""A night in one file: the same fix from it, nothing of its owner in it, and no harm from other files."""

import getpass
import json
import socket
import zipfile
from pathlib import Path

import pytest

from starpos.cli import main
from starpos.night import field

OPTICS = (
    "--focal-mm",
    "600",
    "--pixel-um",
    "6.4",
    "--misalignment",
    "0.1",
    "-0.2",
    "0.3",
    "--misalignment-stddev",
    "5",
)
KNOWN = (
    *OPTICS,
    "--inclinometer",
    "scl3300",
    "--pressure-hpa",
    "900",
    "--temperature-c",
    "5",
    "--humidity",
    "0.4",
)
BAG = Path(__file__).parents[4] / "test" / "data" / "night"


def solved(capsys, *arguments):
    """The combined solution of `starpos solve --json`."""
    assert main(["solve", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def packed(path):
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    folder = tmp_path_factory.mktemp("backyard-of-jane") / "secret-name"
    misalignment = ("--misalignment", "0.1", "-0.2", "0.3")
    assert main(["simulate", str(folder), "--stars-only", "-n", "2", "--seed", "3", *misalignment]) == 0
    return folder


@pytest.fixture(scope="module")
def report(night, tmp_path_factory):
    path = tmp_path_factory.mktemp("sent") / "night.zip"
    assert main(["report", str(night), "--field", str(path), *KNOWN]) == 0
    return path


def test_the_same_fix_comes_from_it_without_any_option(night, report, capsys):
    capsys.readouterr()
    ours, theirs = solved(capsys, night, *KNOWN), solved(capsys, report)
    assert ours["combined"] and theirs["combined"]
    for key in ("latitude", "longitude", "heading"):
        assert theirs[key] == pytest.approx(ours[key], abs=1e-7)
    for key in ("sigma_east_m", "sigma_north_m", "sigma_heading_deg"):
        assert theirs[key] == pytest.approx(ours[key], rel=1e-3)


def test_options_count_more_than_what_it_states(report, capsys):
    capsys.readouterr()
    wider = ("--misalignment", "0.1", "-0.2", "0.3", "--misalignment-stddev", "500")
    other = solved(
        capsys, report, "--focal-mm", "600", "--pixel-um", "6.4", *wider, "--inclinometer", "scl3300"
    )
    assert other["sigma_east_m"] > 2 * solved(capsys, report)["sigma_east_m"]


def test_it_is_small_and_nothing_of_its_owner_is_in_it(night, report):
    files = packed(report)
    assert set(files) == {
        "field.json",
        "instrument.yaml",
        "tilt.csv",
        "truth.json",
        "stars_0000.csv",
        "stars_0001.csv",
    }
    assert report.stat().st_size < 20_000
    text = b"".join(files.values()).decode().lower()
    for private in (
        str(night.parent),
        night.name,
        "jane",
        socket.gethostname().lower(),
        str(Path.home()).lower(),
    ):
        assert private.lower() not in text
    assert getpass.getuser().lower() not in text or getpass.getuser() in ("root", "user")
    about = json.loads(files["field.json"])
    assert (
        about["starpos_field"] == 1 and about["versions"]["starpos"] and about["air"]["pressure_pa"] == 90000
    )
    assert json.loads(files["truth.json"])["simulated_files"] is True
    with zipfile.ZipFile(report) as file:
        assert {info.date_time for info in file.infolist()} == {(1980, 1, 1, 0, 0, 0)}


@pytest.mark.skipif(not BAG.exists(), reason="installed without the workspace's test data")
def test_a_recorded_night_becomes_one_too(tmp_path, capsys):
    pytest.importorskip("rosbags")
    path, truth = tmp_path / "bag.zip", json.loads(BAG.with_suffix(".json").read_text())
    a3 = map(str, truth["misalignment_deg"])
    known = ("--misalignment", *a3, "--misalignment-stddev", "5", "--inclinometer", "sca100t_calibrated")
    assert main(["report", str(BAG), "--field", str(path), *known]) == 0
    count = sum(name.startswith("stars_") for name in packed(path))
    assert count > 0 and f"{count} frames" in capsys.readouterr().out
    place = solved(capsys, path)
    assert place["latitude"] == pytest.approx(truth["latitude_deg"], abs=0.01)
    assert place["longitude"] == pytest.approx(truth["longitude_deg"], abs=0.01)


def test_a_night_without_tilts_or_two_nights_are_refused(night, tmp_path, capsys):
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "a.csv").write_bytes((night / "stars_0000.csv").read_bytes())
    for arguments, said in (((str(bare),), "no tilts"), ((str(night), str(bare)), "one night: give one")):
        assert main(["report", *arguments, "--field", str(tmp_path / "x.zip"), *KNOWN]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
        assert said in line
    assert main(["report", str(night), "--field", str(tmp_path / "x.txt"), *KNOWN]) == 2
    assert not (tmp_path / "x.zip").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda files: files.pop("field.json"), "not a field report"),
        (lambda files: files.update({"../evil.csv": b"x"}), "'../evil.csv'"),
        (lambda files: files.update({"/etc/passwd": b"x"}), "'/etc/passwd'"),
        (lambda files: files.update({"field.json": b'{"starpos_field": 2, "air": {}}'}), "reads 1"),
        (lambda files: files.update({"field.json": b"[]"}), "not a field report"),
        (
            lambda files: files.update({"field.json": b'{"starpos_field": 1, "air": {"x": 1}}'}),
            "not a field report",
        ),
    ],
)
def test_what_is_no_field_report_is_refused_in_a_sentence(report, tmp_path, capsys, change, said):
    files = packed(report)
    change(files)
    path = tmp_path / "bad.zip"
    with zipfile.ZipFile(path, "w") as file:
        for name, content in files.items():
            file.writestr(name, content)
    assert main(["solve", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "evil.csv").exists()


def test_a_file_that_unpacks_to_too_much_or_is_no_zip_is_refused(report, tmp_path, capsys, monkeypatch):
    broken = tmp_path / "broken.zip"
    broken.write_bytes(report.read_bytes()[:3000])
    assert main(["solve", str(broken)]) == 2
    # the file itself has 15 kB, and its contents 25
    for limit, most in (("MAX_BYTES", 18_000), ("MAX_FILES", 3)):
        with monkeypatch.context() as limits:
            limits.setattr(field, limit, most)
            assert main(["solve", str(report)]) == 2
    assert capsys.readouterr().err.count("not a field report") == 3


def test_the_solvers_own_code_finds_the_same_place(report, capsys):
    capsys.readouterr()
    by_solve = solved(capsys, report)
    assert main(["replay", str(report), "--json"]) == 0
    *_, by_session = map(json.loads, capsys.readouterr().out.splitlines())
    assert by_session["combined"]
    for key in ("latitude", "longitude"):
        # both are within the tilts that each takes to a frame
        assert abs(by_session[key] - by_solve[key]) * 111_000 < by_solve["sigma_north_m"] / 2
