# SPDX-License-Identifier: Apache-2.0
"""`starpos doctor`: it says what is there and what is missing on any machine, and its exit status is true."""

import json
import os

import pytest

from starpos import system_clock
from starpos.cli import doctor
from starpos.earth import orientation
from starpos.system_clock import SystemClock
from starpos.units import unix_of


@pytest.fixture
def found(run, monkeypatch, tmp_path):
    """Run the doctor: exit status, and what it found by check."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def ask(*options):
        status, out, errors = run("doctor", "--json", *options)
        assert errors == []
        return status, {f["check"]: f for f in map(json.loads, out.splitlines())}

    return ask


def test_where_all_is_there_that_solve_needs_the_status_is_0(found, run):
    status, checks = found()
    assert status == 0
    assert set(checks) >= {
        "starpos",
        "packages",
        "star catalogue",
        "cache",
        "clock",
        "serial ports",
        "cameras",
    }
    assert "943022 stars" in checks["star catalogue"]["found"]
    assert "measured until" in checks["Earth rotation"]["found"]
    status, out, _ = run("doctor")
    assert status == 0 and out.count("\n") >= len(checks) and "numpy" in out


def test_a_missing_package_is_missing_and_the_other_checks_go_on(found, monkeypatch):
    real = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in ("yaml", "rawpy") else real(name))
    status, checks = found()
    assert status == 1
    assert (checks["packages"]["state"], checks["packages"]["cure"]) == ("MISSING", "pip install PyYAML")
    assert checks["optional"]["state"] == "note" and " rawpy" in checks["optional"]["cure"]
    assert checks["cache"]["state"] == "ok"


def test_a_catalogue_that_is_not_there_and_a_cache_that_cannot_be_written(found, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("STARPOS_CATALOGUE", str(tmp_path / "none.npz"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    status, checks = found()
    assert status == 1
    assert "none.npz" in checks["star catalogue"]["found"]
    assert checks["cache"]["state"] == "MISSING" and "XDG_CACHE_HOME" in checks["cache"]["cure"]


@pytest.mark.parametrize(("options", "state", "status"), [((), "note", 0), (("--live",), "MISSING", 1)])
def test_a_clock_that_nothing_keeps_is_missing_for_a_live_instrument(
    found, monkeypatch, options, state, status
):
    monkeypatch.setattr(system_clock, "read", lambda: SystemClock(False, 16.0, 16.0))
    exit_status, checks = found(*options)
    assert (checks["clock"]["state"], exit_status) == (state, status)
    assert "chrony" in checks["clock"]["cure"]


def test_an_iers_table_whose_predictions_have_ended_is_noted(monkeypatch):
    last = orientation.measured_until()
    monkeypatch.setattr(doctor.time, "time", lambda: last + 100 * doctor.DAY_S)
    assert doctor.earth_rotation().state is doctor.State.OK
    monkeypatch.setattr(doctor.time, "time", lambda: last + 600 * doctor.DAY_S)
    finding = doctor.earth_rotation()
    assert finding.state is doctor.State.NOTE and "600 days ago" in finding.found
    assert "astropy-iers-data" in finding.cure
    assert unix_of("2026-01-01") < last


def test_devices_are_named_and_one_that_may_not_be_opened(tmp_path, monkeypatch):
    assert "no inclinometer" in doctor.serial_ports(tmp_path).found
    assert doctor.cameras(tmp_path).state is doctor.State.NOTE
    for path, text in {
        "dev/ttyUSB0": "",
        "dev/video0": "",
        "sys/class/video4linux/video0/name": "Sky Cam\n",
        "sys/bus/usb/devices/1-2/product": "EOS 6D\n",
        "sys/bus/usb/devices/1-2/1-2:1.0/bInterfaceClass": "06\n",
    }.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/serial/by-id/usb-tilt").symlink_to(tmp_path / "dev/ttyUSB0")
    monkeypatch.setattr(doctor, "find_spec", lambda _: True)
    port = doctor.serial_ports(tmp_path)
    assert (
        port.state is doctor.State.OK
        and port.found.endswith("by-id/usb-tilt")
        and "ttyUSB0" not in port.found
    )
    camera = doctor.cameras(tmp_path)
    assert "video0 (Sky Cam)" in camera.found and "EOS 6D (photo, USB)" in camera.found
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "usermod -aG dialout" in doctor.serial_ports(tmp_path).cure
