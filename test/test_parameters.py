# SPDX-License-Identifier: Apache-2.0
"""Parameters, services and diagnostics of the running solver."""

import math
import struct

import numpy as np
import pytest
from std_srvs.srv import Trigger

from starpos_interfaces.msg import Solution
from starpos_interfaces.srv import Solve
from starpos_testing.graph.shots import PRESSURE_PA, shoot


def test_solve_says_why_there_is_nothing_to_solve(graph, solver):
    response = graph.call(Solve, "solver/solve", Solve.Request())
    assert not response.success and "no frame has arrived" in response.message
    assert response.solution.status == Solution.BAD_INPUT


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"refraction__pressure": -5.0}, "refraction.pressure must be a number from 0 to 120000 Pa"),
        ({"refraction__pressure": math.inf}, "refraction.pressure must be a number from 0 to 120000 Pa"),
        ({"refraction__pressure": 880.0}, "pressure 880 Pa (8.8 hPa) between 30000 and 120000 Pa"),
        ({"misalignment": [1.0, 2.0]}, "misalignment must be 3 values"),
        ({"calibration_url": "/nowhere/instrument.yaml"}, "/nowhere/instrument.yaml"),
        ({"deflection__geoid": "/nowhere/egm.gtx"}, "/nowhere/egm.gtx GTX GeoTIFF"),
        (
            {"refraction__humidity": 1.5},
            "refraction.humidity must be a number from 0 to 1, or nan for unset; 1.5 was given.",
        ),
        ({"min_stars": 2}, "min_stars must be a whole number from 4 to 1000; 2 was given."),
        (
            {"clock_stddev": 0.5, "min_stars": 0},
            "min_stars must be a whole number from 4 to 1000; 0 was given.",
        ),
        (
            {"deflection__xi": 200.0},
            "deflection.xi must be a number from -120 to 120 arcsec; 200.0 was given.",
        ),
        ({"frame_id": ""}, "frame_id must be a frame's name, not empty, '' was given."),
        ({"frame_id": "a b"}, "frame_id must be a frame's name, without blanks 'a b' was given."),
        ({"refraction__temperature": "warm"}, "refraction.temperature must be a number 'warm' was given."),
        (
            {"misalignment_stddev": -1},
            "misalignment_stddev must be a number from 0 to 36000 arcsec, or nan for unset; -1 was given.",
        ),
    ],
)
def test_what_is_refused_comes_back_with_its_constraint(graph, solver, values, words):
    done, reason = graph.set("solver", **values)
    assert not done and all(word in reason for word in words.split()), reason


def test_pressure_moves_the_next_fix_and_solve_solves_the_last_frame_again(graph, solver):
    shot = shoot()
    before, _, _ = graph.answer(shot)
    assert graph.set("solver", refraction__pressure=0.0) == (True, "")
    response = graph.call(Solve, "solver/solve", Solve.Request())
    assert response.success, response.message
    after = response.solution
    moved = shot.error_m(after) - shot.error_m(before)
    # 12 deg from the zenith air of this pressure lifts the stars by some 11 arcsec
    assert before.refraction == pytest.approx(11.5, abs=1) and after.refraction == 0
    assert 300 < np.hypot(*moved) < 400
    next_shot = shoot()
    following = graph.answer(next_shot)[0]
    assert np.hypot(*(next_shot.error_m(following) - shot.error_m(after))) < 60
    assert graph.set("solver", refraction__pressure=PRESSURE_PA)[0]
    assert np.hypot(*shot.error_m(graph.call(Solve, "solver/solve", Solve.Request()).solution)) < 60


