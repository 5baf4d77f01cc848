# SPDX-License-Identifier: Apache-2.0
"""The chain from stars and tilt to a solution, and every way it can fail."""

import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import erfa
import numpy as np
import pytest
from solved_night import off_by_sigma, refused

from starpos.earth.orientation import earth_state, station_velocity
from starpos.errors import TiltError
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.frame import SATURATED, Stars, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import EXACT, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import (
    EXPOSURE,
    FOCAL_PX,
    SIZE,
    START,
    random_attitude,
    random_stars,
    solver_of,
    stars_of,
    tilt_of,
    wide_scene,
    with_false_stars,
)


def test_a_fix(night):
    scene, stars, tilt, solver = night
    s = solver.solve(stars, tilt)
    assert (s.status, s.message, s.stars_detected) == (Status.OK, "fix", len(stars))
    position, heading = off_by_sigma(s.fix, scene)
    assert position < 4
    assert heading < 4
    assert len(s.names) == len(s.star) == len(s.fix.used) > 50
    assert s.tilt is tilt
    assert s.utc_unix_s == START + EXPOSURE / 2


@pytest.mark.parametrize(
    "where",
    [{"latitude_deg": -24.6, "longitude_deg": -70.4, "pointing_deg": (205.0, 71.0, 133.0)},
     {"latitude_deg": 78.2, "longitude_deg": 15.6, "pointing_deg": (0.0, 90.0, 0.0)},
     {"latitude_deg": 0.0, "longitude_deg": 180.0, "pointing_deg": (300.0, 68.0, -77.0),
      "misalignment_deg": (0.4, -0.9, 91.0)}],
)  # fmt: skip
def test_fixes_anywhere_without_tilt_noise_are_good_to_the_stars(where, catalogue, rng):
    scene = wide_scene(tilt_noise_deg=0.0, **where)
    s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
    assert s.ok, s.message
    position, heading = off_by_sigma(s.fix, scene)
    assert position < 4
    assert heading < 4
    assert abs(s.fix.latitude - np.radians(scene.site.latitude_deg)) < 3 * ARCSEC


def test_over_many_nights_the_claims_hold(catalogue, rng):
    """Chi-square of 16 fixes with the inclinometer's noise, whole chain."""
    position, heading = [], []
    for _ in range(16):
        scene = wide_scene(
            latitude_deg=float(rng.uniform(-65, 65)), longitude_deg=float(rng.uniform(-180, 180)),
            pointing_deg=(float(rng.uniform(0, 360)), float(rng.uniform(68, 85)), float(rng.uniform(0, 360))),
        )  # fmt: skip
        exact = replace(
            scene.instrument,
            calibration=Calibration.of(scene.instrument.calibration.misalignment_deg, (0.0,) * 3),
            inclinometer=replace(EXACT, noise_rad=1e-9),
            clock_stddev_s=0.0,
        )
        scene = replace(scene, instrument=exact)
        s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
        assert s.ok, s.message
        p, h = off_by_sigma(s.fix, scene)
        position.append(p**2 / 2)
        heading.append(h**2)
    assert np.mean(position) == pytest.approx(1, abs=4 / np.sqrt(16))
    assert np.mean(heading) < 1 + 4 * np.sqrt(2 / 16)


def test_pixels_that_are_not_square_and_a_lens_that_distorts(catalogue, rng):
    camera = Camera(
        width=SIZE[0], height=SIZE[1], fx=FOCAL_PX, fy=FOCAL_PX * 1.03, cx=510.0, cy=330.0,
        distortion=(-0.3, 0.2, 1e-3, -1e-3, 0.0),
    )  # fmt: skip
    scene = wide_scene(tilt_noise_deg=0.0)
    scene = replace(scene, camera=camera, instrument=replace(scene.instrument, camera=camera))
    s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
    assert s.ok, s.message
    assert off_by_sigma(s.fix, scene)[0] < 4
    assert s.pointing.residual_arcsec < 0.1 * camera.scale_arcsec


def test_the_ultra_wide_lens_of_a_telephone(catalogue, rng):
    """118 deg from corner to corner, as of 13 mm on film."""
    scene = wide_scene(limit_mag=4.0, tilt_noise_deg=0.0, focal_px=365.0, pointing_deg=(140.0, 65.0, 20.0))
    s = solver_of(scene, catalogue).solve(stars_of(scene, catalogue, rng), tilt_of(scene, rng))
    assert s.ok, s.message
    position, heading = off_by_sigma(s.fix, scene)
    assert position < 4 and heading < 4


