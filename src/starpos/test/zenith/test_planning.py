# SPDX-License-Identifier: Apache-2.0
"""Plans of sessions: what they promise is what the adjustment of such a session claims."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import BEGIN, INSTRUMENT, MARK, VACUUM, drawn

from starpos.earth.orientation import earth_state
from starpos.errors import FixError
from starpos.frames.exposure import GLOBAL_SHUTTER
from starpos.instrument.camera import Camera
from starpos.units import ARCSEC
from starpos.zenith.planning import Planner, Routine, ZenithSky

CAMERA = Camera.from_focal(5616, 3744, 93750.0)
SKY = ZenithSky(stars=40, centroid_rad=0.06 * ARCSEC, catalogue_rad=1e-12, radius_rad=0.02, crossing_s=800.0)


@pytest.fixture(scope="module")
def planner():
    """A planner of sessions as `sessions.drawn` has them."""
    return Planner(
        instrument=replace(INSTRUMENT, shutter=GLOBAL_SHUTTER),
        camera=CAMERA,
        atmosphere=VACUUM,
        mark=MARK,
        sky=SKY,
        routine=Routine(frame_s=5.0, turning_s=65.0, readings=1, level_rad=10 * ARCSEC),
        motion_rad=0.4 * ARCSEC,
        state=earth_state(BEGIN),
    )


def test_a_plan_promises_what_the_adjustment_of_such_sessions_claims(rng, planner):
    plan = planner.plan(2, 6)
    claimed = np.mean([np.mean(drawn(rng).adjusted().sigma_arcsec) for _ in range(10)])
    assert plan.faces == 8 and plan.duration_s == pytest.approx(7 * 65 + 8 * 25 + 5)
    assert np.mean(plan.sigma_arcsec) == pytest.approx(claimed, rel=0.15)


def test_the_quickest_plan_just_reaches_the_wanted_error(planner):
    plan = planner.quickest(0.14)
    assert plan.largest_arcsec <= 0.14
    assert planner.plan(plan.rounds, plan.frames - 1).largest_arcsec > 0.14
    assert planner.plan(plan.rounds + 1, 3).duration_s > plan.duration_s


def test_an_error_that_no_session_reaches_is_refused_with_the_source_that_stays(planner):
    slow = replace(planner, instrument=replace(planner.instrument, clock_stddev_s=0.02))
    with pytest.raises(FixError, match=r"0.1 arcsec is not reached: .* of which clock makes 0\.20"):
        slow.quickest(0.1)


def test_stars_of_the_catalogue_that_pass_average_its_errors(planner):
    wide = replace(planner, sky=replace(SKY, catalogue_rad=0.1 * ARCSEC))
    pole = replace(wide, sky=replace(wide.sky, crossing_s=np.inf))
    passing, standing = ({t[0]: t[1] for t in p.plan(1, 12).terms} for p in (wide, pole))
    # stars that stand never average: 0.1 arcsec over the root of 40
    assert standing["catalogue"] == pytest.approx(0.1 / np.sqrt(40), rel=0.05)
    assert passing["catalogue"] < 0.95 * standing["catalogue"]


def test_the_sky_of_a_site_is_the_catalogues(catalogue):
    sky = ZenithSky.of(catalogue, CAMERA, MARK.latitude, 9.0, 0.1, 2026.0)
    # the paper's field: 23 stars of V < 9 on the mean of the sky
    assert 15 < sky.stars < 35 and 10 < sky.catalogue_rad / ARCSEC * 1000 < 200
    with pytest.raises(FixError, match="wider field"):
        ZenithSky.of(catalogue, Camera.from_focal(200, 200, 93750.0), MARK.latitude, 5.0, 0.1, 2026.0)
