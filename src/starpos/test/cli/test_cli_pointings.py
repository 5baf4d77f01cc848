# SPDX-License-Identifier: Apache-2.0
"""`--pointings` in place of frames: what a plate solver found, with and without a roll."""

import dataclasses

import numpy as np
import pytest
from cli_calls import SOLVE_KEYS, objects

from starpos.instrument.instrument_file import read
from starpos_testing.command_line import SENSOR, run
from starpos_testing.skies.pointings import pointed_night

AIR = ("--pressure-hpa", "880", "--temperature-c", "12", "--humidity", "0.3")
A3 = ("--misalignment", "1.5", "-2", "130", "--misalignment-stddev", "0.1", *SENSOR)
NAMES = "utc_unix_s,ra_deg,dec_deg,roll_deg,sigma_arcsec,sigma_roll_arcsec"


@dataclasses.dataclass(frozen=True)
class Tables:
    night: object
    folder: object

    @property
    def tilt(self):
        return "--tilt", self.folder / "tilt.csv"

    def pointings(self, name):
        return "--pointings", self.folder / name

    def sigmas_off(self, answer):
        """Error of the place in units of the claimed sigma, the worse of the two axes."""
        site = self.night.site
        north = (answer["latitude"] - site.latitude_deg) * 111.2e3 / answer["sigma_north_m"]
        wide = np.cos(np.radians(site.latitude_deg))
        east = (answer["longitude"] - site.longitude_deg) * 111.2e3 * wide / answer["sigma_east_m"]
        return max(abs(north), abs(east))


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Eight headings, two frames at each."""
    night = pointed_night(np.random.default_rng(5), a3_sigma_arcsec=0.1, sigma_arcsec=2.0)
    folder = tmp_path_factory.mktemp("pointed")
    whole, bare = [NAMES], [NAMES]
    for p in night.pointings:
        centre = f"{p.mid_unix_s:.6f},{np.degrees(p.ra):.9f},{np.degrees(p.dec):.9f}"
        whole.append(f"{centre},{np.degrees(p.roll):.9f},2,60")
        bare.append(f"{centre},,2,")
    tilts = ["utc_unix_s,theta_x_deg,theta_y_deg"]
    for t in night.tilts:
        x, y = np.degrees(t.theta)
        # two readings around the moment, which has no length
        tilts += [f"{t.utc_unix_s + k},{x:.7f},{y:.7f}" for k in (-0.1, 0.1)]
    (folder / "whole.csv").write_text("\n".join(whole) + "\n")
    (folder / "bare.csv").write_text("\n".join(bare) + "\n")
    (folder / "mixed.csv").write_text("\n".join(whole[:9] + bare[9:]) + "\n")
    (folder / "two.csv").write_text("\n".join([NAMES, *bare[1:3], *bare[5:7]]) + "\n")
    (folder / "one.csv").write_text("\n".join(bare[:3]) + "\n")
    (folder / "tilt.csv").write_text("\n".join(tilts) + "\n")
    return Tables(night, folder)


def test_with_a_roll_each_row_is_a_fix(tables, capsys):
    status, out, errors = run(
        capsys, "solve", *tables.pointings("whole.csv"), *tables.tilt, *AIR, *A3, "--json"
    )
    *each, together = objects(out)
    assert (status, errors, len(each)) == (0, [], 16)
    assert set(together) >= SOLVE_KEYS and all(set(row) >= SOLVE_KEYS for row in each)
    assert each[0]["file"] == f"{tables.folder / 'whole.csv'}:2"
    assert {(row["stars_detected"], row["log_odds"], row["status"]) for row in each} == {(0, None, "ok")}
    assert together["combined"] and tables.sigmas_off(together) < 4
    off = (together["heading"] - np.degrees(tables.night.heading) + 180) % 360 - 180
    assert abs(off) < 4 * together["sigma_heading_deg"] < 0.2


def test_a_table_for_people(tables, capsys):
    status, out, _ = run(capsys, "solve", *tables.pointings("whole.csv"), *tables.tilt, *AIR, *A3)
    assert status == 0 and "whole.csv:2: " in out and "16 frames together" in out and "stars" not in out
    assert out.startswith("file: latitude and longitude")
    status, out, _ = run(capsys, "solve", *tables.pointings("bare.csv"), *tables.tilt, *AIR, *A3)
    assert status == 0 and "deg from the zenith" in out and "nan" not in out
    assert out.startswith("row: the zenith distance")


def test_a3_by_turning_and_at_a_known_place(tables, capsys, tmp_path):
    table, site = tables.pointings("whole.csv"), tables.night.site
    status, out, _ = run(
        capsys,
        "solve",
        *table,
        *tables.tilt,
        *AIR,
        "--self-calibrate",
        "--save",
        tmp_path / "a.yaml",
        *SENSOR,
        "--json",
    )
    assert status == 0 and tables.sigmas_off(objects(out)[-1]) < 4
    place = ("--site", site.latitude_deg, site.longitude_deg)
    status, out, errors = run(
        capsys, "calibrate", *table, *tables.tilt, *AIR, *SENSOR, *place, "-o", tmp_path / "b.yaml"
    )
    assert (status, errors) == (0, []) and "A3 of 16 frames" in out
    for name in ("a.yaml", "b.yaml"):
        assert read(tmp_path / name).calibration.frames == 16
        status, out, errors = run(
            capsys, "solve", *table, *tables.tilt, *AIR, "--instrument", tmp_path / name, "--json"
        )
        assert (status, errors) == (0, []) and tables.sigmas_off(objects(out)[-1]) < 4


def test_elevations_alone_tell_the_place_and_no_heading(tables, capsys):
    status, out, errors = run(
        capsys, "solve", *tables.pointings("bare.csv"), *tables.tilt, *AIR, *A3, "--json"
    )
    *each, together = objects(out)
    assert (status, errors) == (0, [])
    assert {(row["latitude"], row["status"]) for row in each} == {(None, "elevation alone")}
    assert 5 < each[0]["zenith_distance_deg"] < 30
    assert set(together) >= SOLVE_KEYS and (together["frames"], together["poses"]) == (16, 8)
    assert together["heading"] is None and together["sigma_heading_deg"] is None
    assert tables.sigmas_off(together) < 4 and together["sigma_north_m"] < 400


def test_two_directions_need_to_be_told_which_of_two_places(tables, capsys):
    args = ("solve", *tables.pointings("two.csv"), *tables.tilt, *AIR, *A3, "--json")
    status, out, errors = run(capsys, *args)
    assert status == 1 and "two circles meet in two places" in errors[0]
    assert objects(out)[-1]["combined"] and objects(out)[-1]["latitude"] is None
    site = tables.night.site
    status, out, _ = run(capsys, *args, "--near", site.latitude_deg - 1, site.longitude_deg)
    assert status == 0 and tables.sigmas_off(objects(out)[-1]) < 4


def test_rows_without_a_roll_among_others_are_named(tables, capsys):
    status, out, errors = run(
        capsys, "solve", *tables.pointings("mixed.csv"), *tables.tilt, *AIR, *A3, "--json"
    )
    assert status == 0 and objects(out)[-1]["frames"] == 8
    assert len(errors) == 2 and all("no roll" in line for line in errors) and "7 more" in errors[1]


def test_rows_without_a_tilt_are_named(tables, capsys, tmp_path):
    text = (tables.folder / "tilt.csv").read_text().splitlines()
    (tmp_path / "tilt.csv").write_text("\n".join(text[:-4]) + "\n")
    for table in ("whole.csv", "bare.csv"):
        status, out, errors = run(
            capsys, "solve", *tables.pointings(table), "--tilt", tmp_path / "tilt.csv", *AIR, *A3, "--json"
        )
        assert status == 0 and objects(out)[-1]["frames"] == 14
        assert [row["status"] for row in objects(out)].count("no tilt") == 2 and len(errors) == 2


REFUSED = {
    "nothing to work on": (("TILT",), "give either frames or --pointings CSV"),
    "both": (("x.fits", "WHOLE", "TILT"), "not both"),
    "no tilts": (("WHOLE",), "give --tilt CSV"),
    "no such table": (("--pointings", "none.csv", "TILT"), "none.csv: there is no such file"),
    "how near without where": (("WHOLE", "TILT", *A3, "--near-km", "20"), "--near-km is for --near"),
    "near nowhere": (("BARE", "TILT", "--near", "95", "2"), "give latitude and longitude in deg"),
    "processes": (("WHOLE", "TILT", "--jobs", "2"), "--jobs and --pointings do not go together"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bad_call_is_refused_in_a_line(kind, tables, capsys):
    options, words = REFUSED[kind]
    names = {
        "TILT": tables.tilt,
        "WHOLE": tables.pointings("whole.csv"),
        "BARE": tables.pointings("bare.csv"),
    }
    status, out, errors = run(capsys, "solve", *(x for o in options for x in names.get(o, [o])))
    assert (status, out, len(errors)) == (2, "", 1) and words in errors[0]


def test_one_direction_is_no_place(tables, capsys):
    status, _, errors = run(capsys, "solve", *tables.pointings("one.csv"), *tables.tilt, *AIR, *A3)
    assert status == 1 and "in 1 direction do not determine a place" in errors[0]


@pytest.mark.parametrize(
    "a3",
    [("--misalignment", "3.5", "-4", "130", "--misalignment-stddev", "9000"), (), ("--self-calibrate",)],
    ids=["known to 2.5 deg", "not known", "found"],
)
def test_elevations_of_many_directions_determine_a3_too(a3, tables, capsys):
    status, out, errors = run(
        capsys, "solve", *tables.pointings("bare.csv"), *tables.tilt, *AIR, *SENSOR, *a3, "--json"
    )
    together = objects(out)[-1]
    assert status == 0 and any("A3 from the elevations" in line for line in errors)
    assert tables.sigmas_off(together) < 4 and together["sigma_north_m"] < 1000


def test_two_directions_with_an_a3_known_badly_claim_little(tables, capsys):
    near = ("--near", tables.night.site.latitude_deg, tables.night.site.longitude_deg)
    a3 = ("--misalignment", "1.5", "-2", "130", "--misalignment-stddev", "3600")
    status, out, _ = run(
        capsys, "solve", *tables.pointings("two.csv"), *tables.tilt, *AIR, *SENSOR, *a3, *near, "--json"
    )
    assert status == 0 and objects(out)[-1]["sigma_north_m"] > 10_000


def test_elevations_at_a_known_place_calibrate(tables, capsys, tmp_path):
    """An instrument file without a camera: of pointings none is needed."""
    site, found = tables.night.site, tmp_path / "found.yaml"
    given = (
        "starpos_instrument: 1\ninclinometer: {model: sca100t_calibrated}\nmisalignment_deg: [3.5, -4, 130]\n"
    )
    found.write_text(given + "calibration_stddev_arcsec: [9000, 9000, 9000]\n")
    place = ("--site", site.latitude_deg, site.longitude_deg, "-o", found)
    bare = (*tables.pointings("bare.csv"), *tables.tilt, *AIR, "--instrument", found)
    status, out, errors = run(capsys, "calibrate", *bare, *place)
    assert (status, errors) == (0, []) and "A3 of 16 elevations in 8 directions" in out
    assert "camera" not in found.read_text()
    status, out, errors = run(capsys, "solve", *bare, "--json")
    assert status == 0 and tables.sigmas_off(objects(out)[-1]) < 4
    assert objects(out)[-1]["sigma_north_m"] < 1000


def test_frames_still_need_a_camera(capsys, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("starpos_instrument: 1\ninclinometer: {model: scl3300}\n")
    (tmp_path / "tilt.csv").write_text("utc_unix_s,theta_x_deg,theta_y_deg\n1,0,0\n")
    frame = tmp_path / "stars.csv"
    frame.write_text('# {"NAXIS1": 100, "NAXIS2": 100}\nx,y,flux\n1,2,3\n')
    status, _, errors = run(capsys, "solve", frame, "--tilt", tmp_path / "tilt.csv", "--instrument", file)
    assert status == 2 and "camera is missing" in errors[0]


def test_calibrate_refuses_a_camera_from_pointings(tables, capsys, tmp_path):
    out = tmp_path / "camera.yaml"
    status, _, errors = run(capsys, "calibrate", *tables.pointings("whole.csv"), "--camera", out)
    assert status == 2 and "--pointings hold no stars" in errors[0] and not out.exists()
