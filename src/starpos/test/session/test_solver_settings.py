# SPDX-License-Identifier: Apache-2.0
"""What the parameters mean to starpos."""

import math
import struct

import numpy as np
import pytest

from starpos.earth import geoid
from starpos.errors import GeoidError, InstrumentError
from starpos.instrument import sensors
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.parameters.table import defaults_of, parameters_of
from starpos.session.settings import atmosphere_of, check_camera, instrument_of, known_instrument, vertical_of

CAMERA = Camera.from_focal(100, 80, 1000.0)


def values(**changes):
    return defaults_of("solver") | {k.replace("__", "."): v for k, v in changes.items()}


def test_unset_air_widens_the_refraction_and_measured_air_does_not():
    assert atmosphere_of(values()).relative_sigma > 0.08
    known = atmosphere_of(values(refraction__pressure=88000.0, refraction__temperature=12.0))
    assert (known.pressure_pa, known.temperature_c) == (88000.0, 12.0)
    assert known.relative_sigma < 0.01


def test_the_cameras_intrinsics_come_from_camera_info():
    instrument = instrument_of(values(misalignment=(0.1, 0.2, 0.3), misalignment_stddev=7.0), CAMERA, None)
    assert instrument.camera is CAMERA
    sigma = np.sqrt(np.diag(instrument.mounting.calibration_covariance))
    assert sigma == pytest.approx(np.radians(7.0 / 3600))


def test_a_named_inclinometer_has_its_sheets_errors_unless_a_file_states_them():
    named = instrument_of(values(inclinometer__model="SCL3300"), CAMERA, None)
    assert (named.inclinometer, named.inclinometer_model) == (sensors.presets()["scl3300"], "scl3300")
    assert instrument_of(values(), CAMERA, None).inclinometer == sensors.unnamed()
    known = Instrument(1000.0, inclinometer=InclinometerErrors(scale=0.01))
    of_file = instrument_of(values(inclinometer__model="scl3300"), CAMERA, known)
    assert (of_file.inclinometer, of_file.inclinometer_model) == (known.inclinometer, "")
    with pytest.raises(
        InstrumentError, match="'x' is not known: the models are sca100t, sca100t_calibrated, scl3300"
    ):
        instrument_of(values(inclinometer__model="x"), CAMERA, None)


def test_an_instrument_file_is_read_and_the_camera_replaced(tmp_path):
    path = tmp_path / "instrument.yaml"
    path.write_text(
        "starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\nmisalignment_deg: [1, 2, 3]\n"
        "calibration_stddev_arcsec: [1, 1, 1]\n"
    )
    known = known_instrument(f"file://{path}")
    instrument = instrument_of(values(), CAMERA, known)
    assert instrument.calibration.misalignment_deg == (1.0, 2.0, 3.0)
    assert instrument.camera is CAMERA
    assert instrument.clock_stddev_s == known.clock_stddev_s
    # a parameter that is set wins
    assert instrument_of(values(clock_stddev=2.0), CAMERA, known).clock_stddev_s == 2.0
    assert instrument_of(values(tilt_stddev=1.0), CAMERA, known).inclinometer.noise_rad == pytest.approx(
        math.radians(1)
    )


def test_what_frames_have_told_wins_over_file_and_parameters():
    found = Calibration.of((3.0, 2.0, 1.0), (1.0,) * 3)
    for known in (None, Instrument(1000.0)):
        for mode in (False, True):
            assert instrument_of(values(self_calibration=mode), CAMERA, known, found).calibration == found


def test_in_self_calibration_the_misalignment_is_unknown():
    given = values(self_calibration=True, misalignment=(1.0, 2.0, 3.0))
    calibration = instrument_of(given, CAMERA, None).calibration
    assert calibration.misalignment_deg == (1.0, 2.0, 3.0)
    assert np.sqrt(np.diag(calibration.covariance_arcsec2)).min() >= 36000


def test_an_instrument_file_of_another_camera_is_told_by_its_focal_length():
    check_camera(None, "", CAMERA)
    for factor in (0.96, 1.0, 1.04):
        check_camera(Instrument(1000.0 * factor), "a.yaml", CAMERA)
    for factor in (0.1, 0.94, 1.06):
        with pytest.raises(InstrumentError, match=r"a\.yaml.*another camera"):
            check_camera(Instrument(1000.0 * factor), "a.yaml", CAMERA)
    check_camera(Instrument(1000.0, frame_size=(CAMERA.width, CAMERA.height)), "a.yaml", CAMERA)
    with pytest.raises(InstrumentError, match=r"a\.yaml.*A3 was found with frames of 90 x 60 px"):
        check_camera(Instrument(1000.0, frame_size=(90, 60)), "a.yaml", CAMERA)


def test_a_broken_instrument_file_is_refused_with_its_path(tmp_path):
    with pytest.raises(InstrumentError, match=r"missing\.yaml"):
        known_instrument(str(tmp_path / "missing.yaml"))


def test_the_altitude_says_which_one_it_is():
    [altitude] = (p for p in parameters_of("solver") if p.name == "altitude")
    assert "above the WGS 84 ellipsoid" in altitude.description


def test_the_deflection_defaults_to_knowing_nothing():
    d = vertical_of(values(), None).at(math.radians(45), 0.0)
    assert d.stddev_arcsec > 1
    assert not math.isnan(d.xi_arcsec)


def test_a_deflection_is_given_by_hand_or_by_a_geoid(tmp_path):
    path = tmp_path / "slope.gtx"
    # 1 m a degree to the north.
    heights = np.broadcast_to(np.arange(30)[:, None], (30, 40))
    path.write_bytes(struct.pack(">4d2i", 30, 40, 1, 1, *heights.shape) + heights.astype(">f4").tobytes())
    grid = geoid.read(str(path))
    there = vertical_of(values(), grid).at(math.radians(45), math.radians(60))
    higher = vertical_of(values(altitude=3000.0), grid).at(math.radians(45), math.radians(60))
    assert higher.xi_arcsec - there.xi_arcsec == pytest.approx(3 * 0.171, abs=0.01)
    assert there.xi_arcsec == pytest.approx(-1 / 111132 / math.radians(1 / 3600), rel=1e-3)
    with pytest.raises(GeoidError, match=r"deflection\.xi"):
        vertical_of(values(deflection__xi=3.0), grid)
    assert vertical_of(values(deflection__eta=3.0), None).eta_arcsec == 3.0


def test_a_broken_geoid_is_refused_with_its_path(tmp_path):
    with pytest.raises(GeoidError, match=r"missing\.gtx"):
        geoid.read(str(tmp_path / "missing.gtx"))
