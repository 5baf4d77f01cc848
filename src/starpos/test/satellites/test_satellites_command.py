# SPDX-License-Identifier: Apache-2.0
"""The command: a place that joins, what a night shows, and calls that are refused."""

import json
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, get_sun
from astropy.time import Time

import starpos
from starpos.cli import main
from starpos.errors import SatelliteError
from starpos.simulation.scene import expose, render, scene_of, write_fits
from starpos.sky.catalogue import load_catalogue
from starpos.units import unix_of
from starpos_testing.skies import sightings as skies

PLACE = 47.0, 8.0, 900.0


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    folder = tmp_path_factory.mktemp("night")
    records, text = skies.drawn(900, 7)
    (folder / "active.tle").write_text(text)
    rows, numbers = skies.table(records, PLACE, np.random.default_rng(5), count=8)
    (folder / "all.csv").write_text(rows)
    (folder / "two.csv").write_text("\n".join(rows.splitlines()[:5]) + "\n")
    return folder, records, numbers


def told(capsys, *words):
    """Exit status, JSON objects, and complaints of a call."""
    status = main([*map(str, words), "--json"])
    out, err = capsys.readouterr()
    answers = [json.loads(line) for line in out.splitlines()]
    for answer in answers if find_spec("fastjsonschema") else ():
        promised()(answer)
    return status, answers, err


@lru_cache(maxsize=1)
def promised():
    """A validator that refuses any object outside the schema."""
    import fastjsonschema

    schema = Path(__file__).resolve().parents[4] / "docs" / "reference" / "starpos.schema.json"
    return fastjsonschema.compile(json.loads(schema.read_text()))


def call(folder, name, *more):
    return ["satellites", folder / name, "--elements", folder / "active.tle", "--height", 900, *more]


def test_a_place_by_the_level_joins_by_its_covariance(night, tmp_path, capsys):
    folder, _, _ = night
    by_level = {
        "combined": True,
        "latitude_geodetic": 47.002,
        "longitude_geodetic": 8.003,
        "covariance_geodetic": np.diag([400.0**2, 400.0**2, 1e-4]).tolist(),
    }
    (tmp_path / "solved.json").write_text(json.dumps({"file": "a.fits"}) + "\n" + json.dumps(by_level) + "\n")
    gnss = "utc_unix_s,latitude,longitude,altitude_m,sigma_east_m,sigma_north_m,status\n"
    gnss += f"{skies.NIGHT:.0f},47.0000,8.0000,900,3,3,0\n"
    (tmp_path / "gnss.csv").write_text(gnss)
    status, (*_, alone), _ = told(capsys, *call(folder, "all.csv", "--height-stddev", 20))
    assert status == 0
    status, (*_, joined), _ = told(
        capsys, *call(folder, "all.csv", "--height-stddev", 20, "--join", tmp_path / "solved.json")
    )
    # two independent places: their weights add up
    weights = [np.linalg.inv(np.array(a["covariance"])[:2, :2]) for a in (alone, joined)]
    added = weights[1] - weights[0]
    assert added == pytest.approx(np.eye(2) / 400.0**2, abs=0.15 / 400.0**2)
    # two trails do with a level, and not without
    status, answers, err = told(capsys, *call(folder, "two.csv"))
    assert status == 1 and answers[-1]["latitude_geodetic"] is None and "takes 3" in err
    status, answers, _ = told(capsys, *call(folder, "two.csv", "--join", tmp_path / "solved.json"))
    assert status == 0 and answers[-1]["satellites"] == 2
    status, answers, _ = told(capsys, *call(folder, "two.csv", "--join", tmp_path / "gnss.csv"))
    assert answers[-1]["latitude_geodetic"] == pytest.approx(47.0, abs=2e-4)