def test_the_tilt_is_asked_for_the_exposure(night):
    _, stars, tilt, solver = night
    asked = []

    def average(mid, exposure, spread):
        asked.append((mid, exposure))
        return tilt

    assert (
        solver.solve(stars, SimpleNamespace(average=average)).fix.latitude
        == solver.solve(stars, tilt).fix.latitude
    )
    assert asked == [(START + EXPOSURE / 2, EXPOSURE)]


def test_identify_gives_the_pointing_of_the_frames_centre(night, catalogue):
    scene, stars, _, solver = night
    s = solver.identify(stars)
    assert s.ok
    a = s.pointing
    # where a star stands that is seen in the centre: refraction, diurnal aberration and, by ERFA, A1 taken off
    state, site = earth_state(stars.mid_unix_s), scene.site
    itrs = site.atmosphere.refraction().unbend(scene.attitude[:, 2]) @ site.enu - station_velocity(
        site.enu[2]
    )
    ra, dec = erfa.aticq(*erfa.c2s(itrs @ state.cirs_to_itrs), state.astrom)
    # 0.1 px.
    assert (a.ra, a.dec) == pytest.approx((ra, dec), abs=4 * ARCSEC)
    assert a.focal_px == pytest.approx(FOCAL_PX, rel=3e-3)
    assert not a.mirrored
    state_free = solver.identify(replace(stars, mid_unix_s=None))
    assert state_free.ok
    # without a time neither aberration nor proper motion: 21 arcsec at most, and some
    d_dec = abs(state_free.pointing.dec - a.dec) / ARCSEC
    d_ra = abs(state_free.pointing.ra - a.ra) * np.cos(a.dec) / ARCSEC
    assert 0.1 < np.hypot(d_ra, d_dec) < 23


def test_the_window_of_a_frame_counts_with_and_without_its_directions(night):
    _, stars, tilt, solver = night
    width = stars.width // 3
    shown = stars.select(np.flatnonzero(stars.x < width))
    windowed = replace(shown, window=(0, 0, width, stars.height))
    for ask in (solver.identify, lambda s: solver.solve(s, tilt)):
        assert ask(windowed).pointing.log_odds > ask(shown).pointing.log_odds + 10


def test_right_ascension_and_roll_are_in_a_full_turn(catalogue, rng):
    camera = Camera.from_focal(*SIZE, FOCAL_PX)
    solver = Solver(Instrument(FOCAL_PX), catalogue)
    for _ in range(8):
        attitude = random_attitude(rng)
        index = catalogue.cone(attitude[2], camera.half_diagonal_rad, 7.0)
        x, y = camera.project(catalogue.directions(index, 2000.0) @ attitude.T).T
        on = (x > 0) & (x < camera.width - 1) & (y > 0) & (y < camera.height - 1)
        listed = replace(random_stars(on.sum(), rng, mid_unix_s=None), x=x[on], y=y[on])
        found = solver.identify(listed).pointing
        assert found.ra == pytest.approx(np.arctan2(attitude[2, 1], attitude[2, 0]) % (2 * np.pi), abs=1e-4)
        assert 0 <= found.roll < 2 * np.pi


def test_a_mirrored_frame_has_a_pointing_but_no_fix(night):
    _, stars, tilt, solver = night
    flipped = replace(stars, y=SIZE[1] - 1 - stars.y)
    straight, mirrored = solver.identify(stars).pointing, solver.identify(flipped).pointing
    assert mirrored.mirrored
    assert (mirrored.ra, mirrored.dec) == pytest.approx((straight.ra, straight.dec), abs=5 * ARCSEC)
    assert "mirrored" in refused(solver.solve(flipped, tilt), Status.BAD_INPUT)


def test_false_bright_stars_do_no_harm(night):
    scene, stars, tilt, solver = night
    dirty = with_false_stars(stars, np.array([[100.0, 600.0], [777.0, 50.0]]))
    s = solver.solve(dirty, tilt)
    assert s.ok
    assert off_by_sigma(s.fix, scene)[0] < 4
    assert s.star.min() >= 2


def test_too_few_stars(night):
    _, stars, tilt, solver = night
    for n in range(4):
        assert "at least 4" in refused(solver.solve(stars.select(slice(0, n)), tilt), Status.TOO_FEW_STARS)
        assert solver.identify(stars.select(slice(0, n))).status is Status.TOO_FEW_STARS
    burnt = no_stars(*SIZE, mid_unix_s=START, exposure_s=EXPOSURE)
    assert "0 stars detected" in refused(solver.solve(burnt, tilt), Status.TOO_FEW_STARS)
    saturated = replace(stars.select(slice(0, 3)), flags=np.full(3, SATURATED))
    assert "3 saturated" in refused(solver.solve(saturated, tilt), Status.TOO_FEW_STARS)


