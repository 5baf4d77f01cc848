# SPDX-License-Identifier: Apache-2.0
"""Random fields, how answers to them are counted, and the command that prints the table."""

import json
from itertools import islice

import numpy as np
import pytest

from starpos.cli import main
from starpos.errors import CatalogueError
from starpos.instrument.camera import Camera
from starpos.simulation import montecarlo_fields as mc
from starpos_testing.skies.scenes import FOCAL_PX, SIZE

# 15 deg.
CAMERA = Camera.from_focal(*SIZE, FOCAL_PX)
WIDE = ("--focal-mm", "29.67", "--pixel-um", "6.4", "--size", "1000", "700")
FEW = ("--fields", "4", "--false", "0", "3", "--stars", "6", "--points", "3", "--limit-mag", "6.5")


@pytest.fixture
def conditions():
    return mc.Conditions(camera=CAMERA, limit_mag=6.5)


def test_a_field_is_known_by_seed_and_number(catalogue, conditions):
    one, again, other = (mc.draw(catalogue, conditions, 5, number) for number in (3, 3, 4))
    np.testing.assert_array_equal(one.xy, again.xy)
    assert one.centre @ other.centre < 0.999
    assert one.centre @ mc.draw(catalogue, conditions, 6, 3).centre < 0.999


def test_an_ideal_field_holds_the_catalogues_stars(catalogue):
    ideal = mc.Conditions(camera=CAMERA, limit_mag=6.5, sigma_px=1e-9, scatter_mag=0, missing=0, blend_px=0)
    assert mc.ideal(CAMERA, 6.5) == mc.Conditions(
        camera=CAMERA, limit_mag=6.5, scatter_mag=0, missing=0, blend_px=0
    )
    for number in range(5):
        drawn = mc.draw(catalogue, ideal, 1, number)
        index = catalogue.cone(drawn.centre, CAMERA.half_diagonal_rad * 1.01, 6.5)
        v = catalogue.directions(index)
        off_axis = np.sqrt(1 - (v @ drawn.centre) ** 2)
        seen = CAMERA.directions(*drawn.xy.T)
        # each star at its distance from the centre, and all those that are inside whatever way the frame is turned
        assert len(drawn) <= len(index)
        assert np.abs(np.sqrt(1 - seen[:, 2] ** 2)[:, None] - off_axis).min(1).max() < 1e-7
        short = np.arctan(CAMERA.height / 2 / CAMERA.fy)
        assert len(drawn) >= (off_axis < np.sin(short) * 0.99).sum()
        assert (np.diff(drawn.mag) >= 0).all()


def test_what_is_lost_and_scattered(catalogue):
    full = mc.ideal(CAMERA, 7.0)
    poor = mc.Conditions(camera=CAMERA, limit_mag=7.0, scatter_mag=0, missing=0.3, blend_px=0)
    counts = [sum(len(mc.draw(catalogue, c, 2, k)) for k in range(30)) for c in (full, poor)]
    assert counts[1] / counts[0] == pytest.approx(0.7, abs=0.05)


def test_close_stars_are_one():
    xy = np.array([[100.0, 100], [300, 300], [103, 100], [300, 303.5], [300, 400]])
    mag = np.array([2.0, 3.0, 2.0, 4.0, 5.0])
    joined, light = mc.blended(xy, mag, 4.0)
    np.testing.assert_allclose(joined, [[101.5, 100], [300, 300 + 3.5 / (1 + 10**0.4)], [300, 400]])
    assert light[0] == pytest.approx(2 - 2.5 * np.log10(2))
    np.testing.assert_array_equal(mc.blended(xy, mag, 0.0)[0], xy[[0, 2, 1, 3, 4]])