def test_a_frame_has_its_heading_at_that_place(night, tmp_path, capsys):
    folder, _, _ = night
    scene = scene_of((640, 480), 7812.5, *PLACE[:2], pointing_deg=(130.0, 60.0, 20.0))
    rng, begin = np.random.default_rng(3), "2020-09-13T19:00:00"
    light = expose(scene, load_catalogue(), unix_of(begin), 0.5, rng)
    write_fits(tmp_path / "a.fits", render(scene, light, unix_of(begin), 0.5, rng), begin)
    command, *words = call(folder, "all.csv", "--focal-mm", 50, "--pixel-um", 6.4)
    status, (*trails, place), _ = told(capsys, command, tmp_path / "a.fits", *words)
    assert status == 0 and len(trails) == 8
    (frame,) = place["frames"]
    off = (frame["heading"] - np.degrees(scene.heading) + 180) % 360 - 180
    assert abs(off) < 4 * frame["sigma_heading_deg"] < 0.02
    seen = folder / "all.csv", tmp_path / "a.fits"
    fix = starpos.locate(seen, [folder / "active.tle"], instrument=starpos.Instrument(7812.5), height_m=900)
    assert np.degrees(fix.headings[0][1]) == pytest.approx(frame["heading"], abs=1e-9)
    with pytest.raises(SatelliteError, match=r"none of 1 frames shows an end of a trail"):
        starpos.locate(seen[1:], [folder / "active.tle"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["satellites"], "give frames or sightings and --elements"),
        (["satellites", "--plan", "95", "0"], "give latitude and longitude"),
        (["satellites", "--plan", "47", "8", "--size", "100", "100"], "no focal length"),
        (
            [
                "satellites",
                "{folder}/all.csv",
                "--elements",
                "{folder}/active.tle",
                "--join",
                "{folder}/all.csv",
            ],
            "GNSS",
        ),
        (
            ["satellites", "{folder}/all.csv", "--elements", "{folder}/active.tle", "--near", "91", "0", "5"],
            "--near",
        ),
    ],
)
def test_calls_that_cannot_be_answered(night, capsys, words, said):
    assert main([word.format(folder=night[0]) for word in words]) == 2
    assert said in capsys.readouterr().err


def test_a_plan_has_the_dark_hours_and_what_is_high_and_lit(night, capsys):
    """Against astropy's Sun and a shadow of its own, at the middle of each hour."""
    folder, records, _ = night
    begin = "2020-09-13T13:00:00"
    words = ["satellites", "--plan", 47, 8, "--elements", folder / "active.tle", "--at", begin]
    status, hours, _ = told(capsys, *words, "--focal-mm", 25, "--pixel-um", 5.86, "--size", 1936, 1216)
    assert status == 0 and sum(h["best"] for h in hours) == 1
    site = EarthLocation.from_geodetic(8, 47, 0)
    every = Time(begin) + np.arange(0, 24, 0.05) * u.hour
    dark = get_sun(every).transform_to(AltAz(obstime=every, location=site)).alt.deg < -6
    hours_dark = sorted({t.isot[:13] for t in every[dark]})
    assert [h["utc"][:13] for h in hours] == hours_dark
    first = hours[0]
    middle = Time(first["utc"].rstrip("Z")) + 45 * u.min
    sun = get_sun(middle).cartesian.xyz.value
    sun = sun / np.linalg.norm(sun)
    seen = []
    for record in records:
        _, height = skies.sight(record, (47.0, 8.0, 0.0), middle.unix)
        axes, *_ = skies.surroundings(47.0, 8.0, 0.0, middle.unix)
        r = axes @ np.array(record.sgp4(middle.jd1, middle.jd2)[1])
        lit = r @ sun > 0 or np.linalg.norm(r - (r @ sun) * sun) > 6400
        if height > np.radians(26) and lit:
            seen.append(record.satnum)
    assert len(seen) > 3 and set(seen) <= set(first["satellites"])
    assert len(first["satellites"]) < 150 and 3 < first["at_once"] < 20
    assert 0 < first["in_lens"] < first["at_once"] and first["altitude"] > 25
    # later the shadow rises
    lowest = [h["lit_from_km"] for h in hours]
    assert lowest[0] < 200 < 1000 < max(lowest)


def test_where_it_does_not_get_dark_nothing_is_planned(capsys):
    assert main(["satellites", "--plan", "75", "20", "--at", "2020-06-21T00:00:00"]) == 1
    assert "does not sink 6 deg" in capsys.readouterr().err
