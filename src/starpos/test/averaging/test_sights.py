# SPDX-License-Identifier: Apache-2.0
"""Sights by hand: a published example, a vessel's way, limbs and horizons, blunders, and tables that cannot be used."""

import numpy as np
import pytest

from starpos.averaging.sights import circle_of_sight, place_of_sights, read_sights
from starpos.cli import main
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, FrameError
from starpos.sky.bodies import body_at
from starpos.sky.catalogue import load_catalogue
from starpos.units import unix_of

AIR = Atmosphere(pressure_pa=101_000.0, temperature_c=10.0)
# A. Linnman, celestial-navigation: sights in Chicago at 41 deg 51 min 0.1 s N, 87 deg 39 min 0.2 s W
CHICAGO = """body,utc,altitude_deg,sigma_arcmin
Sun,2024-05-05 15:55:18+00:00,55.133639,0.3
Sun,2024-05-05 23:01:19+00:00,19.471944,0.3
Vega,2024-05-06 04:04:13+00:00,30.273250,0.3
"""
NM = 1852.0


def solved(tmp_path, text, near=None):
    (tmp_path / "sights.csv").write_text(text)
    sights = read_sights(tmp_path / "sights.csv")
    circles = [circle_of_sight(s, load_catalogue(), AIR, 0.5) for s in sights]
    return place_of_sights(sights, circles, near)


def test_published_sights_give_their_place(tmp_path):
    place = solved(tmp_path, CHICAGO)
    true = Place.by_gravity(41 + 51.00167 / 60, -(87 + 39.00333 / 60))
    off = -true.offset_m(place.latitude, place.longitude)
    assert np.linalg.norm(off) < 0.6 * NM
    assert off @ np.linalg.solve(place.covariance[:2, :2], off) < 9


def vessel_table(blunder_arcmin=0.0):
    """Eight sights of a vessel on a course of 60 deg at 12 knots, and its place at the last one."""
    rng, rows = np.random.default_rng(4), []
    names = ["moon", "venus", "sun", "moon", "venus", "sun", "sun", "sun"]
    latitude, longitude = 20.0, -40.0
    for k, name in enumerate(names):
        utc = f"2025-06-20T{10 + k}:30:00"
        if k:
            way = 12 / 60
            latitude += way * np.cos(np.radians(60))
            longitude += way * np.sin(np.radians(60)) / np.cos(np.radians(latitude))
        place = Place.by_gravity(latitude, longitude)
        body = body_at(name, earth_state(unix_of(utc)))
        true = place.zenith @ body.from_place(place.zenith)
        limb = {"sun": "lower", "moon": "upper"}.get(name, "")
        centre = np.arcsin(true)
        edge = {"lower": -1, "upper": 1, "": 0}[limb] * body.radius * (1 + body.parallax * true)
        seen = AIR.refraction().bend(np.array([0.0, np.cos(centre + edge), np.sin(centre + edge)]))
        altitude = np.degrees(np.arcsin(seen[2])) + rng.normal(0, 0.3) / 60
        artificial = k == 3
        read = 2 * altitude if artificial else altitude + 1.76 * np.sqrt(9.0) / 60
        read += 2.5 / 60 + (blunder_arcmin / 60 if k == 5 else 0.0)
        rows.append(
            f"{name},{limb},{utc},{read:.6f},2.5,{'' if artificial else 9},{int(artificial)},0.3,60,12"
        )
    names = "body,limb,utc,altitude_deg,index_error_arcmin,height_of_eye_m,artificial_horizon,sigma_arcmin"
    return "\n".join([names + ",course_deg,speed_knots", *rows]), place


@pytest.mark.parametrize("blunder_arcmin", [0.0, 60.0])
def test_a_running_fix_is_where_the_vessel_is_in_spite_of_a_blunder(tmp_path, blunder_arcmin):
    text, true = vessel_table(blunder_arcmin)
    place = solved(tmp_path, text)
    off = true.offset_m(place.latitude, place.longitude)
    assert off @ np.linalg.solve(place.covariance[:2, :2], off) < 12
    assert np.linalg.norm(off) < 4 * NM
    assert np.sqrt(np.trace(place.covariance[:2, :2])) < 6 * NM
    assert place.left_out == (1 if blunder_arcmin else 0)


def test_a_body_is_refused_by_name_and_an_altitude_by_its_value(tmp_path):
    with pytest.raises(FixError, match="no body 'sirus'"):
        solved(tmp_path, CHICAGO.replace("Vega", "Sirus"))
    with pytest.raises(FixError, match=r"altitude of 0\.4"):
        solved(tmp_path, CHICAGO.replace("30.273250", "0.4"))


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("altitude_deg", "altitude", "no column altitude_deg"),
        ("30.273250", "30:16", "altitude_deg is '30:16'"),
        ("15:55:18", "15h55", "no time"),
        ("Vega", "Vega\0", "sights.csv"),
    ],
)
def test_a_table_that_cannot_be_used_says_where(tmp_path, old, new, word):
    with pytest.raises((FrameError, FixError), match=word):
        solved(tmp_path, CHICAGO.replace(old, new))


def test_the_command_prints_each_sight_and_the_place(tmp_path, capsys):
    (tmp_path / "sights.csv").write_text(CHICAGO)
    assert main(["solve", "--sights", str(tmp_path / "sights.csv"), "--pressure-hpa", "1010"]) == 0
    told = capsys.readouterr().out
    assert "sights.csv:4: 59.75" in told
    [place] = [line for line in told.splitlines() if "+41.85" in line and "astronomic" in line]
    assert "heading not known: of elevations alone" in place and "poses" not in place