def test_deflection_and_altitude(graph, solver):
    shot = shoot()
    assert graph.set(
        "solver", deflection__xi=10.0, deflection__eta=-5.0, altitude=2410.0, altitude_stddev=3.0
    )[0]
    solution, fix, _ = graph.answer(shot)
    # eta turns it by its square too: 4e-5 arcsec
    assert (solution.latitude - fix.latitude) * 3600 == pytest.approx(10, abs=1e-4)
    cos_phi = math.cos(math.radians(fix.latitude))
    assert (solution.longitude - fix.longitude) * 3600 * cos_phi == pytest.approx(-5, abs=1e-3)
    assert (fix.altitude, fix.position_covariance[8]) == (2410.0, 9.0)
    # Whole numbers do.
    assert graph.set("solver", deflection__xi=0, deflection__eta=0, altitude=math.nan)[0]


def test_a_geoid_tells_the_deflection_of_the_place_and_its_error(graph, solver, tmp_path):
    path = tmp_path / "slope.gtx"
    # 1 m a degree to the north.
    heights = np.broadcast_to(np.arange(176)[:, None], (176, 360))
    path.write_bytes(struct.pack(">4d2i", -88, -180, 1, 1, 176, 360) + heights.astype(">f4").tobytes())
    # where the height is known, plumb lines' curvature adds nothing
    assert graph.set("solver", deflection__geoid=str(path), altitude=0.0) == (True, "")
    # It is read once.
    path.unlink()
    done, reason = graph.set("solver", deflection__xi=10.0)
    assert not done and "deflection.geoid" in reason
    solution, fix, _ = graph.answer(shoot())
    assert solution.xi == pytest.approx(-1.86, abs=0.02) and abs(solution.eta) < 1e-3
    assert (solution.latitude - fix.latitude) * 3600 == pytest.approx(solution.xi, abs=1e-4)
    widened = fix.position_covariance[4] - solution.covariance[4]
    # Its least error, in m.
    assert widened == pytest.approx((0.5 * 30.85) ** 2, rel=0.02)
    assert graph.set("solver", deflection__geoid="", altitude=math.nan)[0]
    assert graph.call(Solve, "solver/solve", Solve.Request()).solution.xi == 0


def test_reset_forgets(graph, solver):
    graph.answer(shoot())
    response = graph.call(Trigger, "solver/reset", Trigger.Request())
    assert response.success and response.message
    assert "no frame has arrived" in graph.call(Solve, "solver/solve", Solve.Request()).message


def test_solve_says_why_there_is_no_fix(graph, solver):
    shot = shoot()
    shot.tilts.clear()
    graph.answer(shot)
    response = graph.call(Solve, "solver/solve", Solve.Request())
    assert not response.success and "tilt" in response.message
    assert response.solution.status == Solution.NO_TILT


def test_tilts_that_are_refused_are_one_line_in_the_log_and_a_warning_in_the_diagnostics(graph, solver):
    before = solver.output.count("has no time stamp")
    for _ in range(3):
        shot = shoot()
        graph.answer(shot)
        for tilt in shot.tilts:
            tilt.header.stamp.sec = tilt.header.stamp.nanosec = 0
            graph.tilt.publish(tilt)
        assert graph.state("solver: Inputs", "refused: a tilt message has no time stamp").level == b"\x01"
    assert solver.output.count("has no time stamp") == before + 1


def test_the_diagnostics_follow_the_frame(graph, solver):
    assert graph.set("solver", frame_id="elsewhere")[0]
    graph.wait(lambda: graph.state("solver: Inputs", "").hardware_id == "elsewhere")
    assert graph.set("solver", frame_id="starpos_link")[0]


def test_diagnostics_come_once_a_second_and_name_what_is_missing(graph, solver):
    graph.answer(shoot())
    graph.state("solver: Solution", "fix")
    graph.diagnostics.clear()
    graph.wait(lambda: len(graph.diagnostics.get("solver: Inputs", ())) == 4)
    times = [t for t, _ in graph.diagnostics["solver: Inputs"]]
    # a busy machine delays one or another
    assert np.median(np.diff(times)) == pytest.approx(1.0, abs=0.5)
    assert {"solver: Solution", "solver: Inputs"} <= set(graph.diagnostics)
    assert graph.state("solver: Inputs", "nothing on").level == b"\x01"