def test_not_identified(night, rng):
    _, _, tilt, solver = night
    message = refused(solver.solve(random_stars(40, rng), tilt), Status.NOT_IDENTIFIED)
    assert "focal length" in message
    assert "4636" in message


def test_a_wrong_focal_length_is_not_identified_and_says_which_was_given(night, catalogue):
    _, stars, tilt, _ = night
    wrong = Solver(Instrument(FOCAL_PX * 1.3), catalogue)
    assert "6027 px given" in refused(wrong.solve(stars, tilt), Status.NOT_IDENTIFIED)


def test_a_focal_length_that_is_none(night, catalogue):
    _, stars, tilt, _ = night
    for focal in (50.0, 1e7):
        assert "deg across" in refused(
            Solver(Instrument(focal), catalogue).solve(stars, tilt), Status.BAD_INPUT
        )


@pytest.mark.parametrize("sign", [1, -1])
def test_stars_tell_which_way_a_level_without_a_sign_points(night, sign):
    """Where A3 is unknown, or the camera looks along the horizon by it, they do not."""
    _, stars, tilt, solver = night
    x, y, z = sign * np.arcsin(tilt.up)
    unsigned = Tilt(x, y, tilt.covariance, utc_unix_s=tilt.utc_unix_s, theta_z=z, either_way=True)
    fix, told = solver.solve(stars, tilt).fix, solver.solve(stars, unsigned).fix
    assert [told.latitude, told.longitude] == pytest.approx([fix.latitude, fix.longitude], abs=1e-8)
    lying = float(np.degrees(np.arctan2(tilt.up[2], tilt.up[1])))
    for lost in (Calibration(), replace(solver.instrument.calibration, misalignment_deg=(lying, 0.0, 0.0))):
        unable = replace(solver, instrument=replace(solver.instrument, calibration=lost))
        assert "up or down" in refused(unable.solve(stars, unsigned), Status.NO_TILT)


def test_no_tilt(night):
    _, stars, _, solver = night
    far = TiltLog.of(np.array([START - 100]), np.zeros(1), np.zeros(1), np.zeros(1))
    assert "no tilt reading" in refused(solver.solve(stars, far), Status.NO_TILT)
    nan = TiltLog.of(np.array([START]), np.full(1, np.nan), np.zeros(1), np.zeros(1))
    assert "no tilt reading" in refused(solver.solve(stars, nan), Status.NO_TILT)

    def broken(mid, exposure, spread):
        return Tilt(np.nan, 0.0, np.eye(2), utc_unix_s=mid)

    assert "not a finite number" in refused(
        solver.solve(stars, SimpleNamespace(average=broken)), Status.NO_TILT
    )


def test_tilt_out_of_range(night):
    _, stars, _, solver = night

    def leaning(mid, exposure, spread):
        return Tilt(0.6, 0.0, np.eye(2), utc_unix_s=mid)

    errors = replace(solver.instrument.inclinometer, range_rad=np.radians(30))
    upright = replace(solver, instrument=replace(solver.instrument, inclinometer=errors))
    assert "30 deg" in refused(
        upright.solve(stars, SimpleNamespace(average=leaning)), Status.TILT_OUT_OF_RANGE
    )


def test_a_frame_of_another_size_than_the_intrinsics(night, catalogue):
    _, stars, tilt, _ = night
    camera = Camera.from_focal(640, 480, FOCAL_PX)
    assert "640 x 480" in refused(
        Solver(Instrument(FOCAL_PX, camera=camera), catalogue).solve(stars, tilt), Status.BAD_INPUT
    )


def test_a_distortion_that_cannot_be_inverted(night, catalogue):
    _, stars, tilt, _ = night
    camera = replace(Camera.from_focal(*SIZE, FOCAL_PX), distortion=(-90.0, 0.0, 0.0, 0.0, 0.0))
    assert "distortion" in refused(
        Solver(Instrument(FOCAL_PX, camera=camera), catalogue).solve(stars, tilt), Status.BAD_INPUT
    )


def test_poor_fit(night, catalogue):
    _, stars, tilt, _ = night
    demanding = Solver(Instrument(FOCAL_PX), catalogue, min_stars=1000)
    s = demanding.solve(stars, tilt)
    assert "min_stars is 1000" in refused(s, Status.POOR_FIT)
    assert s.pointing is not None


def test_every_status_is_tested_here():
    """Each name of Status stands in a test above, or in the test of times."""
    text = "".join(path.read_text() for path in Path(__file__).parent.glob("test_solver*.py"))
    assert all(f"Status.{s.name}" in text for s in Status)


