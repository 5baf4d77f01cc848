# SPDX-License-Identifier: Apache-2.0
"""The chain from stars and tilt to a solution: what is known, and not known, of the time."""

from dataclasses import replace

import numpy as np
import pytest
from solved_night import refused

from starpos.averaging.average import average
from starpos.earth.orientation import earth_state
from starpos.fix.solution import Status
from starpos.night.remarks import of_extrapolation
from starpos.units import ARCSEC, utc_text
from starpos_testing.skies.scenes import EXPOSURE, START, solver_of, stars_of, tilt_of, wide_scene


def test_what_a_host_says_of_its_clock_widens_the_fix_and_never_narrows_it(catalogue, rng):
    scene = wide_scene()
    stars, tilt, solver = stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
    metres_per_s = 465.1 * np.cos(np.radians(scene.site.latitude_deg))

    def claimed_s(name, **told):
        terms = {t.name: t for t in solver.solve(replace(stars, **told), tilt).fix.terms}
        return np.sqrt(terms[name].covariance[0, 0]) / metres_per_s

    own = solver.instrument.clock_stddev_s
    assert claimed_s("clock") == pytest.approx(own, rel=0.01)
    assert claimed_s("clock", clock_stddev_s=16.0) == pytest.approx(16.0, rel=0.01)
    assert claimed_s("clock", clock_stddev_s=own / 10) == pytest.approx(own, rel=0.01)
    assert claimed_s("time stamp") == 0
    assert claimed_s("time stamp", stamp_stddev_s=0.29) == pytest.approx(0.29, rel=0.01)


def test_what_is_not_known_of_the_time_does_not_average(catalogue, rng):
    """An unmeasured lag is the same in every frame."""
    scene = wide_scene(tilt_noise_deg=0.0)
    stars, tilt, solver = stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
    for told in ({"stamp_stddev_s": 1.0}, {"clock_stddev_s": 1.0}):
        fix = solver.solve(replace(stars, **told), tilt).fix
        many = average([replace(fix, utc_unix_s=fix.utc_unix_s + k) for k in range(25)])
        assert many.covariance[0, 0] > 0.9 * (465.1 * np.cos(fix.latitude)) ** 2


def test_a_stamp_that_is_too_early_puts_the_place_too_far_east(catalogue, rng):
    scene = wide_scene(tilt_noise_deg=0.0)
    stars, tilt, solver = stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
    late = solver.solve(stars, tilt).fix
    early = solver.solve(replace(stars, mid_unix_s=stars.mid_unix_s - 10.0), tilt).fix
    assert (early.longitude - late.longitude) / ARCSEC == pytest.approx(150.4, abs=0.3)


@pytest.mark.parametrize("utc", [4e7, 4e9, -1e12, 1e300])
def test_time_outside_the_tables(utc, night):
    _, stars, tilt, solver = night
    late = replace(stars, mid_unix_s=utc)
    message = refused(solver.solve(late, tilt), Status.TIME_OUTSIDE_TABLES)
    assert f"{utc_text(utc)} lies outside the IERS tables (1973 to 20" in message
    assert "check the frame's clock" in message


def test_simulated_time_is_called_so(night):
    _, stars, tilt, solver = night
    message = refused(solver.solve(replace(stars, mid_unix_s=12.5), tilt), Status.TIME_OUTSIDE_TABLES)
    assert "a time of 12.500 s after 1970 is no date" in message and "simulated time" in message


# 1950, 1970, 2034.
@pytest.mark.parametrize("utc", [-6.3e8, 0.0, 2.05e9])
def test_a_pointing_needs_no_tables(utc, night):
    _, stars, _, solver = night
    s = solver.identify(replace(stars, mid_unix_s=utc))
    assert s.ok, s.message
    assert s.pointing.dec == pytest.approx(solver.identify(stars).pointing.dec, abs=60 * ARCSEC)


@pytest.mark.parametrize("utc", [-3e9, 4.2e9, 1e300])
def test_a_pointing_of_an_impossible_date(utc, night):
    _, stars, _, solver = night
    s = solver.identify(replace(stars, mid_unix_s=utc))
    assert "between 1900 and 2100" in refused(s, Status.TIME_OUTSIDE_TABLES)


def test_a_fix_beyond_the_tables_says_by_how_much(night, catalogue, rng):
    scene, stars, tilt, solver = night
    # Whatever table is installed.
    within = replace(solver.solve(stars, tilt), extrapolated_days=0.0)
    now = earth_state(START).orientation.extrapolated_days
    later = START + (700 - now) * 86400
    s = solver.solve(stars_of(scene, catalogue, rng, later), tilt_of(scene, rng, later))
    assert s.ok, s.message
    assert s.extrapolated_days == earth_state(later + EXPOSURE / 2).orientation.extrapolated_days > 0
    assert of_extrapolation([within]) == of_extrapolation([]) == ""
    remark = of_extrapolation([s, within, s])
    east = 465.1 * np.cos(s.fix.latitude) * earth_state(later).orientation.ut1_sigma_s
    assert remark.startswith(f"the Earth's rotation is extrapolated {s.extrapolated_days:.0f} days")
    assert f"{east:.0f} m east" in remark


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("night/a.fits", "DATE-OBS with an hour, and EXPTIME"),
        ("a.csv", "DATE-OBS with an hour, and EXPTIME"),
        ("a.PNG", "a .png file carries none in UTC: give FITS"),
        ("a.tiff", "give FITS"),
        ("a.nef", "give FITS"),
        ("stars", "stars: no time of exposure: its header stamp is missing"),
        ("", "the frame: no time of exposure: its header stamp"),
    ],
)
def test_a_frame_without_a_time_is_told_what_it_lacks(source, words, night):
    _, stars, tilt, solver = night
    message = refused(solver.solve(replace(stars, mid_unix_s=None, source=source), tilt), Status.BAD_INPUT)
    assert words in message
