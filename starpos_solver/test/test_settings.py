# SPDX-License-Identifier: Apache-2.0
"""The solver's parameters with the files they name, on a real node."""

import math

import pytest
import rclpy
from rclpy.parameter import Parameter

from starpos.instrument import instrument_file, sensors
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.session.settings import Settings
from starpos_solver.driver import declared
from starpos_testing.nodes import take_domain

CAMERA = Camera.from_focal(1000, 800, 2000.0)


@pytest.fixture
def make():
    take_domain()
    context, nodes = rclpy.Context(), []
    rclpy.init(context=context)

    def make(**given):
        overrides = [Parameter(name, value=value) for name, value in given.items()]
        nodes.append(rclpy.create_node("settings", context=context, parameter_overrides=overrides))
        applied = []
        settings = Settings({})
        settings.camera = CAMERA
        declared(nodes[-1], "solver", settings, applied.append)
        return nodes[-1], settings, applied

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def change(node, **values):
    return node.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])


def test_a_file_is_read_again_when_it_is_set_again_and_a_broken_one_changes_nothing(make, tmp_path):
    path = tmp_path / "instrument.yaml"
    instrument_file.write(path, Instrument(2000.0, clock_stddev_s=0.5))
    node, settings, applied = make(calibration_url=str(path))

    def clock_s():
        return settings.solver(CAMERA, None, None).instrument.clock_stddev_s

    assert clock_s() == 0.5
    path.write_text("broken: [")
    # It is not looked at.
    assert change(node, min_stars=6).successful and clock_s() == 0.5
    result = change(node, calibration_url=str(path))
    assert not result.successful and "instrument.yaml" in result.reason and clock_s() == 0.5
    instrument_file.write(path, Instrument(2000.0, clock_stddev_s=0.25))
    assert change(node, calibration_url=str(path)).successful and clock_s() == 0.25
    assert applied == [{"min_stars"}, {"calibration_url"}]
    path.unlink()
    result = change(node, calibration_url=str(path), min_stars=7)
    # All or none.
    assert not result.successful and clock_s() == 0.25 and settings.values["min_stars"] == 6


def test_the_model_of_the_inclinometer_is_its_noise_until_one_is_stated(make):
    node, settings, _ = make()
    assert math.degrees(settings.tilt_stddev_rad) == pytest.approx(0.0035)
    assert change(node, **{"inclinometer.model": "bmi088"}).successful
    assert settings.tilt_stddev_rad == sensors.presets()["bmi088"].noise_rad
    result = change(node, **{"inclinometer.model": "bmi"})
    assert not result.successful and "'bmi' is not known" in result.reason
    assert change(node, tilt_stddev=0.01).successful
    assert math.degrees(settings.tilt_stddev_rad) == pytest.approx(0.01)


def test_a_file_of_another_camera_is_refused_when_it_is_set(make, tmp_path):
    instrument_file.write(tmp_path / "other.yaml", Instrument(3000.0))
    node, settings, _ = make()
    result = change(node, calibration_url=f"file://{tmp_path}/other.yaml")
    assert not result.successful and "of another camera" in result.reason
    assert settings.values["calibration_url"] == ""


def test_a_misalignment_without_its_error_is_not_known(make):
    _, nobody, _ = make(misalignment=[1.0, 2.0, 3.0])
    assert nobody.instrument(None).calibration.unknown
    _, known, _ = make(misalignment=[1.0, 2.0, 3.0], misalignment_stddev=5.0)
    assert not known.instrument(None).calibration.unknown
