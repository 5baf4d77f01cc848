# SPDX-License-Identifier: Apache-2.0
"""The running solver finds its own calibration: at a known place, by turning on the spot; and keeps it in a file."""

import math
import signal
from dataclasses import replace

import numpy as np
import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import NavSatFix
from std_srvs.srv import Trigger

from starpos.instrument import instrument_file
from starpos.instrument.instrument import Calibration, Instrument
from starpos_interfaces.msg import Solution
from starpos_interfaces.srv import Calibrate, SaveCalibration, SelfCalibrate
from starpos_testing.graph.places import answer_in, headings, misaligned, moved_m, sigma_m, sigmas, site_at
from starpos_testing.graph.shots import (
    FULL_FOCAL_PX,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    PRESSURE_PA,
    SOLVER,
    START_S,
    scene_at,
    shoot,
)

HERE = {"latitude": LATITUDE_DEG, "longitude": LONGITUDE_DEG}
# The place of the parameters' A3 of zeros.
WRONG = misaligned()
SITE = scene_at().site


@pytest.fixture(autouse=True)
def fresh(graph, solver):
    """No frames, and the calibration of the parameters."""
    if solver.process.poll() is None:
        assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
        assert graph.set("solver", misalignment=[0, 0, 0], calibration_url="", self_calibration=False)[0]


def calibrate(graph, **request):
    return graph.call(Calibrate, "solver/calibrate", Calibrate.Request(**(HERE | request)))


def self_calibrate(graph):
    return graph.call(SelfCalibrate, "solver/self_calibrate", SelfCalibrate.Request())


def end(graph, solver):
    """The one that the tests before have shared."""
    if solver in graph.processes:
        graph.processes.remove(solver)
        solver.end()


def save(graph, path=""):
    return graph.call(SaveCalibration, "solver/save_calibration", SaveCalibration.Request(path=str(path)))


def check_fix(graph, azimuth, within_m, **changes):
    """Check that the next fix is near the true place, and as near as it claims; its shot."""
    shot = shoot(azimuth, instrument=WRONG, **changes)
    solution = graph.answer(shot)[0]
    assert solution.status == Solution.OK, solution.status_text
    there = solution.latitude, solution.longitude
    assert np.hypot(*moved_m(shot.scene.site, *there)) < within_m
    assert sigmas(shot.scene.site, *there, solution.covariance) < 4
    return shot


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"latitude": math.nan}, "latitude nan"),
        ({"latitude": 91.0}, "latitude 91"),
        ({"longitude": math.inf}, "longitude inf"),
        ({"longitude": -361.0}, "longitude -361"),
        ({"frames": 2**32 - 1}, "calibration_frames"),
        ({"frames": 7}, "only 2 of 7 frames"),
    ],
)
def test_a_place_or_a_count_that_cannot_be_is_refused(graph, solver, request_, words):
    headings(graph, [40], 2)
    answer = calibrate(graph, **request_)
    assert not answer.success and words in answer.message
    assert np.isnan(answer.misalignment_deg).all() and np.isnan(answer.covariance_deg2).all()
    assert graph.answer(shoot())[0].status == Solution.OK


def test_reset_forgets_the_frames(graph, solver):
    headings(graph, [40], 2)
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    assert "only 0 frames" in calibrate(graph).message


def test_frames_are_solved_while_a_calibration_is_worked_out_and_a_second_one_is_refused(graph, solver):
    headings(graph, [40, 120, 200, 280], 8, instrument=WRONG)
    client = graph.node.create_client(Calibrate, "solver/calibrate")
    graph.wait(client.service_is_ready)
    first, second = (client.call_async(Calibrate.Request(**HERE)) for _ in range(2))
    # The refusal: the other one is at work.
    graph.wait(lambda: first.done() or second.done())
    shot = shoot(40.0, instrument=WRONG)
    graph.send(shot)
    graph.wait(lambda: shot.stamp in graph.solutions)
    assert not (first.done() and second.done()), "the frame waited for it, or too few frames made it short"
    graph.wait(lambda: first.done() and second.done())
    (done,) = (f.result() for f in (first, second) if f.result().success)
    (refused,) = (f.result() for f in (first, second) if not f.result().success)
    assert "A3 of 32 frames" in done.message and "another calibration" in refused.message
    assert calibrate(graph, frames=1).success


