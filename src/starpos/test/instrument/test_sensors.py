# SPDX-License-Identifier: Apache-2.0
"""The inclinometers with a name: sound figures, taken where a file leaves them out, and nowhere else."""

import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from starpos.cli import main
from starpos.errors import InstrumentError
from starpos.instrument import instrument_file, sensors
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Instrument
from starpos_testing.command_line import A3

SIMPLE = "starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\n"
ARCSEC = np.pi / 648000
DOCUMENT = Path(__file__).parents[4] / "docs" / "sensors.md"
# deg: least and largest noise of one reading, and the range, of the class that each sheet claims
CLASS = {
    "sca100t": (0.002, 0.005, 30),
    "sca100t_calibrated": (0.002, 0.005, 90),
    "scl3300": (0.001, 0.02, 90),
    "adis16209": (0.002, 0.1, 30),
    "nivel210": (1e-5, 1e-3, np.degrees(1.51e-3)),
    "bmi088": (0.01, 0.1, 90),
    "sca3300": (0.01, 0.03, 90),
    "adxl355": (0.005, 0.02, 90),
    "phone": (0.05, 0.1, 90),
    "camera_level": (0.05, 0.2, 90),
}


@pytest.fixture
def reads(tmp_path):
    def of(text):
        path = tmp_path / "instrument.yaml"
        path.write_text(SIMPLE + text)
        return instrument_file.read(path)

    return of


@pytest.mark.parametrize("name", sensors.presets())
def test_a_preset_is_of_its_class(name):
    errors = sensors.presets()[name]
    least, most, reach = CLASS[name]
    assert least <= np.degrees(errors.noise_rad) <= most
    assert np.degrees(errors.range_rad) == pytest.approx(reach)
    # what a calibration has taken away is 0
    assert name == "sca100t_calibrated" or all(value > 0 for value in asdict(errors).values())
    # no error is as large as what it is an error of
    assert max(errors.quantum_rad, errors.pose_rad) < errors.range_rad / 50
    # an ADXL355 leaves the factory within 8 %
    assert errors.scale < (0.05 if name == "adxl355" else 0.01) and errors.cross < 0.03
    assert errors.temperature_rad_per_c < 40 * ARCSEC and errors.drift_rad_per_sqrt_hour < 40 * ARCSEC


def test_the_sheets_rules_in_figures():
    # ADIS16209: 0.19 mg/sqrt(Hz) through its sensor's 50 Hz are the 1.7 mg that it states too
    adis = {"value": "0.19", "unit": "mg", "over": "", "rule": "density", "hz": "50"}
    assert sensors._sigma(adis) == pytest.approx(1.7e-3, rel=0.02)
    within = np.random.default_rng(1).uniform(-1, 1, 100_000).std()
    assert sensors._sigma(adis | {"value": "1", "rule": "limit"}) == pytest.approx(within * 1e-3, rel=0.01)
    assert np.degrees(sensors.presets()["scl3300"].pose_rad) == pytest.approx(0.019, abs=5e-4)


@pytest.mark.skipif(not DOCUMENT.exists(), reason="installed without the documents")
@pytest.mark.parametrize("name", sensors.presets())
def test_the_document_has_the_figures_of_the_code(name):
    e = sensors.presets()[name]
    (row,) = re.findall(rf"^\| `{name}` \|(.*)\|$", DOCUMENT.read_text(), re.MULTILINE)
    told = [float(cell) for cell in row.split("|")]
    known = [
        *np.array([e.noise_rad, e.quantum_rad, e.drift_rad_per_sqrt_hour, e.temperature_rad_per_c]) / ARCSEC,
        100 * e.scale,
        100 * e.cross,
        e.pose_rad / ARCSEC,
        np.degrees(e.range_rad),
    ]
    assert told == pytest.approx(known, rel=0.03)


@pytest.mark.parametrize("name", sensors.presets())
def test_a_file_that_names_only_its_model_has_the_models_errors(name, reads):
    i = reads(f"inclinometer: {{model: {name.upper()}}}\n")
    assert (i.inclinometer, i.inclinometer_model) == (sensors.presets()[name], name)


def test_the_model_fills_what_the_file_leaves_out_and_nothing_else(reads):
    i = reads("inclinometer: {model: scl3300}\ntilt_pose_arcsec: 20\ntilt_scale: 0\nclock_stddev_s: 0.5\n")
    assert i.inclinometer == replace(sensors.presets()["scl3300"], pose_rad=20 * ARCSEC, scale=0.0)
    assert i == Instrument(
        93750.0, inclinometer=i.inclinometer, inclinometer_model="scl3300", clock_stddev_s=0.5
    )


def test_a_file_without_a_model_has_what_it_states_and_the_defaults(reads):
    i = reads("tilt_pose_arcsec: 20\n")
    assert (i.inclinometer, i.inclinometer_model) == (InclinometerErrors(pose_rad=20 * ARCSEC), "")


def test_a_written_model_and_every_figure_is_read_again(tmp_path):
    errors = replace(sensors.presets()["nivel210"], pose_rad=7 * ARCSEC)
    told = Instrument(5000.0, inclinometer=errors, inclinometer_model="nivel210")
    instrument_file.write(tmp_path / "i.yaml", told)
    text = (tmp_path / "i.yaml").read_text()
    assert "model: nivel210" in text and all(key in text for key in instrument_file.INCLINOMETER)
    again = instrument_file.read(tmp_path / "i.yaml")
    assert again.inclinometer_model == "nivel210"
    assert list(asdict(again.inclinometer).values()) == pytest.approx(
        list(asdict(errors).values()), rel=1e-14
    )
    instrument_file.write(tmp_path / "again.yaml", again)
    assert (tmp_path / "again.yaml").read_text() == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "inclinometer: {model: scl9900}",
            f"'scl9900' is not known: the models are {', '.join(sensors.presets())}",
        ),
        ("inclinometer: scl3300", "give {model: NAME}"),
        ("inclinometer: {model: 3300}", "give {model: NAME}"),
        ("inclinometer: {model: scl3300, axes: 3}", "unknown key 'axes'"),
        ("inclinometer:", "inclinometer is missing: give {model: NAME}"),
    ],
)
def test_what_names_no_model_is_refused_in_a_sentence(text, said, reads):
    with pytest.raises(InstrumentError, match=r"instrument\.yaml: ") as refused:
        reads(text + "\n")
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_the_command_line_takes_a_model_or_a_file(tmp_path, capsys):
    night = tmp_path / "night"
    optics = ("--focal-mm", "600", "--pixel-um", "6.4")
    assert main(["simulate", str(night), "--stars-only", "-n", "1", "--seed", "3"]) == 0
    frame, table = str(night / "stars_0000.csv"), str(night / "tilt.csv")
    solve = ["solve", frame, "--tilt", table]

    def sigma_m(*options):
        assert main([*solve, *optics, *A3, *options]) == 0
        return float(re.search(r"\+- (\d+) m", capsys.readouterr().out).group(1))

    assert sigma_m("--inclinometer", "SCL3300") > 3 * sigma_m()
    path = tmp_path / "i.yaml"
    path.write_text(SIMPLE)
    for options, said in (
        ((*optics, "--inclinometer", "abc"), "model 'abc' is not known"),
        (("--instrument", str(path), "--inclinometer", "scl3300"), "give either it or the options"),
    ):
        assert main([*solve, *options]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