@pytest.mark.montecarlo
def test_no_content_of_a_frame_raises(night, rng):
    """Hostile lists: coincident, collinear, far away, tiny or huge sigmas, negative flux, tiny and huge frames."""
    _, stars, tilt, solver = night
    sigmas = (1e-9, 0.05, 50.0, 1e6)
    makers = (
        lambda n: rng.uniform(-1e6, 1e6, (n, 2)),
        lambda n: np.full((n, 2), 5.0),
        lambda n: np.stack([np.arange(n) * 1.0, np.arange(n) * 2.0], 1),
        lambda n: np.round(rng.uniform(0, 3, (n, 2))),
        lambda n: rng.normal(500, 1e-7, (n, 2)),
        lambda n: rng.uniform(0, 700, (n, 2)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for make in makers:
            for n in (1, 4, 5, 12, 300):
                xy = make(n)
                hostile = Stars(
                    x=xy[:, 0], y=xy[:, 1], flux=-np.sort(rng.exponential(1, n)), snr=rng.normal(size=n),
                    covariance=np.eye(2)[None].repeat(n, 0) * rng.choice(sigmas) ** 2,
                    flags=rng.integers(0, 16, n),
                    width=SIZE[0], height=SIZE[1], mid_unix_s=START, exposure_s=EXPOSURE,
                )  # fmt: skip
                assert not solver.solve(hostile, tilt).ok
                assert not solver.identify(hostile).ok
        for size in ((1, 1), (1_000_000, 1_000_000)):
            assert (
                solver.solve(replace(stars, width=size[0], height=size[1]), tilt).status is Status.BAD_INPUT
            )


def test_true_stars_with_absurd_errors_give_a_fix_with_an_absurd_sigma_or_none(night):
    scene, stars, tilt, solver = night
    for sigma in (1e-9, 30.0):
        s = solver.solve(replace(stars, covariance=np.eye(2)[None].repeat(len(stars), 0) * sigma**2), tilt)
        if s.ok:
            assert off_by_sigma(s.fix, scene)[0] < 5


def test_prepare_builds_what_solve_needs(night, monkeypatch):
    _, stars, tilt, solver = night
    solver.prepare(*SIZE)
    from starpos.identification import triangles

    monkeypatch.setattr(triangles, "build", lambda *_: pytest.fail("built while solving"))
    assert solver.solve(stars, tilt).ok


def test_an_error_of_the_tilts_source_is_the_frames(night):
    _, stars, _, solver = night

    def gone(mid, exposure, spread):
        raise TiltError("the port is gone: plug it in")

    assert (
        refused(solver.solve(stars, SimpleNamespace(average=gone)), Status.NO_TILT)
        == "the port is gone: plug it in"
    )


def test_a_star_outside_its_frame_costs_nothing_but_itself(catalogue, rng):
    """Where a lens distorts, a pixel far outside has no direction at all."""
    scene = wide_scene()
    stars = stars_of(scene, catalogue, rng)
    camera = replace(Camera.from_focal(*SIZE, FOCAL_PX), distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))
    solver = replace(solver_of(scene, catalogue), instrument=Instrument(FOCAL_PX, camera=camera))
    inside = solver.identify(stars)
    strange = with_false_stars(stars, np.array([[60000.0, 40000.0], [-900.0, 20.0]]))
    answer = solver.identify(strange)
    assert answer.ok
    assert answer.stars_detected == len(stars) + 2
    np.testing.assert_array_equal(answer.star, inside.star + 2)
    tilt = tilt_of(scene, rng)
    assert solver.solve(strange, tilt).names == solver.solve(stars, tilt).names


def test_pixels_that_are_not_square(catalogue, rng):
    """The corners of a frame whose focal lengths differ hold stars too."""
    scene = wide_scene()
    stars = stars_of(scene, catalogue, rng)
    half = replace(stars, y=(stars.y + 0.5) * 0.5 - 0.5, height=SIZE[1] // 2)
    square = solver_of(scene, catalogue).identify(stars)
    camera = Camera(
        width=SIZE[0],
        height=SIZE[1] // 2,
        fx=FOCAL_PX,
        fy=FOCAL_PX / 2,
        cx=(SIZE[0] - 1) / 2,
        cy=(SIZE[1] / 2 - 1) / 2,
    )
    solver = replace(solver_of(scene, catalogue), instrument=Instrument(FOCAL_PX, camera=camera))
    answer = solver.identify(half)
    assert answer.ok
    assert len(answer.names) > 0.97 * len(square.names)


def test_a_poor_fit_still_says_which_stars_it_saw(night):
    _, stars, tilt, solver = night
    answer = replace(solver, min_stars=10_000).solve(stars, tilt)
    refused(answer, Status.POOR_FIT)
    assert len(answer.names) == len(answer.star) == len(answer.magnitudes) > 50