def test_what_is_set_while_a_calibration_is_worked_out_holds(graph, solver):
    headings(graph, [40, 120, 200, 280], 8, instrument=WRONG)
    client = graph.node.create_client(Calibrate, "solver/calibrate")
    setter = graph.node.create_client(SetParametersAtomically, "/solver/set_parameters_atomically")
    graph.wait(lambda: client.service_is_ready() and setter.service_is_ready())
    first, second = (client.call_async(Calibrate.Request(**HERE)) for _ in range(2))
    # The refusal: the other one is at work.
    graph.wait(lambda: first.done() or second.done())
    change = Parameter("misalignment", value=[0.1, 0.1, 0.1]).to_parameter_msg()
    done = setter.call_async(SetParametersAtomically.Request(parameters=[change]))
    graph.wait(lambda: done.done() and first.done() and second.done())
    assert done.result().result.successful
    assert not first.result().success and not second.result().success
    assert "meanwhile" in first.result().message + second.result().message


def test_headings_on_the_spot_tell_place_and_a3(graph, solver):
    headings(graph, [10, 100, 190, 280], instrument=WRONG)
    averaged = graph.hear(NavSatFix, "fix_averaged")
    answer = self_calibrate(graph)
    assert answer.success and answer.headings == 4, answer.message
    assert sigmas(SITE, answer.latitude, answer.longitude, answer.covariance) < 4
    assert sigma_m(answer.covariance) < 60
    assert 0 < answer.plumb_stddev < 3 / 3600
    shot = check_fix(graph, 60, within_m=100)
    average = answer_in(graph, averaged, shot)
    # the fix shares A3 with the place found by the turn: that stays
    place = (answer.latitude, answer.longitude)
    assert (average.latitude, average.longitude) == pytest.approx(place, abs=1e-11)
    claimed = np.reshape(average.position_covariance, (3, 3))[:2, :2].ravel()
    assert list(claimed) == pytest.approx(list(answer.covariance), rel=1e-12)
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    # A reset does not lose it.
    check_fix(graph, 60, within_m=100)
    assert graph.set("solver", misalignment=[0, 0, 0])[0]
    lost = graph.answer(shoot(60, instrument=WRONG))[0]
    assert np.hypot(*moved_m(SITE, lost.latitude, lost.longitude)) > 10e3


@pytest.mark.parametrize(
    ("azimuths", "words"), [([], "0 headings"), ([40], "1 heading "), ([40, 220], "2 headings")]
)
def test_too_few_headings_are_refused_and_change_nothing(graph, solver, azimuths, words):
    headings(graph, azimuths, instrument=WRONG)
    answer = self_calibrate(graph)
    assert not answer.success and words in answer.message
    lost = graph.answer(shoot(40, instrument=WRONG))[0]
    assert np.hypot(*moved_m(SITE, lost.latitude, lost.longitude)) > 10e3


