# SPDX-License-Identifier: Apache-2.0
"""The camera's attitude by its stars: right, with a claim that holds, without tilts too, and none of doubtful stars."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos.earth.ellipsoid import enu_axes
from starpos.earth.refraction import Atmosphere
from starpos.messages.stars import message_to_attitude
from starpos.navigation.sightings import PlacelessFrame
from starpos_interfaces.msg import Attitude, Solution
from starpos_testing.graph.graph import stamp_of
from starpos_testing.graph.shots import (
    FRAME,
    HUMIDITY,
    LATITUDE_DEG,
    LONGITUDE_DEG,
    PRESSURE_PA,
    TEMPERATURE_C,
    shoot,
)

AIR = Atmosphere(pressure_pa=PRESSURE_PA, temperature_c=TEMPERATURE_C, humidity=HUMIDITY)


@pytest.fixture(scope="module")
def attitudes(graph, solver):
    heard = graph.hear(Attitude, "attitude")
    graph.wait(lambda: graph.node.count_publishers("attitude") == 1)
    return heard


def came(graph, attitudes, shot) -> Attitude:
    graph.wait(lambda: shot.stamp in map(stamp_of, attitudes), "for the attitude")
    return next(m for m in attitudes if stamp_of(m) == shot.stamp)


def nees(message, shot) -> float:
    """Squared error under the shot's sky in units of the claim: chi-squared of three degrees of freedom."""
    enu = enu_axes(*np.radians([LATITUDE_DEG, LONGITUDE_DEG]))
    seen, _ = PlacelessFrame.of(message_to_attitude(message)).under(enu[2], AIR)
    off = Rotation.from_matrix(seen.rotation.T @ enu.T @ shot.scene.attitude).as_rotvec()
    # `off` is about the axes of the camera
    return float(off @ np.linalg.solve(seen.covariance_about_own, off))


def test_the_attitude_is_the_cameras_and_its_claim_holds(graph, attitudes):
    scores = []
    for azimuth_deg in (40.0, 130.0, 220.0, 310.0):
        shot = shoot(azimuth_deg)
        solution, _, _ = graph.answer(shot)
        message = came(graph, attitudes, shot)
        assert message.header.frame_id == FRAME
        assert message.stars_matched >= solution.stars_matched and message.log_odds == solution.log_odds
        scores.append(nees(message, shot))
    # of twelve degrees of freedom one in a million is beyond 54
    assert sum(scores) < 54, scores


def test_it_comes_without_a_tilt(graph, attitudes):
    shot = shoot()
    shot.tilts.clear()
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.NO_TILT
    assert nees(came(graph, attitudes, shot), shot) < 31


def test_stars_of_two_skies_have_none(graph, attitudes):
    shot, other = shoot(), shoot(100.0)
    shot.stars.stars = sorted([*shot.stars.stars, *other.stars.stars], key=lambda s: -s.flux)
    solution, _, _ = graph.answer(shot)
    assert solution.status == Solution.POOR_FIT and "two_skies" in solution.warnings
    # what comes after it is heard after it
    after = shoot()
    graph.answer(after)
    came(graph, attitudes, after)
    assert shot.stamp not in map(stamp_of, attitudes)
