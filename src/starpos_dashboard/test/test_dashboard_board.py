# SPDX-License-Identifier: Apache-2.0
"""The state sent to the page: never an invalid number, never more than it can hold."""

import json
import math

import cv2
import numpy as np
import pytest
import said
from diagnostic_msgs.msg import KeyValue
from sensor_msgs.msg import NavSatFix

from starpos.errors import FrameError
from starpos_dashboard import board
from starpos_dashboard.board import Board
from starpos_dashboard.node import jpeg
from starpos_interfaces.msg import Tilt

NAN, INF = math.nan, math.inf
ALL = {"track": 10, "lights": ""}


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def told(board: Board, now_s=1000.0, slow_s=15.0) -> dict:
    return json.loads(board.as_json(now_s, slow_s))


def test_a_fix_comes_with_its_covariance_and_where_it_was_before():
    b = Board(ALL)
    b.hear_fix(said.fix(10.0, 20.0, (4.0, 1.0, 9.0)))
    fix = told(b)["fix"]
    assert (fix["good"], fix["latitude"], fix["longitude"]) == (True, 10.0, 20.0)
    assert fix["covariance"] == [4.0, 1.0, 9.0] and fix["altitude"] is None
    b.hear_fix(said.fix(NAN))
    after = told(b)
    assert not after["fix"]["good"] and "latitude" not in after["fix"]
    assert after["last_fix"]["latitude"] == 10.0
    assert b.track == ((1, 10.0, 20.0),)


@pytest.mark.parametrize("latitude, longitude", [(NAN, 3.0), (3.0, INF), (91.0, 3.0), (3.0, 1e9)])
def test_a_place_that_is_not_on_earth_is_no_fix(latitude, longitude):
    message = said.fix(1.0, longitude)
    message.latitude = latitude
    assert not board.position(message)["good"]
    b = Board(ALL)
    b.hear_fix(message)
    assert b.track == () and "last_fix" not in told(b)


@pytest.mark.parametrize(
    "covariance", [(NAN, 0.0, 1.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 1.0), (1.0, 2.0, 1.0), (INF, 0.0, 1.0)]
)
def test_an_impossible_covariance_is_an_unknown_one(covariance):
    place = board.position(said.fix(1.0, 2.0, covariance))
    assert place["good"] and place["covariance"] is None and place["trouble"]


def test_a_covariance_of_unknown_type_is_not_used():
    message = said.fix(1.0, 2.0)
    message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_UNKNOWN
    assert board.position(message)["covariance"] is None


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0, 217.25])
def test_the_heading_is_the_azimuth_of_the_x_axis(azimuth):
    heading = board.heading(said.imu(azimuth, 0.25))
    assert math.isclose(math.remainder(heading["azimuth"] - azimuth, 360.0), 0.0, abs_tol=1e-9)
    assert math.isclose(heading["sigma"], 0.25)


@pytest.mark.parametrize("broken", ["nan", "zero", "unknown"])
def test_no_attitude_is_no_heading(broken):
    message = said.imu()
    if broken == "nan":
        message.orientation.z = NAN
    elif broken == "zero":
        message.orientation.z = message.orientation.w = 0.0
    else:
        message.orientation_covariance[0] = -1.0
    b = Board(ALL)
    b.show("heading", board.heading(said.imu()))
    b.show("heading", board.heading(message))
    assert "heading" not in told(b)


def test_nan_everywhere_is_null_everywhere():
    b = Board(ALL)
    b.show("tilt", board.tilt(Tilt(x=NAN, y=INF, temperature=NAN, covariance=[NAN, NAN, NAN, INF])))
    message = said.solution()
    message.residual, message.budget[0].east, message.budget[1].heading = NAN, NAN, INF
    b.show("solution", board.solution(message))
    all_of_it = told(b)
    assert [all_of_it["tilt"][k] for k in ("x", "y", "temperature", "sigma_x", "sigma_y")] == [None] * 5
    assert all_of_it["solution"]["residual"] is None
    assert all_of_it["solution"]["budget"][0]["position"] is None


