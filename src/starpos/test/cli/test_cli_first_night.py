# SPDX-License-Identifier: Apache-2.0
"""`starpos first-night`: from nothing to a saved A3, what it says on the way, and what it refuses."""

import shutil
from itertools import pairwise

import numpy as np
import pytest

from starpos.instrument import instrument_file
from starpos.night import field
from starpos_testing.skies.first_night import A3_DEG, Stand, arriving, usual

BEGIN_S = 1.79e9
TEN_MINUTES_S = 600.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a whole first night, and how long it took (s)."""
    folder = tmp_path_factory.mktemp("first")
    *_, end_s = arriving(folder, 1, BEGIN_S, usual())
    return folder, end_s - BEGIN_S


@pytest.fixture
def first_night(run, tmp_path):
    def call(folder, *more):
        out = tmp_path / "mine.yaml"
        return run("first-night", folder, "--save", out, "--patience", "0", *more), out

    return call


def test_from_nothing_to_a_saved_a3_in_ten_minutes(first_night, whole, tmp_path):
    folder, took_s = whole
    assert took_s < TEN_MINUTES_S
    (status, said, _), out = first_night(
        folder, "--inclinometer", "sca100t_calibrated", "--field", tmp_path / "night.zip"
    )
    assert status == 0
    calibration = instrument_file.read(out).calibration
    off_arcsec = 3600 * np.subtract(calibration.misalignment_deg, A3_DEG)
    sigma_arcsec = np.sqrt(np.diag(calibration.covariance_arcsec2))
    assert (np.abs(off_arcsec) < 4 * sigma_arcsec).all() and sigma_arcsec[:2].max() < 400
    assert field.is_field(tmp_path / "night.zip")
    done = [line.split()[2] for line in said.splitlines() if " ok " in line and line.split()[2] != "clock"]
    assert done == ["focus", "exposure", "level", "horizon", "turn"]
    # each frame's line is followed by what to do
    assert all(
        after.strip().startswith("->") for line, after in pairwise(said.splitlines()) if " .. " in line
    )


def test_stopped_it_goes_on_where_it_was(first_night, tmp_path):
    night = arriving(tmp_path, 2, BEGIN_S, usual())
    for _ in range(16):
        next(night)
    (status, first, complaint), out = first_night(tmp_path)
    assert status == 1 and "the same command goes on" in complaint[0] and not out.exists()
    for _ in night:
        pass
    (status, second, _), out = first_night(tmp_path)
    assert status == 0 and second.startswith(first[: first.index("clock")]) and out.exists()


def test_a_level_with_a_wrong_sign_is_found_by_the_leans(first_night, tmp_path):
    for _ in arriving(tmp_path, 3, BEGIN_S, usual(), mirrored=True):
        pass
    (status, said, _), out = first_night(tmp_path)
    assert status == 1 and "the level is mirrored" in said and not out.exists()


def test_stars_out_of_focus_and_too_few_get_no_further(first_night, tmp_path):
    for _ in arriving(tmp_path, 4, BEGIN_S, [Stand(4, fwhm_px=7.0)]):
        pass
    (_, said, _), _ = first_night(tmp_path)
    assert said.count("turn the focus ring") == 4 and "exposure" not in said


def test_a_folder_that_is_not_there_is_a_sentence(first_night, tmp_path):
    (status, _, complaint), _ = first_night(tmp_path / "none")
    assert status == 2 and "there is no such folder" in complaint[0]


def test_a_level_that_repeats_one_value_gets_no_further(first_night, whole, tmp_path):
    folder = shutil.copytree(whole[0], tmp_path / "frozen")
    head, first, *rest = (folder / "tilt.csv").read_text().splitlines()
    same = first.split(",")[1:]
    rows = [",".join([row.split(",")[0], *same]) for row in rest]
    (folder / "tilt.csv").write_text("\n".join([head, first, *rows]) + "\n")
    (status, said, _), out = first_night(folder)
    assert status == 1 and "does not measure" in said and not out.exists()


def test_headings_that_hardly_determine_a3_write_no_file(first_night, whole, monkeypatch):
    monkeypatch.setattr("starpos.night.first_night.worth_saving", lambda turned: False)
    (status, said, complaint), out = first_night(whole[0])
    assert status == 1 and "turn on, to other headings" in said and not out.exists()
    assert "A3 is not known yet" in complaint[0]
