# SPDX-License-Identifier: Apache-2.0
"""Files of orbits in all formats, and what is said of broken ones."""

import json

import numpy as np
import pytest

from starpos.errors import SatelliteError
from starpos.satellites.elements import CLASSES, StoredOrbits, chosen, read_orbits
from starpos.satellites.orbits import Moments, states

FIRST = "1 00005U 58002B   00179.78495062  .00000023  00000-0  28098-4 0  4753"
SECOND = "2 00005  34.2682 348.7242 1859667 331.7664  19.3264 10.82419157413667"
FIELDS = {
    "OBJECT_NAME": "VANGUARD 1",
    "EPOCH": "2000-06-27T18:50:19.733568",
    "MEAN_MOTION": 10.82419157,
    "ECCENTRICITY": 0.1859667,
    "INCLINATION": 34.2682,
    "RA_OF_ASC_NODE": 348.7242,
    "ARG_OF_PERICENTER": 331.7664,
    "MEAN_ANOMALY": 19.3264,
    "BSTAR": 0.28098e-4,
    "NORAD_CAT_ID": 123456,
}
WHEN = 962131819.7


def xml(fields):
    inside = "".join(f"<{key}>{value}</{key}>" for key, value in fields.items())
    return f'<ndm><omm id="x"><body><segment><data>{inside}</data></segment></body></omm></ndm>'


FORMS = {
    "two.tle": f"{FIRST}\n{SECOND}\n",
    "three.tle": f"0 VANGUARD 1\r\n{FIRST}\r\n{SECOND}\r\n",
    # the day of the year, as CCSDS 502.0-B allows
    "one.json": json.dumps([FIELDS | {"EPOCH": "2000-179T18:50:19.733568"}]),
    "one.xml": xml(FIELDS),
    "one.csv": ",".join(FIELDS) + "\n" + ",".join(map(str, FIELDS.values())) + "\n",
}


@pytest.mark.parametrize("name", FORMS)
def test_all_forms_of_elements_are_the_same_orbit(tmp_path, name):
    (tmp_path / name).write_text(FORMS[name])
    (tmp_path / "reference").write_text(FORMS["two.tle"])
    (orbit,), said = read_orbits(tmp_path / name)
    (reference,), _ = read_orbits(tmp_path / "reference")
    assert not said
    assert orbit.number == (5 if name.endswith("tle") else 123456)
    assert orbit.name == ("" if name == "two.tle" else "VANGUARD 1")
    moment = Moments.at(np.array([WHEN]))
    ours, theirs = (states([o], moment, np.zeros(1))[0] for o in (orbit, reference))
    # the lines' epoch has a digit of 0.9 ms, and microseconds in OMM: 5 m
    assert np.linalg.norm(ours - theirs) < 8


def test_of_elements_that_are_as_good_the_first_counts(tmp_path):
    (tmp_path / "two.tle").write_text(f"0 ONE\n{FIRST}\n{SECOND}\n0 OTHER\n{FIRST}\n{SECOND}\n")
    (orbit,), _ = chosen(read_orbits(tmp_path / "two.tle")[0], WHEN + 3600)
    assert orbit.name == "ONE"


def test_a_broken_line_costs_its_satellite_alone(tmp_path):
    broken = FIRST.replace("28098-4", "28099-4")
    (tmp_path / "a.tle").write_text(f"BAD\n{broken}\n{SECOND}\nSTARLINK-1\n{FIRST}\n{SECOND}\n1 0000\n")
    (orbit,), (sentence,) = read_orbits(tmp_path / "a.tle")
    assert orbit.errors is CLASSES["manoeuvring"]
    assert "line 2: its check sum is wrong" in sentence
    assert "of 2 orbits 1 is left out" in sentence
    rows = [FIELDS, FIELDS | {"ECCENTRICITY": "x"}, {"NORAD_CAT_ID": 7}, 3]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    (orbit,), (sentence,) = read_orbits(tmp_path / "a.json")
    assert orbit.errors is CLASSES["passive"]
    assert "3 are left out" in sentence


def test_an_orbit_inside_the_earth_costs_its_satellite_alone(tmp_path):
    rows = [FIELDS | {"MEAN_MOTION": 17.9, "ECCENTRICITY": 0.2, "NORAD_CAT_ID": 7}, FIELDS]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    (orbit,), (sentence,) = read_orbits(tmp_path / "a.json")
    assert orbit.number == 123456 and "satellite 7: " in sentence


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (json.dumps([FIELDS | {"EPHEMERIS_TYPE": 4}]), "SGP4-XP"),
        (f"{FIRST[:62]}4{FIRST[63:68]}7\n{SECOND}\n", "SGP4-XP"),
        ("<oem><stateVector/></oem>", "give it as text"),
        (
            "CCSDS_OEM_VERS = 2.0\nMETA_START\nCENTER_NAME = MARS BARYCENTER\nREF_FRAME = EME2000\nMETA_STOP\n"
            "1996-353T12:00:00.331 2789.619 -280.045 -1746.755 4.73372 -2.49586 -1.04195\n",
            "about MARS BARYCENTER",
        ),
    ],
)
def test_orbits_that_would_be_misread_are_refused(tmp_path, text, said):
    (tmp_path / "x").write_text(text)
    with pytest.raises(SatelliteError, match=said):
        read_orbits(tmp_path / "x")


