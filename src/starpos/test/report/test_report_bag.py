# SPDX-License-Identifier: Apache-2.0
"""`starpos report` on a rosbag2: the answer of the same night in files, and invalid bags."""

import io
import json
import shutil
import sqlite3
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest

from starpos.cli import main
from starpos_testing.command_line import SENSOR
from starpos_testing.skies.reports import A3, AIR, KNOWN, Page, run, simulate

pytest.importorskip("matplotlib")
pytest.importorskip("rosbags")

from rosbags.rosbag2 import StoragePlugin

from starpos.frames.reading import read_frame
from starpos.instrument.tilt_table import read_tilt_csv
from starpos_testing.skies.bags import NightBag, typestore

RECORDED = Path(__file__).resolve().parents[4] / "test" / "data" / "night"
FOCAL_PX = 29.67e3 / 6.4


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Six frames in files."""
    return simulate(tmp_path_factory.mktemp("night") / "night", "--cadence", 30)


@pytest.fixture(scope="module")
def lists(night):
    return [read_frame(path) for path in sorted(night.glob("stars_*.csv"))]


@pytest.fixture(scope="module")
def tilts(night):
    """The night's tilts after they went through messages, whose stamps are whole microseconds."""
    return read_tilt_csv(night / "tilt.csv")


def solve(night, *more):
    """All objects of `starpos solve --json`: of each frame, and of all together."""
    command = ["solve", *sorted(night.glob("stars_*.csv")), "--tilt", night / "tilt.csv", *KNOWN, *AIR, *more]
    with redirect_stdout(io.StringIO()) as out:
        main([*map(str, command), "--json"])
    return [json.loads(line) for line in out.getvalue().splitlines()]


@pytest.fixture(scope="module")
def solved_place(night):
    """How a page gives the place that `starpos solve` finds."""
    return place(solve(night)[-1])


def record(path, lists, tilts, **how):
    with NightBag(path, **how) as bag:
        bag.camera(FOCAL_PX, 1000, 700)
        for stars in lists:
            bag.stars(stars)
        if tilts is not None:
            bag.tilts(tilts)
    return path


def report(capsys, bag, out, *more):
    status, said, errors = run(capsys, "report", bag, "-o", out, *A3, *AIR, *more)
    return status, (Page(out / "index.html") if said else None), errors


def place(want):
    east, north, turn = np.sqrt(np.diag(want["covariance_geodetic"]))
    return (
        f"{want['latitude_geodetic']:+.6f}°, {want['longitude_geodetic']:+.6f}° ± {north:.0f} m N {east:.0f} m E "
        f"(WGS 84, as on maps), heading {want['heading']:.4f} ± {turn:.4f}°"
    )


@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_gives_what_solve_gives_of_the_same_night(plugin, solved_place, lists, tilts, tmp_path, capsys):
    bag = record(tmp_path / "bag", lists, tilts, plugin=plugin)
    status, page, errors = report(capsys, bag, tmp_path / "out")
    assert (status, errors) == (0, [])
    assert solved_place in page.text
    assert "6: 6 with a fix" in page.text and "solved from stars and tilt of the bag" in page.text
    assert len(page.pictures) == 8


@pytest.mark.usefixtures("unpainted")
def test_one_file_of_a_bag_is_a_bag(solved_place, lists, tilts, tmp_path, capsys):
    bag = record(tmp_path / "bag", lists, tilts)
    (file,) = bag.glob("*.mcap")
    status, page, _ = report(capsys, file, tmp_path / "out")
    assert status == 0
    assert solved_place in page.text


