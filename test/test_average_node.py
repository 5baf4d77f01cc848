# SPDX-License-Identifier: Apache-2.0
"""fix_averaged of the running solver: it converges, leaves out what is wrong, and begins anew where it must."""

import math

import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_srvs.srv import Trigger

from starpos.instrument import instrument_file
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos_interfaces.msg import Solution
from starpos_interfaces.srv import SelfCalibrate, Solve
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.places import answer_in, headings, misaligned, moved_m, sigma_m, sigmas, site_at
from starpos_testing.graph.shots import (
    FULL_FOCAL_PX,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    PRESSURE_PA,
    scene_at,
    shoot,
)

SITE = scene_at().site
# The noise of one reading: it is what averages.
TILT_DEG = 0.002


@pytest.fixture(scope="module")
def averaged(graph):
    return graph.hear(NavSatFix, "fix_averaged")


@pytest.fixture(autouse=True)
def fresh(graph, solver):
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success


@pytest.fixture
def rng():
    """Noise that is the same whatever was sent before: of five readings one in twenty scatters by more than it says."""
    return np.random.default_rng(4)


def noisy(rng, azimuth=40.0, off_deg=0.0, **changes):
    """A shot whose tilts have white noise of TILT_DEG, and say so; off_deg: and are all wrong by so much."""
    shot = shoot(azimuth, **changes)
    for tilt in shot.tilts:
        tilt.x = shot.scene.tilt[0] + math.radians(rng.normal(0, TILT_DEG) + off_deg)
        tilt.y = shot.scene.tilt[1] + math.radians(rng.normal(0, TILT_DEG) - off_deg)
        variance = math.radians(TILT_DEG) ** 2
        tilt.covariance = [variance, 0.0, 0.0, variance]
    return shot


def average_after(graph, averaged, *shots):
    for shot in shots:
        assert graph.answer(shot)[0].status == Solution.OK
    return answer_in(graph, averaged, shots[-1])


def check_place(average, site=SITE):
    assert average.status.status == NavSatStatus.STATUS_FIX
    assert sigmas(site, average.latitude, average.longitude, average.position_covariance) < 4


def average_state(graph, text):
    return {v.key: v.value for v in graph.state("solver: Average", text).values}


def test_the_average_of_one_frame_is_its_fix(graph, solver, averaged, rng):
    shot = noisy(rng)
    average = average_after(graph, averaged, shot)
    fix = graph.fixes[shot.stamp][-1]
    assert average.header == fix.header
    assert (average.latitude, average.longitude) == pytest.approx((fix.latitude, fix.longitude), abs=1e-9)
    np.testing.assert_allclose(average.position_covariance, fix.position_covariance, rtol=1e-4, atol=1e-3)