def test_a_gnss_place_that_is_not_on_earth_or_an_unknown_status_is_not_shown():
    assert board.gnss(said.gnss())["latitude"] == 48.1553
    assert board.gnss(said.gnss(latitude=math.nan))["latitude"] is None
    assert board.gnss(said.gnss(longitude=400.0))["longitude"] is None
    assert board.gnss(said.gnss(status=9)) is None


def test_the_flags_of_a_tilt_are_said_in_words():
    flags = board.tilt(said.tilt(31.0, 0.0, flags=Tilt.OUT_OF_RANGE | Tilt.TIME_UNKNOWN))["flags"]
    assert flags == ["beyond the sensor's range", "its time is unknown"]
    flags = {v for v in (getattr(Tilt, name) for name in dir(Tilt) if name.isupper()) if isinstance(v, int)}
    assert {flag for flag, _ in board.TILT_FLAGS} == flags


def test_texts_are_short_and_cannot_rearrange_the_page():
    assert board.text("a\nb\x00c\u202ed\u2066e") == "a b c d e"
    assert len(board.text("x" * 10**6)) == board.SENTENCE_LETTERS
    # The page shows it as it is.
    assert board.text("<b>&amp;") == "<b>&amp;"


def test_lights_are_the_newest_of_their_name_and_bounded():
    clock = Clock()
    b = Board(ALL, clock)
    b.hear_diagnostics(said.diagnostics(("solver: Inputs", 0, "good")))
    clock.now += 7.0
    assert told(b)["lights"][0]["age"] == 7.0
    b.hear_diagnostics(said.diagnostics(("solver: Inputs", 1, "bad"), ("x: Y", 200, "?")))
    assert [(x["name"], x["level"], x["age"]) for x in told(b)["lights"]] == [
        ("solver: Inputs", 1, 0.0),
        ("x: Y", board.ERROR, 0.0),
    ]
    for k in range(1000):
        b.hear_diagnostics(said.diagnostics((f"n{k}: T", 0, "")))
    assert len(told(b)["lights"]) == board.LIGHTS
    many = said.diagnostics(*((f"m{k}: T", 0, "z" * 999) for k in range(3000)))
    b.hear_diagnostics(many)
    assert len(b.as_json(0.0, 15.0)) < board.LIGHTS * 600


def test_nodes_that_get_a_light_later_are_silent_since_then():
    now = [0.0]
    b = Board(values := ALL | {"lights": "solver"}, clock=lambda: now[0])
    now[0], values["lights"] = 100.0, "solver, camera"
    assert {light["age"] for light in told(b)["lights"]} == {0.0}
    now[0] = 103.0
    assert {light["age"] for light in told(b)["lights"]} == {3.0}


def test_only_lights_of_the_nodes_asked_for():
    b = Board(ALL | {"lights": "solver"})
    b.hear_diagnostics(said.diagnostics(("solver: A", 0, ""), ("wheels: B", 2, "")))
    assert [x["name"] for x in told(b)["lights"]] == ["solver: A"]


@pytest.mark.parametrize(
    "lights, seen",
    [
        ({"solver"}, ["solver: A"]),
        ({"/a/solver"}, ["solver: A"]),
        ({"solver", "/b/solver", "/solver"}, ["/b/solver: B", "/solver: C", "solver: A"]),
        ({}, ["/b/solver: B", "/solver: C", "solver: A"]),
    ],
)
def test_the_lights_of_another_instrument_are_not_taken_for_its_own(lights, seen):
    b = Board(ALL | {"lights": ", ".join(lights)}, namespace="/a")
    b.hear_diagnostics(
        said.diagnostics(("/a/solver: A", 0, ""), ("/b/solver: B", 2, ""), ("solver: C", 2, ""))
    )
    assert [x["name"] for x in told(b)["lights"]] == seen
    alone = Board(ALL | {"lights": "solver"})
    alone.hear_diagnostics(said.diagnostics(("/a/solver: A", 2, ""), ("solver: C", 0, "")))
    assert [x["name"] for x in told(alone)["lights"]] == ["solver: C"]