@pytest.mark.usefixtures("unpainted")
def test_the_recorded_night_of_the_repository(tmp_path, capsys):
    if not RECORDED.is_dir():
        pytest.skip("the repository's bag is not beside this package")
    truth = json.loads(RECORDED.with_suffix(".json").read_text())
    air = ("--pressure-hpa", truth["pressure_pa"] / 100, "--temperature-c", truth["temperature_c"],
           "--humidity", truth["humidity"])  # fmt: skip
    about = (*air, "--misalignment", *truth["misalignment_deg"], "--misalignment-stddev", 5, *SENSOR)
    status, _, errors = run(capsys, "report", RECORDED, "-o", tmp_path / "out", *about)
    page = Page(tmp_path / "out" / "index.html")
    assert (status, errors) == (0, [])
    assert "10: 10 with a fix" in page.text
    latitude, longitude = page.text.split("starpos report: night")[-1].split("°")[:2]
    assert float(latitude) == pytest.approx(truth["latitude_deg"], abs=3e-4)
    assert float(longitude.strip(" ,")) == pytest.approx(truth["longitude_deg"], abs=4e-4)


@pytest.mark.usefixtures("unpainted")
def test_of_several_instruments_one_is_chosen(solved_place, lists, tilts, tmp_path, capsys):
    with NightBag(tmp_path / "bag") as bag:
        for bag.namespace in ("/north", "/far/south"):
            bag.camera(FOCAL_PX, 1000, 700)
            bag.tilts(tilts)
            for stars in lists[: 6 if bag.namespace == "/north" else 2]:
                bag.stars(stars)
    status, _, errors = report(capsys, tmp_path / "bag", tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert "/far/south, /north" in errors[0] and "--namespace" in errors[0]
    status, _, errors = report(capsys, tmp_path / "bag", tmp_path / "out", "--namespace", "west")
    assert (status, len(errors)) == (2, 1)
    status, page, _ = report(capsys, tmp_path / "bag", tmp_path / "out", "--namespace", "north")
    assert status == 0
    assert solved_place in page.text
    _, page, _ = report(capsys, tmp_path / "bag", tmp_path / "out", "--namespace", "/far/south")
    assert "2: 2 with a fix" in page.text


@pytest.mark.usefixtures("unpainted")
def test_stars_without_tilts_give_no_fix_and_say_why(lists, tmp_path, capsys):
    bag = record(tmp_path / "bag", lists[:2], None)
    status, page, errors = report(capsys, bag, tmp_path / "out")
    assert (status, len(errors)) == (1, 1)
    assert "no usable tilt in it" in page.text and "2 no tilt" in page.text


@pytest.mark.usefixtures("unpainted")
def test_flagged_and_broken_tilts_are_left_out(solved_place, lists, tilts, tmp_path, capsys):
    with NightBag(tmp_path / "bag") as bag:
        bag.camera(FOCAL_PX, 1000, 700)
        for stars in lists:
            bag.stars(stars)
        bag.tilts(tilts)
        wrong = [
            {"flags": 2},
            {"x": float("nan")},
            {"x": 1.0, "y": 1.0},
            *(
                {"covariance": np.array(c)}
                for c in ([1.0, 0, 0, -1], [25.0, 0, 0, 25], [1e-9, 1e-10, 0, 1e-9])
            ),
        ]
        for stars in lists:
            for k, broken in enumerate(wrong):
                at = stars.mid_unix_s + 0.01 * k
                bag.write("tilt", bag.message("Tilt", at, **{"x": 0.1, "y": 0.1} | broken), at)
    status, page, errors = report(capsys, tmp_path / "bag", tmp_path / "out")
    assert status == 0
    assert solved_place in page.text
    assert f"{len(wrong) * len(lists)} tilts of the bag were left out" in errors[0]


@pytest.mark.usefixtures("unpainted")
def test_a_bag_without_a_camera_takes_the_options(solved_place, lists, tilts, tmp_path, capsys):
    with NightBag(tmp_path / "bag") as bag:
        bag.tilts(tilts)
        for stars in lists:
            bag.stars(stars)
    status, _, errors = report(capsys, tmp_path / "bag", tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert "focal" in errors[0]
    status, page, _ = report(capsys, tmp_path / "bag", tmp_path / "out", *KNOWN)
    assert status == 0
    assert solved_place in page.text


def without_definitions(bag):
    """Leave the db3 as a recorder before Iron does."""
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as db:
        db.execute("DELETE FROM message_definitions")
        db.execute("DROP TABLE message_definitions")
        db.execute("UPDATE schema SET schema_version = 3")
    db.close()
    return bag


@pytest.mark.usefixtures("unpainted")
def test_definitions_a_bag_lacks_come_from_the_workspace(
    solved_place, lists, tilts, tmp_path, capsys, monkeypatch
):
    bag = without_definitions(record(tmp_path / "bag", lists, tilts, plugin=StoragePlugin.SQLITE3))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    status, _, errors = report(capsys, bag, tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert "does not hold the definition of starpos_interfaces/msg/" in errors[0]
    prefix = tmp_path / "workspace"
    typestore()
    shutil.copytree(
        RECORDED.parents[2] / "starpos_interfaces" / "msg", prefix / "share/starpos_interfaces/msg"
    )
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{prefix}")
    status, page, _ = report(capsys, bag, tmp_path / "out")
    assert status == 0
    assert solved_place in page.text


@pytest.mark.parametrize("damage", ["cut", "garbage", "metadata", "other"])
def test_what_is_no_bag_is_refused_in_one_line(damage, lists, tilts, tmp_path, capsys):
    bag = record(tmp_path / "bag", lists, tilts) if damage != "other" else tmp_path / "bag"
    if damage == "other":
        with NightBag(bag) as other:
            other.camera(FOCAL_PX, 1000, 700)
    elif damage == "metadata":
        (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2\n")
    else:
        (file,) = bag.glob("*.mcap")
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if damage == "cut" else b"\0" * 1000)
    status, _, errors = report(capsys, bag, tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert str(bag) in errors[0]
    assert ("mcap recover" in errors[0]) == (damage == "cut")


@pytest.mark.usefixtures("unpainted")
def test_a_recording_that_was_killed_says_how_to_get_it_back(lists, tilts, tmp_path, capsys):
    bag = record(tmp_path / "bag", lists, tilts)
    # Both come at the end.
    (bag / "metadata.yaml").unlink()
    (file,) = bag.glob("*.mcap")
    whole = file.read_bytes()
    for left in (0, 8, 9, len(whole) - 1):
        file.write_bytes(whole[:left])
        for path in (bag, file):
            status, _, errors = report(capsys, path, tmp_path / "out")
            assert (status, len(errors)) == (2, 1), left
            assert ("mcap recover bag.mcap" in errors[0]) == (left > 0), left


@pytest.mark.usefixtures("unpainted")
def test_broken_star_lists_cost_their_frame_only(solved_place, lists, tilts, tmp_path, capsys):
    with NightBag(tmp_path / "bag") as bag:
        bag.camera(FOCAL_PX, 1000, 700)
        bag.tilts(tilts)
        for stars in lists:
            bag.stars(stars)
        at = lists[-1].mid_unix_s + 1
        rows = [bag.message("Star", x=float("nan"), y=3.0, flux=1.0, snr=1.0)]
        bag.write("stars", bag.message("StarArray", at, width=1000, height=700, stars=rows), at)
    status, page, _ = report(capsys, tmp_path / "bag", tmp_path / "out")
    assert status == 0
    assert solved_place in page.text
    assert "7: 6 with a fix, 1 bad input" in page.text


def test_without_rosbags_the_pip_line_is_said(lists, tilts, tmp_path, capsys, monkeypatch):
    from starpos.cli import inputs as command

    bag = record(tmp_path / "bag", lists, tilts)
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == "rosbags" else name)
    status, _, errors = report(capsys, bag, tmp_path / "out")
    assert (status, len(errors)) == (2, 1)
    assert "pip install matplotlib rosbags" in errors[0]
