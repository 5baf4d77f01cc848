# SPDX-License-Identifier: Apache-2.0
"""What the parameters mean to starpos."""

import math
import struct

import numpy as np
import pytest

from starpos.earth import geoid
from starpos.errors import GeoidError, InstrumentError
from starpos.instrument import instrument_file, sensors
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.parameters.table import defaults_of, parameters_of
from starpos.session.settings import Settings

CAMERA = Camera.from_focal(100, 80, 1000.0)


def settings(known=None, grid=None, **changes):
    """Settings with an instrument file and a geoid, as they were read."""
    values = defaults_of("solver") | {k.replace("__", "."): v for k, v in changes.items()}
    return Settings(values, {"calibration_url": known, "deflection.geoid": grid})


def instrument_of(known=None, found=None, **changes):
    return settings(known, **changes).instrument(found, CAMERA)


def test_unset_air_widens_the_refraction_and_measured_air_does_not():
    assert settings().atmosphere.relative_sigma > 0.08
    known = settings(refraction__pressure=88000.0, refraction__temperature=12.0).atmosphere
    assert (known.pressure_pa, known.temperature_c) == (88000.0, 12.0)
    assert known.relative_sigma < 0.01


def test_the_cameras_intrinsics_come_from_camera_info():
    instrument = instrument_of(misalignment=(0.1, 0.2, 0.3), misalignment_stddev=7.0)
    assert instrument.camera is CAMERA
    sigma = np.sqrt(np.diag(instrument.calibration.covariance))
    assert sigma == pytest.approx(np.radians(7.0 / 3600))


def test_a_named_inclinometer_has_its_sheets_errors_unless_a_file_states_them():
    named = instrument_of(inclinometer__model="SCL3300")
    assert (named.inclinometer, named.inclinometer_model) == (sensors.presets()["scl3300"], "scl3300")
    assert instrument_of().inclinometer == sensors.unnamed()
    known = Instrument(1000.0, inclinometer=InclinometerErrors(scale=0.01))
    of_file = instrument_of(known, inclinometer__model="scl3300")
    assert (of_file.inclinometer, of_file.inclinometer_model) == (known.inclinometer, "")
    with pytest.raises(
        InstrumentError, match="'x' is not known: the models are sca100t, sca100t_calibrated, scl3300"
    ):
        instrument_of(inclinometer__model="x")


def test_an_instrument_file_is_read_and_the_camera_replaced(tmp_path):
    path = tmp_path / "instrument.yaml"
    path.write_text(
        "starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\nmisalignment_deg: [1, 2, 3]\n"
        "calibration_stddev_arcsec: [1, 1, 1]\n"
    )
    of_file = Settings.of(given=(f"calibration_url:=file://{path}",))
    instrument, known = of_file.instrument(None, CAMERA), instrument_file.read(path)
    assert instrument.calibration.misalignment_deg == (1.0, 2.0, 3.0)
    assert instrument.camera is CAMERA
    assert instrument.clock_stddev_s == known.clock_stddev_s
    # a parameter that is set wins
    assert instrument_of(known, clock_stddev=2.0).clock_stddev_s == 2.0
    assert instrument_of(known, tilt_stddev=1.0).inclinometer.noise_rad == pytest.approx(math.radians(1))


def test_what_frames_have_told_wins_over_file_and_parameters():
    found = Calibration.of((3.0, 2.0, 1.0), (1.0,) * 3)
    for known in (None, Instrument(1000.0)):
        for mode in (False, True):
            assert instrument_of(known, found, self_calibration=mode).calibration == found


def test_in_self_calibration_the_misalignment_is_unknown():
    calibration = instrument_of(self_calibration=True, misalignment=(1.0, 2.0, 3.0)).calibration
    assert calibration.misalignment_deg == (1.0, 2.0, 3.0)
    assert np.sqrt(np.diag(calibration.covariance_arcsec2)).min() >= 36000


def test_an_instrument_file_of_another_camera_is_told_by_its_focal_length():
    def check(known):
        settings(known, calibration_url="a.yaml").check_camera(CAMERA)

    check(None)
    for factor in (0.96, 1.0, 1.04):
        check(Instrument(1000.0 * factor))
    for factor in (0.1, 0.94, 1.06):
        with pytest.raises(InstrumentError, match=r"a\.yaml.*another camera"):
            check(Instrument(1000.0 * factor))
    check(Instrument(1000.0, frame_size=(CAMERA.width, CAMERA.height)))
    with pytest.raises(InstrumentError, match=r"a\.yaml.*A3 was found with frames of 90 x 60 px"):
        check(Instrument(1000.0, frame_size=(90, 60)))


def test_a_broken_instrument_file_is_refused_with_its_path(tmp_path):
    with pytest.raises(InstrumentError, match=r"missing\.yaml"):
        Settings.of(given=(f"calibration_url:={tmp_path}/missing.yaml",))


def test_the_altitude_says_which_one_it_is():
    [altitude] = (p for p in parameters_of("solver") if p.name == "altitude")
    assert "above the WGS 84 ellipsoid" in altitude.description


def test_the_deflection_defaults_to_knowing_nothing():
    d = settings().vertical.at(math.radians(45), 0.0)
    assert d.stddev_arcsec > 1
    assert not math.isnan(d.xi_arcsec)


def test_a_deflection_is_given_by_hand_or_by_a_geoid(tmp_path):
    path = tmp_path / "slope.gtx"
    # 1 m a degree to the north.
    heights = np.broadcast_to(np.arange(30)[:, None], (30, 40))
    path.write_bytes(struct.pack(">4d2i", 30, 40, 1, 1, *heights.shape) + heights.astype(">f4").tobytes())
    grid = geoid.read(str(path))
    there = settings(grid=grid).vertical.at(math.radians(45), math.radians(60))
    higher = settings(grid=grid, altitude=3000.0).vertical.at(math.radians(45), math.radians(60))
    assert higher.xi_arcsec - there.xi_arcsec == pytest.approx(3 * 0.171, abs=0.01)
    assert there.xi_arcsec == pytest.approx(-1 / 111132 / math.radians(1 / 3600), rel=1e-3)
    with pytest.raises(GeoidError, match=r"deflection\.xi"):
        assert settings(grid=grid, deflection__xi=3.0).vertical is None
    assert settings(deflection__eta=3.0).vertical.eta_arcsec == 3.0


def test_a_broken_geoid_is_refused_with_its_path(tmp_path):
    with pytest.raises(GeoidError, match=r"missing\.gtx"):
        geoid.read(str(tmp_path / "missing.gtx"))