def test_a_node_that_has_said_nothing_has_a_light_too_or_all_seems_green_without_it():
    clock = Clock()
    values = ALL | {"lights": "camera, solver"}
    b = Board(values, clock)
    clock.now += 6.0
    b.hear_diagnostics(said.diagnostics(("camera: Capture", 0, "")))
    lights = told(b)["lights"]
    assert [(x["name"], x["level"], x["age"]) for x in lights] == [
        ("camera: Capture", 0, 0.0),
        ("solver", board.STALE, 6.0),
    ]
    values["lights"] = "camera"
    assert len(told(b)["lights"]) == 1


def test_a_hostile_budget_is_cut():
    message = said.solution()
    message.budget = message.budget * 500
    assert len(board.solution(message)["budget"]) == board.TERMS


def test_the_track_forgets_its_oldest_and_counts_on():
    values = ALL | {"track": 3}
    b = Board(values)
    for k in range(5):
        b.hear_fix(said.fix(float(k), 0.0))
    assert [n for n, _, _ in b.track] == [3, 4, 5]
    values["track"] = 2
    assert [n for n, _, _ in b.track] == [4, 5]


def test_ages_are_told_on_a_clock_that_nobody_sets():
    clock = Clock()
    b = Board(ALL, clock)
    b.show("tilt", board.tilt(said.tilt()))
    clock.now += 3.5
    assert told(b)["tilt"]["age"] == 3.5 and told(b)["old_after"] == {"slow": 15.0, "fast": 5.0}


def test_a_frame_becomes_a_jpeg_of_the_side_asked_for():
    picture = cv2.imdecode(np.frombuffer(jpeg(said.image(1600, 1000), 800), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (500, 800, 3)
    assert picture[250, 100].tolist()[0] > 180 and picture[250, 700].tolist()[1] > 180
    small = cv2.imdecode(np.frombuffer(jpeg(said.image(64, 40), 800), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (40, 64, 3)


@pytest.mark.parametrize(
    "field, value", [("width", 100000), ("step", 7), ("encoding", "x" * 999), ("height", 0)]
)
def test_a_broken_frame_is_one_sentence(field, value):
    message = said.image(64, 40)
    setattr(message, field, value)
    with pytest.raises(FrameError) as error:
        jpeg(message, 800)
    assert "\n" not in str(error.value) and len(str(error.value)) < 200


def test_the_suns_way_is_that_of_the_place_and_the_day():
    b = Board(ALL)
    # 2025-06-01T09:00:00
    when = 1748768400.0
    assert told(b, when)["sun"] is None
    b.hear_fix(said.fix(48.0, 11.0, (4.0, 0.0, 4.0)))
    way = told(b, when)["sun"]
    assert len(way) == 73
    # astropy's AltAz of the Sun there, without refraction
    assert way[36] == pytest.approx([122.26, 52.83], abs=0.1)
    assert min(altitude for _, altitude in way) < -15
    assert told(b, 9e9)["sun"] is None


def test_at_a_gnss_place_the_sun_is_shown_too():
    b = Board(ALL)
    b.show("gnss", board.gnss(said.gnss()))
    assert len(told(b, 1748768400.0)["sun"]) == 73


def test_at_a_site_by_parameter_the_sun_is_shown_before_any_fix():
    b, when = Board(ALL), 1748768400.0
    diagnostics = said.diagnostics(("solver: Solution", 0, "heading by the Sun"))
    site = (("site latitude (deg)", "48.0"), ("site longitude (deg)", "11.0"))
    diagnostics.status[0].values = [KeyValue(key=key, value=value) for key, value in site]
    b.hear_diagnostics(diagnostics)
    assert told(b, when)["sun"][36] == pytest.approx([122.26, 52.83], abs=0.1)
    diagnostics.status[0].values[0].value = "nan"
    b.hear_diagnostics(diagnostics)
    b.hear_fix(said.fix(-30.0, 11.0, (4.0, 0.0, 4.0)))
    assert told(b, when)["sun"][36][1] < 50