def test_the_mode_is_wide_until_the_headings_tell_and_right_then(graph, solver):
    assert graph.set("solver", self_calibration=True)[0]
    averaged = graph.hear(NavSatFix, "fix_averaged")
    for azimuth in (10, 100, 190):
        shot, solution = headings(graph, [azimuth], instrument=WRONG)[-1]
        wide = answer_in(graph, averaged, shot)
        for place, covariance in ((solution, solution.covariance), (wide, wide.position_covariance)):
            assert sigma_m(covariance) > 100e3
            assert sigmas(SITE, place.latitude, place.longitude, covariance) < 4
    assert not save(graph, "/nowhere/x.yaml").success
    assert graph.state("solver: Calibration", "not known").level == b"\x01"
    headings(graph, [280], instrument=WRONG)
    values = {v.key: v.value for v in graph.state("solver: Calibration", "A3 of 4 frames").values}
    assert values["headings"] == "4"
    average = answer_in(graph, averaged, check_fix(graph, 60, within_m=100))
    assert sigma_m(average.position_covariance) < 60
    assert sigmas(SITE, average.latitude, average.longitude, average.position_covariance) < 4


def test_an_a3_whose_error_nobody_stated_is_a_warning_and_is_not_saved(graph, solver):
    assert graph.set("solver", misalignment_stddev=math.nan)[0]
    _, solution = headings(graph, [40], 1, instrument=WRONG)[-1]
    assert solution.status == Solution.OK and sigma_m(solution.covariance) > 1e6
    assert graph.state("solver: Calibration", "misalignment_stddev").level == b"\x01"
    assert "not known" in save(graph, "/nowhere/x.yaml").message
    assert graph.set("solver", misalignment_stddev=0.5)[0]
    assert graph.state("solver: Calibration", "from the parameters").level == b"\x00"


def test_a_calibration_of_another_camera_info_counts_as_unknown(graph, solver):
    headings(graph, [40, 220], 1, instrument=WRONG)
    assert calibrate(graph).success
    shot = shoot(instrument=WRONG)
    shot.info.k[2] += 20.0
    wide = graph.answer(shot)[0]
    assert wide.status == Solution.OK and sigma_m(wide.covariance) > 100e3
    assert "not known" in save(graph, "/nowhere/x.yaml").message
    assert "only 1 of 2" in calibrate(graph, frames=2).message


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("", "calibration_url"),
        ("beside.yaml", "full path"),
        ("/dev/null/x.yaml", "/dev/null/x.yaml"),
        ("/" + 300 * "x", "cannot be written"),
    ],
)
def test_where_a_calibration_cannot_go_it_says_so(graph, solver, path, words):
    headings(graph, [40], 1)
    answer = save(graph, path)
    assert not answer.success and words in answer.message


def test_a_file_that_is_no_instrument_file_is_not_replaced(graph, solver, tmp_path):
    headings(graph, [40], 1)
    other = tmp_path / "diary.txt"
    other.write_text("dear diary")
    assert not save(graph, other).success
    assert other.read_text() == "dear diary"
    assert not save(graph, tmp_path).success


def instrument_at(path, focal_px=FULL_FOCAL_PX, **calibration):
    """A file of the true instrument."""
    calibration = replace(Calibration.of(WRONG.calibration.misalignment_deg, (1.0,) * 3), **calibration)
    instrument_file.write(path, Instrument(focal_px, calibration=calibration))
    return str(path)


def test_a_calibration_is_saved_where_calibration_url_says_and_used_on(graph, solver, tmp_path):
    headings(graph, [40, 130], 1, instrument=WRONG)
    path = instrument_at(tmp_path / "instrument.yaml", misalignment_deg=(1.0, 1.0, 1.0))
    assert graph.set("solver", calibration_url=path) == (True, "")
    assert calibrate(graph).success
    assert save(graph).success
    assert instrument_file.read(path).calibration.frames == 2
    # The file, now the saved one, wins.
    assert graph.set("solver", misalignment=[5.0, 5.0, 5.0])[0]
    check_fix(graph, 250, within_m=100)


def test_a_stale_calibration_is_refused_in_frames_and_diagnostics_and_made_anew(graph, solver, tmp_path):
    path = instrument_at(tmp_path / "old.yaml", utc_unix_s=START_S - 100 * 86400, valid_days=30.0)
    assert graph.set("solver", calibration_url=path) == (True, "")
    for _ in range(3):
        solution = graph.answer(shoot(instrument=WRONG))[0]
        assert solution.status == Solution.BAD_INPUT and "100 days from this frame" in solution.status_text
    assert graph.state("solver: Solution", "calibrate again").level == b"\x01"
    assert calibrate(graph, frames=3).success
    check_fix(graph, 40, within_m=100)