def test_it_converges_and_its_sigma_falls_as_noise_does(graph, solver, averaged, tmp_path, rng):
    path = tmp_path / "instrument.yaml"
    known = Calibration.of((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
    instrument_file.write(
        path,
        Instrument(
            FULL_FOCAL_PX, calibration=known, inclinometer=InclinometerErrors(scale=0.0), clock_stddev_s=0.01
        ),
    )
    assert graph.set("solver", calibration_url=str(path)) == (True, "")
    one = average_after(graph, averaged, noisy(rng))
    many = average_after(graph, averaged, *(noisy(rng) for _ in range(15)))
    check_place(many)
    # 0.002 deg over 5 readings are 99 m, of which 16 frames leave 25; 0.5 arcsec of A3, 15 m, stays, and what 16 frames
    # cannot exclude of a scatter beyond it
    assert 80 < sigma_m(one.position_covariance) < 150
    assert 24 < sigma_m(many.position_covariance) < 45
    values = average_state(graph, "of all frames here")
    assert (values["frames"], values["poses"], values["left out"], values["moved"]) == ("16", "1", "0", "0")
    assert graph.set("solver", calibration_url="")[0]
    assert float(values["sigma east (m)"]) == pytest.approx(many.position_covariance[0] ** 0.5, rel=1e-6)


def test_it_is_geodetic_as_the_fix_is(graph, solver, averaged, rng):
    assert graph.set(
        "solver", deflection__xi=10.0, deflection__eta=-5.0, deflection__stddev=2.0, altitude=2410.0
    )[0]
    shot = noisy(rng)
    average = average_after(graph, averaged, shot)
    fix = graph.fixes[shot.stamp][-1]
    assert (average.latitude, average.longitude) == pytest.approx((fix.latitude, fix.longitude), abs=1e-9)
    assert average.altitude == 2410.0
    astronomic = graph.solutions[shot.stamp][-1]
    assert (astronomic.latitude - average.latitude) * 3600 == pytest.approx(10, abs=1e-3)
    plain = average.position_covariance[4] - astronomic.covariance[4]
    assert plain == pytest.approx((2 * 30.8) ** 2, rel=0.02)
    assert graph.set("solver", deflection__xi=0, deflection__eta=0, deflection__stddev=0, altitude=math.nan)[
        0
    ]


def test_a_burst_of_bad_tilts_does_not_move_it(graph, solver, averaged, rng):
    before = average_after(graph, averaged, *(noisy(rng) for _ in range(8)))
    bad = [noisy(rng, off_deg=0.05) for _ in range(4)]
    for shot in bad:
        answer = graph.answer(shot)[0]
        assert answer.status == Solution.NO_TILT and "at another place than before" in answer.status_text
    # asked again, the frame stays refused
    again = graph.call(Solve, "solver/solve", Solve.Request()).solution
    assert again.status == Solution.NO_TILT and again.stars_matched > 3
    after = average_after(graph, averaged, *(noisy(rng) for _ in range(2)))
    check_place(after)
    moved = moved_m(SITE, after.latitude, after.longitude) - moved_m(SITE, before.latitude, before.longitude)
    assert np.hypot(*moved) < sigma_m(before.position_covariance)
    # It is not of these frames.
    assert {stamp_of(m) for m in averaged}.isdisjoint(shot.stamp for shot in bad)
    assert average_state(graph, "of all frames here")["frames"] == "10"


def test_a_level_that_was_zeroed_is_believed_once_a3_is_another(graph, solver, averaged, rng):
    average_after(graph, averaged, *(noisy(rng) for _ in range(3)))
    for _ in range(3):
        assert graph.answer(noisy(rng, off_deg=0.05))[0].status == Solution.NO_TILT
    # other air confirms no level, another calibration does
    assert graph.set("solver", refraction__pressure=PRESSURE_PA + 100)[0]
    assert graph.answer(noisy(rng, off_deg=0.05))[0].status == Solution.NO_TILT
    assert graph.set("solver", misalignment_stddev=0.5, refraction__pressure=PRESSURE_PA)[0]
    assert graph.call(Solve, "solver/solve", Solve.Request()).solution.status == Solution.OK
    assert graph.answer(noisy(rng, off_deg=0.05))[0].status == Solution.OK


def test_a_move_begins_it_anew(graph, solver, averaged, rng):
    average_after(graph, averaged, *(noisy(rng) for _ in range(6)))
    there = site_at(LATITUDE_DEG + 0.2, LONGITUDE_DEG - 0.1)
    average = average_after(graph, averaged, *(noisy(rng, 130.0, site=there) for _ in range(4)))
    check_place(average, there)
    assert average_state(graph, "has moved")["moved"] == "1"


def test_a_move_after_a_self_calibration_is_noticed_and_a3_goes_along(graph, solver, averaged):
    wrong = misaligned()
    headings(graph, [10, 100, 190, 280], instrument=wrong)
    answer = graph.call(SelfCalibrate, "solver/self_calibrate", SelfCalibrate.Request())
    assert answer.success, answer.message
    there = site_at(LATITUDE_DEG + 0.05, LONGITUDE_DEG)
    made = [shoot(130.0, instrument=wrong, site=there) for _ in range(5)]
    average = average_after(graph, averaged, *made)
    check_place(average, there)
    assert sigma_m(average.position_covariance) < 200
    assert average_state(graph, "has moved")["moved"] == "1"
    assert graph.set("solver", misalignment=[0, 0, 0])[0]


def test_driving_from_place_to_place_is_not_turning_on_the_spot(graph, solver, averaged):
    assert graph.set("solver", self_calibration=True)[0]
    for k, azimuth in enumerate((10, 130, 220, 300, 60)):
        site = site_at(LATITUDE_DEG + 0.02 * k, LONGITUDE_DEG - 0.01 * k**2)
        for shot, solution in headings(graph, [azimuth], instrument=misaligned(), site=site):
            assert sigma_m(solution.covariance) > 100e3
            assert sigma_m(answer_in(graph, averaged, shot).position_covariance) > 100e3
    assert graph.state("solver: Calibration", "not known")
    assert graph.set("solver", self_calibration=False)[0]
    # whatever a calibration that is still under way may find: it is of this test
    assert graph.set("solver", misalignment=[0, 0, 0])[0]


def test_turning_on_the_spot_is_no_move(graph, solver, averaged, rng):
    average = average_after(graph, averaged, *(noisy(rng, a) for a in (0, 0, 90, 90, 180, 180, 270, 270)))
    check_place(average)
    values = average_state(graph, "of all frames here")
    assert (values["frames"], values["poses"]) == ("8", "4")


@pytest.mark.parametrize(
    "parameters",
    [
        {"refraction__pressure": PRESSURE_PA},
        {"misalignment_stddev": 0.5},
        {"clock_stddev": 0.01},
        {"calibration_url": ""},
    ],
)
def test_another_instrument_or_other_air_begins_it_anew(graph, solver, averaged, parameters, rng):
    shots = [noisy(rng) for _ in range(3)]
    average_after(graph, averaged, *shots)
    assert graph.set("solver", **parameters)[0]
    # The same frame adds nothing new, and does no harm.
    graph.send(shots[-1])
    average_after(graph, averaged, noisy(rng))
    assert average_state(graph, "of all")["frames"] == "1"


def test_reset_and_a_bag_played_again_begin_it_anew(graph, solver, averaged, rng):
    shots = [noisy(rng) for _ in range(4)]
    average_after(graph, averaged, *shots)
    assert average_state(graph, "of all")["frames"] == "4"
    # The same frame twice counts once.
    graph.solutions.pop(shots[-1].stamp)
    assert graph.answer(shots[-1])[0].status == Solution.OK
    for shot in shots:
        graph.solutions.pop(shot.stamp)
    # Frames that come late are like this: not before the third are they known for others.
    for shot in shots:
        assert graph.answer(shot)[0].status == Solution.OK
    graph.wait(lambda: average_state(graph, "of all")["frames"] == "2")
    assert graph.call(Trigger, "solver/reset", Trigger.Request()).success
    assert graph.state("solver: Average", "no fix yet")


def test_frames_without_a_fix_leave_it_alone(graph, solver, averaged, rng):
    average_after(graph, averaged, noisy(rng), noisy(rng))
    shot = noisy(rng)
    shot.tilts.clear()
    assert graph.answer(shot)[0].status == Solution.NO_TILT
    assert average_state(graph, "of all")["frames"] == "2"


def test_an_a3_of_which_little_is_known_is_not_averaged_over_headings(graph, solver, averaged):
    """A linear filter would make 100 m of it that are 70 km off."""
    assert graph.set("solver", misalignment_stddev=36000.0)[0]
    wrong = misaligned((1.5, -2.0, 130.0))
    for shot, _ in headings(graph, [0, 90, 180], instrument=wrong):
        average = answer_in(graph, averaged, shot)
        assert sigma_m(average.position_covariance) > 100e3
        check_place(average)
    assert graph.set("solver", misalignment_stddev=0.5)[0]