def test_false_stars_outshine_all(catalogue, conditions):
    drawn = mc.draw(catalogue, conditions, 1, 1)
    for n in (0, 1, 3):
        field = drawn.with_false(n, CAMERA)
        assert len(field) == len(drawn) + n
        np.testing.assert_array_equal(field.xy[n:], drawn.xy)
        assert (np.diff(field.mag) >= 0).all()
        stars = field.stars(conditions)
        assert (np.diff(stars.flux) <= 0).all()
        assert (stars.width, stars.height) == SIZE
    # the same points, and one more
    np.testing.assert_array_equal(drawn.with_false(2, CAMERA).xy[:2], drawn.with_false(3, CAMERA).xy[1:3])


def test_fields_of_few_stars(catalogue, conditions):
    for field in islice(mc.few_stars(catalogue, conditions, 1, 6), 5):
        assert len(field) == 6
    with pytest.raises(CatalogueError, match="ask for fewer"):
        next(mc.few_stars(catalogue, mc.Conditions(camera=CAMERA, limit_mag=0.0), 1, 50))


def test_a_limit_that_gives_so_many_stars(catalogue):
    limit = mc.limit_for(CAMERA, catalogue, 25)
    mean = np.mean([len(mc.draw(catalogue, mc.ideal(CAMERA, limit), 3, k)) for k in range(150)])
    assert mean == pytest.approx(25, rel=0.15)


def test_answers_are_counted(catalogue, conditions):
    tally, tolerance = mc.Tally(), conditions.tolerance_rad
    # A pixel of 45 arcsec.
    assert tolerance == pytest.approx(1 / FOCAL_PX)
    given, points = mc.draw(catalogue, conditions, 1, 1), next(mc.points(conditions, 1))
    across = np.cross(given.centre, [0, 0, 1.0])
    beside = given.centre + across / np.linalg.norm(across) * 1.5 * tolerance
    answers = [(given, given.centre), (given, beside), (given, None), (points, None), (points, given.centre)]
    for field, answer in answers:
        tally.ask(field, field.stars(conditions), lambda stars, answer=answer: answer, tolerance)
    assert (tally.correct, tally.wrong, tally.none, tally.fields) == (1, 2, 2, 5)
    assert len(tally.cpu_ms) == 5


def test_the_interval_is_wilsons():
    """Newcombe 1998, Statistics in Medicine 17, 857, table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    for (r, n), interval in {
        (81, 263): (0.2553, 0.3662), (15, 148): (0.0624, 0.1605), (0, 20): (0.0, 0.1611), (1, 29): (0.0061, 0.1718),
    }.items():  # fmt: skip
        assert mc.Tally(correct=r, wrong=n - r).interval == pytest.approx(interval, abs=1e-4)
    assert mc.Tally(correct=20).interval[1] == pytest.approx(1)
    assert mc.Tally().interval == (0, 1)


def test_the_command(capsys):
    status = main(["montecarlo", *WIDE, *FEW])
    out = capsys.readouterr().out.splitlines()
    assert status == 0
    assert [line[:15].strip() for line in out[2:]] == [
        "0 false stars",
        "3 false stars",
        "6 stars",
        "random points",
    ]
    assert [int(line[15:23]) for line in out[2:]] == [4, 4, 4, 3]


def test_the_command_json(capsys):
    assert main(["montecarlo", *WIDE, *FEW, "--ideal", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [r["row"] for r in rows] == ["0 false stars", "3 false stars", "6 stars", "random points"]
    assert all(r["correct"] + r["wrong"] + r["none"] == r["fields"] for r in rows)
    assert rows[0]["correct"] == 4
    assert rows[3]["none"] == 3
    assert all(r["cpu_ms_median"] <= r["cpu_ms_worst"] for r in rows)


@pytest.mark.parametrize(
    "bad",
    [
        ("--fields", "-1"),
        ("--fields", "0"),
        ("--focal-mm", "0"),
        ("--focal-error", "50"),
        ("--size", "1", "1"),
        ("--limit-mag", "x"),
    ],
)
def test_a_bad_call_is_one_line(bad, capsys):
    try:
        status = main(["montecarlo", *bad])
    except SystemExit as e:
        status = e.code
    assert status == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