def test_an_instrument_file_of_another_camera_is_refused(graph, solver, tmp_path):
    graph.answer(shoot())
    path = instrument_at(tmp_path / "other.yaml", focal_px=FULL_FOCAL_PX * 1.06)
    done, reason = graph.set("solver", calibration_url=path)
    assert not done and "another camera" in reason and "other.yaml" in reason
    near = instrument_at(tmp_path / "near.yaml", focal_px=FULL_FOCAL_PX * 1.04)
    assert graph.set("solver", calibration_url=near)[0]


def test_a_wrong_a3_is_found_at_a_known_place_saved_and_right_elsewhere(graph, solver, run, tmp_path):
    _, before = headings(graph, [40, 160], 3, instrument=WRONG)[-1]
    assert np.hypot(*moved_m(SITE, before.latitude, before.longitude)) > 10e3
    assert graph.set("solver", calibration_turn_stddev=1.0)[0]
    answer = calibrate(graph, frames=5)
    assert answer.success, answer.message
    assert "A3 of 5 frames" in answer.message
    stddev = np.sqrt(np.diag(np.reshape(answer.covariance_deg2, (3, 3))))
    assert np.all(
        np.abs(np.subtract(answer.misalignment_deg, WRONG.calibration.misalignment_deg)) < 4 * stddev
    )
    check_fix(graph, 250, within_m=100)
    path = tmp_path / "instrument.yaml"
    assert save(graph, path).success
    saved = instrument_file.read(path).calibration
    np.testing.assert_allclose(saved.misalignment_deg, answer.misalignment_deg, rtol=1e-12)
    assert saved.frames == 5 and math.isfinite(saved.valid_days)
    end(graph, solver)
    run("starpos_solver", "solver", *SOLVER, f"calibration_url:=file://{path}")
    graph.wait_for_solver()
    check_fix(graph, 300, within_m=100, site=site_at(47.0, 8.5))


def test_a_solver_started_with_the_file_of_another_camera_says_so_until_it_is_given_the_right_one(
    graph, solver, run, tmp_path
):
    end(graph, solver)
    path = instrument_at(tmp_path / "other.yaml", focal_px=FULL_FOCAL_PX / 2)
    run("starpos_solver", "solver", *SOLVER, f"calibration_url:={path}")
    graph.wait_for_solver()
    shot = shoot(instrument=WRONG)
    solution = graph.answer(shot)[0]
    assert solution.status == Solution.BAD_INPUT and "another camera" in solution.status_text
    right = instrument_at(tmp_path / "right.yaml")
    # The file in use holds up nothing else.
    assert graph.set("solver", refraction__pressure=0.0)[0]
    assert graph.set("solver", calibration_url=right, refraction__pressure=PRESSURE_PA)[0]
    graph.wait(lambda: graph.answer(shoot(instrument=WRONG))[0].status == Solution.OK)


def test_a_solver_told_to_end_amid_a_calibration_ends_cleanly(graph, solver, run):
    end(graph, solver)
    process = run("starpos_solver", "solver", *SOLVER)
    graph.wait_for_solver()
    headings(graph, [40, 120, 200], 6, instrument=WRONG)
    client = graph.node.create_client(Calibrate, "solver/calibrate")
    graph.wait(client.service_is_ready)
    client.call_async(Calibrate.Request(**HERE))
    shot = shoot(40.0, instrument=WRONG)
    graph.send(shot)
    graph.wait(lambda: shot.stamp in graph.solutions)
    process.signal(signal.SIGINT)
    assert process.wait() == 0
    assert "Traceback" not in process.output
