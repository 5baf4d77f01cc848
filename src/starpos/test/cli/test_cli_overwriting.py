# SPDX-License-Identifier: Apache-2.0
"""What the command line writes never replaces what it did not make, and is refused before the work."""

import pytest
from cli_calls import AIR, WIDE

from starpos.instrument import instrument_file

SITE = ("--site", "47.3", "-122.8")
PERSONS = {"remounted_arcsec: 300": "remounted_arcsec", "clock_stddev_s: 0.007": "clock_stddev_s"}


def calls(folder, out):
    """The calls that write `out`, by their option."""
    frames, tilts = sorted(folder.glob("stars_*.csv")), ("--tilt", folder / "tilt.csv")
    return {
        "-o": ("calibrate", *frames, *tilts, *WIDE, *AIR, *SITE, "-o", out),
        "--camera": ("calibrate", *frames, *tilts, *WIDE, *AIR, "--camera", out),
        "--map": ("calibrate", *frames, *tilts, *WIDE, *AIR, "--camera", f"{out}.new", "--map", out),
        "--save": ("solve", *frames, *tilts, *WIDE, *AIR, "--self-calibrate", "--save", out),
        "--out": ("catalogue", "build", "--gaia", folder / "tilt.csv", "--out", out),
    }


OPTIONS = ("-o", "--camera", "--map", "--save", "--out")


@pytest.mark.parametrize("option", OPTIONS)
def test_a_file_of_somebody_else_stays(option, lists, run, tmp_path):
    out = tmp_path / "precious.png"
    out.write_text("precious")
    status, said, errors = run(*calls(lists, out)[option])
    assert (status, said, out.read_text()) == (2, "", "precious")
    assert (
        "precious.png: it is there already" in errors[-1] and "move it away, or give another -" in errors[-1]
    )
    assert [p.name for p in tmp_path.iterdir()] == ["precious.png"]


def test_no_picture_replaces_an_instrument_file_of_starpos(lists, run, tmp_path):
    mine = tmp_path / "mine.yaml"
    assert run(*calls(lists, mine)["-o"])[0] == 0
    before = mine.read_bytes()
    status, _, errors = run(*calls(lists, mine)["--map"])
    assert status == 2 and "not a picture" in errors[-1] and mine.read_bytes() == before


@pytest.mark.parametrize("name", ["tilt.csv", "stars_0000.csv"])
@pytest.mark.parametrize("option", ["-o", "--camera", "--map", "--save"])
def test_what_is_read_is_never_written(option, name, lists, run, tmp_path):
    before = {p: p.read_bytes() for p in lists.iterdir()}
    link = tmp_path / "link"
    link.symlink_to(lists / name)
    for out in (lists / name, link):
        status, _, errors = run(*calls(lists, out)[option])
        assert status == 2 and "would replace what is read" in errors[-1]
    assert {p: p.read_bytes() for p in lists.iterdir()} == before


def test_two_options_of_one_call_write_two_files(lists, run, tmp_path):
    out = tmp_path / "a.yaml"
    status, _, errors = run(*calls(lists, out)["-o"], "--camera", tmp_path / "." / "a.yaml")
    assert status == 2 and "two options would write it" in errors[-1] and not out.exists()


def test_a_camera_and_its_map_are_replaced_until_somebody_changes_them(lists, run, tmp_path):
    camera, picture = tmp_path / "c.yaml", tmp_path / "m.png"
    both = (*calls(lists, camera)["--camera"], "--map", picture)
    assert run(*both)[0] == run(*both)[0] == 0
    camera.write_text(camera.read_text().replace("camera_name: camera", "camera_name: mine"))
    changed = camera.read_bytes()
    status, _, errors = run(*both)
    assert status == 2 and "did not write it in this form" in errors[-1] and camera.read_bytes() == changed


def test_calibrating_again_keeps_what_a_person_wrote_into_the_instrument_file(lists, run, tmp_path):
    out = tmp_path / "mine.yaml"
    again = calls(lists, out)["-o"]
    assert run(*again)[0] == 0
    first = instrument_file.read(out)
    own = out.read_text().replace("clock_stddev_s: 0.1\n", "")
    out.write_text(own + "".join(f"{line}\n" for line in PERSONS))
    status, _, errors = run(*again, "--valid-days", 7)
    assert status == 0 and "keeps remounted_arcsec: 300" in errors[-1]
    kept = instrument_file.read(out)
    assert (kept.calibration.remounted_arcsec, kept.clock_stddev_s) == (300, 0.007)
    assert (first.calibration.valid_days, kept.calibration.valid_days) == (365, 7)
    # by the instrument file itself, too
    of_file = [*again[: again.index("--focal-mm")], *AIR, *SITE, "--instrument", out, "-o", out]
    assert run(*of_file)[0] == 0
    assert instrument_file.read(out).calibration.remounted_arcsec == 300


@pytest.mark.parametrize("where", ["# mine\n{}", "{}# mine\n", "{}remounted_arcsec: 3 # a plate\n"])
@pytest.mark.parametrize("option", ["-o", "--save"])
def test_a_comment_in_the_instrument_file_is_not_lost(option, where, lists, run, tmp_path):
    out = tmp_path / "mine.yaml"
    assert run(*calls(lists, out)["-o"])[0] == 0
    out.write_text(where.format(out.read_text()))
    before = out.read_bytes()
    status, _, errors = run(*calls(lists, out)[option])
    assert status == 2 and "a comment, which would be lost" in errors[-1] and out.read_bytes() == before


def test_an_instrument_file_of_another_camera_or_sensor_stays(lists, run, tmp_path):
    out = tmp_path / "mine.yaml"
    assert run(*calls(lists, out)["-o"], "--inclinometer", "scl3300")[0] == 0
    before = out.read_bytes()
    for options, what in (
        (("--focal-mm", "29.9"), "another camera"),
        (("--inclinometer", "sca100t"), "another inclinometer"),
    ):
        for option in ("-o", "--save"):
            status, _, errors = run(*calls(lists, out)[option], *options)
            assert status == 2 and what in errors[-1] and f"--instrument {out}" in errors[-1]
    fixed = [a for a in calls(lists, out)["-o"] if a not in ("--tilt", lists / "tilt.csv")]
    status, _, errors = run(*fixed, "--fixed")
    assert status == 2 and "with an inclinometer" in errors[-1]
    assert out.read_bytes() == before
