# SPDX-License-Identifier: Apache-2.0
"""`starpos navigate` on a drive of 80 s: star lists under the catalogue's sky, an IMU's table, odometry."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from cli_calls import AIR, WIDE, objects

from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError
from starpos.frames.reading import read_frame
from starpos.instrument.instrument import Instrument
from starpos.night.reading import Instruments
from starpos.night.under_way import vessel_of, voyage_frame
from starpos_testing.command_line import run
from starpos_testing.skies.folders import write_drive
from starpos_testing.skies.scenes import FOCAL_PX
from starpos_testing.voyages import INDUSTRIAL, made

KEYS = {"file", "utc_unix_s", "latitude", "longitude", "heading", "covariance", "velocity", "gyro_bias", "accel_bias",
        "status", "latitude_geodetic", "longitude_geodetic", "covariance_geodetic"}  # fmt: skip


@pytest.fixture(scope="module")
def voyage(tmp_path_factory, catalogue):
    """The folder of a drive, and its truth."""
    folder, record = tmp_path_factory.mktemp("voyage"), made("rover", 80, 2, cadence_s=2.0)
    write_drive(folder, catalogue, record)
    return folder, record


def navigate(capsys, folder, *more, velocity=True, imu="imu.csv"):
    log = ["--velocity", folder / "velocity.csv"] if velocity else []
    given = [
        "--imu",
        folder / imu,
        "--imu-model",
        folder / "imu.yaml",
        *log,
        "--vehicle",
        "rover",
        *WIDE,
        *AIR,
    ]
    return run(
        capsys, "navigate", *sorted(folder.glob("stars_*.csv")), *given, "--clock-stddev", "0.001", *more
    )


def test_each_frame_has_a_place_whose_claim_holds(voyage, capsys):
    folder, record = voyage
    status, out, errors = navigate(capsys, folder, "--json")
    rows = objects(out)
    assert (status, errors, len(rows)) == (0, [], 40)
    assert all(set(row) >= KEYS and row["status"] == "ok" for row in rows)
    last, phi, lam = rows[-1], record.latitude[-1], record.longitude[-1]
    off = np.array([
        (np.radians(last["longitude"]) - lam) * 6.378e6 * np.cos(phi),
        (np.radians(last["latitude"]) - phi) * 6.37e6,
        (last["heading"] - np.degrees(record.heading[-1]) + 180) % 360 - 180,
    ])  # fmt: skip
    covariance = np.array(last["covariance"])
    assert off @ np.linalg.solve(covariance, off) < 16
    assert 20 < np.sqrt(covariance[0, 0]) < 500
    assert np.hypot(*last["velocity"][:2]) == pytest.approx(
        np.linalg.norm(record.velocity.velocity[-1]), abs=0.1
    )
    # an unknown deflection is in the geodetic place alone
    assert last["covariance_geodetic"][0][0] > covariance[0, 0] + 180**2


def test_a_table_for_people(voyage, capsys):
    status, out, _ = navigate(capsys, voyage[0], "--xi", "1", "--eta", "2")
    lines = out.splitlines()
    assert status == 0 and len(lines) == 41 and lines[0].startswith("file: latitude")
    assert " m N " in lines[1] and "m/s" in lines[1]


def test_faults_are_told_and_a_frame_without_readings_has_no_answer(voyage, capsys):
    folder, _ = voyage
    lines = (folder / "imu.csv").read_text().splitlines()
    lines[100] = lines[100].replace(lines[100].split(",")[1], "nan", 1)
    (folder / "cut.csv").write_text("\n".join(lines[:3600]) + "\n" + lines[3000] + "\n")
    status, out, errors = navigate(capsys, folder, "--json", imu="cut.csv")
    assert status == 0
    assert any("1 row is without a finite number" in line for line in errors)
    assert any("not later than all before" in line for line in errors)
    assert [row["status"] for row in objects(out)][-1] == "no inertial readings"
    assert objects(out)[-1]["latitude"] is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,gx\n1,2\n", "it has no column utc_unix_s"),
        ("utc_unix_s,gx,gy,gz,ax,ay,az\n", "has no rows"),
        ("utc_unix_s,gx,gy,gz,ax,ay,az\n1,2,3,4,5,6,seven\n", "bad.csv:2: az is 'seven', which is no number"),
        ("utc_unix_s,gx,gy,gz,ax,ay,az\n1793700000,0,0,0,0,0,9.8\n", "at least 100 are needed"),
    ],
)
def test_a_table_that_is_none(voyage, capsys, text, said):
    (voyage[0] / "bad.csv").write_text(text)
    status, _, errors = navigate(capsys, voyage[0], imu="bad.csv")
    assert status == 2 and len(errors) == 1 and said in errors[0]


def test_a_model_that_is_none(voyage, capsys, tmp_path):
    for text, said in (
        ("gyroscope_noise_density: 1e-5\n", "needs gyroscope_noise_density, accelerometer_noise_density"),
        ("".join(f"{name}: 100\n" for name in asdict(INDUSTRIAL)), "it must be above 0 and below"),
        ("".join(f"{name}: [1]\n" for name in asdict(INDUSTRIAL)), "give a number"),
    ):
        (tmp_path / "imu.yaml").write_text(text)
        status, _, errors = navigate(capsys, voyage[0], "--imu-model", tmp_path / "imu.yaml")
        assert status == 2 and said in errors[0], json.dumps(errors)


def cards(folder, to, **more):
    """Copies of the star lists with more cards in their headers."""
    for path in folder.glob("stars_*.csv"):
        first, rows = path.read_text().split("\n", 1)
        (to / path.name).write_text(f"# {json.dumps(json.loads(first.lstrip('# ')) | more)}\n{rows}")
    for name in ("imu.csv", "imu.yaml", "velocity.csv"):
        (to / name).write_bytes((folder / name).read_bytes())


def test_crops_of_a_sensor_of_which_nobody_says_the_size_are_refused_as_of_a_mount_that_nobody_knows(
    voyage, tmp_path, capsys
):
    cards(voyage[0], tmp_path, XORGSUBF=0, YORGSUBF=0)
    status, out, errors = navigate(capsys, tmp_path)
    # 2000 px are 23 deg here
    assert (status, out, len(errors)) == (2, "", 1)
    assert "size is not stated" in errors[0] and "an error of the mount" in errors[0]


def test_a_frame_keeps_the_errors_of_its_stamp_and_its_clock(voyage):
    stars = replace(read_frame(min(voyage[0].glob("stars_*.csv"))), stamp_stddev_s=0.1, clock_stddev_s=20.0)
    seen = voyage_frame(Instruments(Instrument(FOCAL_PX)), stars).sighting
    assert (seen.stamp_stddev_s, seen.clock_stddev_s) == (0.1, 20.0)


def test_an_axis_that_nobody_knows_widens_the_mount():
    unknown = Instrument(1000.0, axis_stddev_rad=np.radians(4))
    vessel = vessel_of(unknown, Atmosphere(), "cut out", mount_stddev_deg=3.0)
    assert vessel.mount_stddev == pytest.approx(np.radians(5))
    with pytest.raises(InstrumentError, match="cut out; with"):
        vessel_of(unknown, Atmosphere(), "cut out", mount_stddev_deg=30.0)


def test_a_wrong_header_keeps_no_frame_from_a_voyage(voyage, tmp_path, capsys):
    cards(voyage[0], tmp_path, FOCALLEN=29.67, XPIXSZ=6.8)
    given = (
        "--imu",
        tmp_path / "imu.csv",
        "--imu-model",
        tmp_path / "imu.yaml",
        "--velocity",
        tmp_path / "velocity.csv",
    )
    lists = sorted(tmp_path.glob("stars_*.csv"))[:5]
    status, out, errors = run(
        capsys, "navigate", *lists, *given, "--vehicle", "rover", *AIR, "--clock-stddev", "0.001", "--json"
    )
    assert status == 0 and [row["status"] for row in objects(out)] == ["ok"] * 5
    assert sum("its header is wrong" in line for line in errors) == 5
