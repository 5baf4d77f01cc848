# SPDX-License-Identifier: Apache-2.0
"""Logs of telephones: the same lean as the apps write it, on iOS and on Android."""

import json
import struct
import zipfile

import numpy as np
import pytest

from starpos.errors import TiltError
from starpos.instrument import phone_log
from starpos.instrument.tilt_table import read_tilt_csv

START = 1_667_857_268.0
# the specific force of a telephone whose back camera looks up, leaning
UP = np.array([0.2, 0.5, -np.sqrt(1 - 0.29)])
IN_CAMERA = np.degrees(np.arcsin([-0.5, -0.2, np.sqrt(1 - 0.29)]))
AT = START + 0.02 * np.arange(200)


def logger(sign, unit=9.80665):
    """A table as Sensor Logger writes it."""
    x, y, z = sign * unit * UP
    rows = "".join(f"{round(t * 1e9)},{t - START:.2f},{z},{y},{x}\n" for t in AT)
    return f"time,seconds_elapsed,z,y,x\n{rows}"


def metadata(platform, standardisation):
    return f"version,platform,standardisation\n3,{platform},{standardisation}\n"


def zipped(path, **files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, text in files.items():
            file.writestr(name.replace("__", "/") + ".csv", text)
    return path


def degrees(log):
    assert log.utc_unix_s == pytest.approx(AT, abs=1e-5)
    tilt = log.average(START + 2, 1.0)
    assert tilt.samples == pytest.approx(50, abs=1)
    return np.degrees(tilt.theta)


@pytest.mark.parametrize(
    ("platform", "standardisation", "sign", "unit"),
    [
        ("ios", "false", -1, 9.80665),
        ("ios", "true", 1, 9.80665),
        ("android", "", 1, 9.80665),
        ("ios", "false", -1, 1.0),
    ],
)
def test_what_the_description_says_is_believed(tmp_path, platform, standardisation, sign, unit):
    """Standard gravities are of the uncalibrated sensor; Accelerometer is without gravity."""
    sensor = "Gravity" if unit > 1 else "AccelerometerUncalibrated"
    told = metadata(platform, standardisation)
    files = {
        sensor: logger(sign, unit),
        "Accelerometer": logger(0.01),
        "Metadata": told,
        "Location": "time,latitude\n1,2\n",
    }
    log = read_tilt_csv(zipped(tmp_path / "log.zip", **files))
    assert not log.either_way
    assert degrees(log) == pytest.approx(IN_CAMERA, abs=1e-4)


def test_json_is_read_as_the_zip(tmp_path):
    readings = [
        {"sensor": "Gravity", "time": f"{round(t * 1e9)}", "seconds_elapsed": "0"}
        | dict(zip("xyz", map(str, -9.80665 * UP), strict=True))
        for t in AT
    ]
    told = {"sensor": "Metadata", "platform": "ios", "device name": "a, b", "standardisation": "false"}
    (tmp_path / "log.json").write_text(json.dumps([told, {"sensor": "Location", "time": "1"}, *readings]))
    assert degrees(read_tilt_csv(tmp_path / "log.json")) == pytest.approx(IN_CAMERA, abs=1e-4)


@pytest.mark.parametrize("between", [",", ";", "\t"])
def test_phyphox_starts_when_its_meta_says_and_pauses(tmp_path, between):
    """Experiment times stand still in a pause: here from 1 s to START + 2 s."""
    point = "." if between == "," else ","

    def text(*rows):
        return "".join(
            between.join(c if isinstance(c, str) else f"{c:.15E}".replace(".", point) for c in r) + "\n"
            for r in rows
        )

    at = np.where(AT < START + 2, AT - START, AT - START - 1)
    rows = [[f'"{n}"' for n in ("Zeit (s)", *(f"Beschleunigung {a} (m/s^2)" for a in "xyz"))]]
    rows += [[t, *(9.81 * UP)] for t in at[(at < 1) | (AT >= START + 2)]]
    events = [
        ["event", "experiment time", "system time"],
        ["START", 0.0, START],
        ["PAUSE", 1.0, START + 1],
        ["START", 1.0, START + 2],
    ]
    files = {"Raw Data": text(*rows), "meta__time": text(*events), "meta__device": "property,value\n"}
    log = read_tilt_csv(zipped(tmp_path / "log.zip", **files))
    assert log.utc_unix_s == pytest.approx(AT[(AT < START + 1) | (AT >= START + 2)], abs=1e-5)
    assert np.degrees(log.average(START + 3, 1.0).theta) == pytest.approx(IN_CAMERA, abs=1e-4)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_lone_table_may_point_either_way(tmp_path, sign):
    """Tables of the first versions have units in their names."""
    names = "time,seconds_elapsed,GRAVITY Z (m/s\u00b2),GRAVITY Y (m/s\u00b2),GRAVITY X (m/s\u00b2)"
    (tmp_path / "Gravity.csv").write_text(logger(sign).replace("time,seconds_elapsed,z,y,x", names))
    log = read_tilt_csv(tmp_path / "Gravity.csv")
    assert log.average(START + 2, 1.0).either_way
    assert degrees(log) == pytest.approx(sign * IN_CAMERA, abs=1e-4)
    (tmp_path / "Metadata.csv").write_text(metadata("ios" if sign < 0 else "android", "false"))
    assert degrees(read_tilt_csv(tmp_path / "Gravity.csv")) == pytest.approx(IN_CAMERA, abs=1e-4)


def lying(path):
    """Zip a table of 50 MB so that both of its headers state 100 bytes."""
    zipped(path, Gravity="time,x,y,z\n" + "0" * 50_000_000)
    content = bytearray(path.read_bytes())
    size = struct.pack("<I", 50_000_011)
    while (k := content.find(size)) >= 0:
        content[k : k + 4] = struct.pack("<I", 100)
    path.write_bytes(content)


def test_what_cannot_be_used_is_refused_in_a_sentence(tmp_path, monkeypatch):
    path = tmp_path / "log.zip"

    def refused(words, **files):
        if files:
            zipped(path, **files)
        with pytest.raises(TiltError, match=words):
            read_tilt_csv(path)

    refused("no gravity in it.*gravity.csv is 2 long", Gravity=logger(1, 2.0))
    refused("no table of x, y, z", Location="time,latitude\n1,2\n")
    refused("meta/time.csv, which is not here", Raw="Time (s),x (m/s^2),y (m/s^2),z (m/s^2)\n0,0,0,9.81\n")
    lying(path)
    refused("not a readable telephone's log")
    path.write_bytes(path.read_bytes()[:-9])
    refused("not a readable telephone's log")
    monkeypatch.setattr(phone_log, "MAX_FILES", 1)
    refused("unpacks to more", Gravity=logger(1), Metadata="x\n")
    path.write_text('[{"sensor": "Gravity"}]')
    refused("not a readable telephone's log")
    path.write_text("[" * 10_000)
    refused("not a readable telephone's log")