def test_stored_orbits_are_read_again_when_they_change(tmp_path):
    (tmp_path / "a.tle").write_text(FORMS["two.tle"])
    stored = StoredOrbits(tmp_path)
    assert [o.number for o in stored.read()] == [5]
    (tmp_path / "b.json").write_text(FORMS["one.json"])
    assert [o.number for o in stored.read()] == [5, 123456] and not stored.trouble
    (tmp_path / "a.tle").unlink()
    (tmp_path / "b.json").write_text("broken")
    # the earlier ones, and why
    assert [o.number for o in stored.read()] == [5, 123456]
    assert "no file in it has orbits" in stored.trouble
    with pytest.raises(SatelliteError, match="no file in it"):
        StoredOrbits(tmp_path)


def test_xml_that_declares_entities_is_not_unfolded(tmp_path):
    (tmp_path / "a.xml").write_text(f'<!DOCTYPE x [<!ENTITY a "aaaa">]>{xml(FIELDS)}')
    with pytest.raises(SatelliteError, match="declares a type or entities"):
        read_orbits(tmp_path / "a.xml")


@pytest.mark.parametrize("text", ["", "hello\nworld\n", "[1, 2", "<ndm>", "{}", "CCSDS_OEM_VERS = 2.0\n"])
def test_a_file_without_orbits_is_refused(tmp_path, text):
    (tmp_path / "x").write_text(text)
    with pytest.raises(SatelliteError, match="give TLE, OMM"):
        read_orbits(tmp_path / "x")


def test_an_operators_ephemeris(tmp_path):
    """OEM by GPS time, 18 s ahead of UTC in 2020: a circle in GCRF."""
    rate, radius = 2 * np.pi / 5700, 6928.0
    begin = np.datetime64("2020-09-13T12:00:00")
    turns = rate * 60 * np.arange(30)
    rows = [
        f"{begin + np.timedelta64(k * 60, 's')}.000 {radius * np.cos(x)} {radius * np.sin(x)} 0.0 0 0 0"
        for k, x in enumerate(turns)
    ]
    (tmp_path / "a.oem").write_text(
        "CCSDS_OEM_VERS = 2.0\nMETA_START\nOBJECT_NAME = A\nOBJECT_ID = 2020-001A\nREF_FRAME = EME2000\n"
        "TIME_SYSTEM = GPS\nMETA_STOP\n" + "\n".join(rows) + "\n"
    )
    (orbit,), _ = read_orbits(tmp_path / "a.oem")
    after = 615.0
    utc = (begin - np.datetime64("1970-01-01T00:00:00")) / np.timedelta64(1, "s") - 18 + after
    r, _ = states([orbit], Moments.at(np.array([utc])), np.zeros(1))
    assert r[0] == pytest.approx(
        radius * 1e3 * np.array([np.cos(rate * after), np.sin(rate * after), 0]), abs=0.5
    )


def test_precise_ephemerides_are_in_the_earths_axes(tmp_path):
    rate, radius = 2 * np.pi / 43200 - 7.292115e-5, 26560.0
    lines = ["#dP2020  9 13 12  0  0.00000000      20 ORBIT IGS14 FIT  IGS", "%c M  cc GPS ccc cccc"]
    for k in range(20):
        turn = rate * 900 * k
        lines.append(f"*  2020  9 13 {12 + k // 4:2d} {k % 4 * 15:2d}  0.00000000")
        lines.append(
            f"PG01{radius * np.cos(turn):14.6f}{radius * np.sin(turn):14.6f}{0.0:14.6f} 999999.999999"
        )
        # a satellite without a place
        lines.append(f"PG02{0.0:14.6f}{0.0:14.6f}{0.0:14.6f} 999999.999999")
    (tmp_path / "a.sp3").write_text("\n".join(lines))
    (orbit,), _ = read_orbits(tmp_path / "a.sp3")
    moment = Moments.at(np.array([1599998400.0 - 18 + 7000]))
    r, _ = states([orbit], moment, np.zeros(1))
    expected = radius * 1e3 * np.array([np.cos(rate * 7000), np.sin(rate * 7000), 0])
    assert moment.gcrs_to_itrs[0] @ r[0] == pytest.approx(expected, abs=0.1)
