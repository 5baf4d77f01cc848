# SPDX-License-Identifier: Apache-2.0
"""A second sky on a frame is noticed, however it came there; what only looks like one is not."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from test_identification import sky_for

from starpos import rotation
from starpos.detection import detect
from starpos.fix.solution import TWO_SKIES, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame, Stars
from starpos.identification.evidence import explained_by
from starpos.identification.pose import stars_at
from starpos.identification.search import identify
from starpos.identification.two_skies import two_skies
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.rendered import field, noisy
from starpos_testing.skies.scenes import (
    FOCAL_PX,
    SIZE,
    random_attitude,
    solver_of,
    stars_of,
    tilt_of,
    wide_scene,
)

CAMERA = Camera.from_focal(*SIZE, FOCAL_PX)
CORNER_PX = np.hypot(*SIZE) / 2
LIMIT_MAG, SIGMA_PX, FIELDS = 8.5, 0.05, 6


@dataclass
class Light:
    """Lights on a frame: xy (N, 2) px and mag (N,), in any order."""

    xy: np.ndarray
    mag: np.ndarray

    def __add__(self, other: "Light") -> "Light":
        return Light(np.concatenate([self.xy, other.xy]), np.concatenate([self.mag, other.mag]))

    def fainter(self, mag: float) -> "Light":
        return Light(self.xy, self.mag + mag)

    def moved(self, xy: np.ndarray) -> "Light":
        return Light(xy, self.mag)


def sky_of(catalogue, attitude, share=1.0, corner_px=0.0) -> Light:
    """All stars, seen for a share of the exposure, through a lens that bends the corners by so much."""
    index = catalogue.cone(attitude[2], CAMERA.half_diagonal_rad * 1.05, LIMIT_MAG)
    xy = CAMERA.project(catalogue.directions(index) @ attitude.T)
    off = (xy - CAMERA.centre_px) / CORNER_PX
    bend = corner_px * off * np.square(off).sum(1, keepdims=True)
    return Light(xy + bend, catalogue.vmag(index) - 2.5 * np.log10(share))


def warns(light: Light, catalogue, rng) -> bool:
    """Whether a detector's list of these lights, which must be identified, gets the warning."""
    mag = light.mag + rng.normal(0, 0.2, len(light.mag))
    on = ((light.xy > 0) & (light.xy < np.array(SIZE) - 1)).all(1) & (mag < LIMIT_MAG)
    on &= rng.random(len(on)) > 0.05
    on = np.flatnonzero(on)[np.argsort(mag[on])]
    xy, flux = light.xy[on] + rng.normal(0, SIGMA_PX, (len(on), 2)), 10 ** (-0.4 * mag[on])
    v, sigma, sky = CAMERA.directions(*xy.T), np.full(len(on), SIGMA_PX), sky_for(catalogue, CAMERA)
    seen = stars_at(CAMERA, v, sigma)
    found = identify(seen, sky)
    assert found is not None
    return two_skies(seen, flux, sky, found, explained_by(found, seen))


def turned(attitude, shift_px, rng, roll=0.0):
    """The attitude after a shift in a random direction, and a roll in rad."""
    x, y = shift_px / FOCAL_PX * rotation.from_vector([0, 0, rng.uniform(0, 2 * np.pi)])[0, :2]
    return rotation.from_vector([x, y, roll]) @ attitude


SHARES = pytest.mark.parametrize("share", [0.5, 0.25], ids=["1:1", "3:1"])


@SHARES
def test_a_double_exposure_of_two_fields(share, catalogue, rng):
    noticed = 0
    for _ in range(FIELDS):
        first = sky_of(catalogue, random_attitude(rng), 1 - share)
        noticed += warns(first + sky_of(catalogue, random_attitude(rng), share), catalogue, rng)
    assert noticed >= FIELDS - 1


@SHARES
@pytest.mark.parametrize("shift_px", [5.0, 12.0, 50.0, 180.0, 450.0])
def test_a_camera_that_moved_between_two_halves_of_the_exposure(shift_px, share, catalogue, rng):
    noticed = 0
    for _ in range(FIELDS):
        attitude = random_attitude(rng)
        first = sky_of(catalogue, attitude, 1 - share)
        second = sky_of(catalogue, turned(attitude, shift_px, rng), share)
        noticed += warns(first + second, catalogue, rng)
    assert noticed >= FIELDS - 1


@SHARES
def test_a_camera_that_was_turned_as_well(share, catalogue, rng):
    noticed = 0
    for _ in range(FIELDS):
        attitude = random_attitude(rng)
        first = sky_of(catalogue, attitude, 1 - share)
        second = sky_of(catalogue, turned(attitude, 80.0, rng, roll=0.05), share)
        noticed += warns(first + second, catalogue, rng)
    assert noticed >= FIELDS - 1


@pytest.mark.parametrize("corner_px", [-20.0, 20.0])
def test_a_plate_exposed_twice_through_a_lens_that_nobody_knows(corner_px, catalogue, rng):
    noticed = 0
    for _ in range(FIELDS):
        attitude = random_attitude(rng)
        first = sky_of(catalogue, attitude, 0.5, corner_px)
        second = sky_of(catalogue, turned(attitude, 15.0, rng), 0.5, corner_px)
        noticed += warns(first + second, catalogue, rng)
    assert noticed >= FIELDS - 1


def companions(light, rng):
    """Every second star is double, some px apart."""
    one = light.xy[::2]
    apart, angle = rng.uniform(4, 12, len(one)), rng.uniform(0, 2 * np.pi, len(one))
    beside = one + apart[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return light + Light(beside, light.mag[::2] + rng.uniform(0, 2, len(one)))


def lights(xy, rng):
    """Lights brighter than most stars."""
    return Light(np.array(xy, float), rng.uniform(4, 7, len(xy)))


def trail(rng):
    """A satellite's or an aircraft's trail, in equal pieces."""
    start, step = rng.uniform(100, 300, 2), rng.uniform(-20, 20, 2)
    return lights(start + np.arange(30)[:, None] * step, rng)


def windows(rng):
    """Rows of lit windows."""
    return lights(rng.uniform(0, 300, 2) + 25.0 * np.stack(np.divmod(np.arange(28), 7), 1), rng)


LOOK_ALIKES = {
    "nothing": lambda light, rng: light,
    "many false stars": lambda light, rng: light + lights(rng.uniform(0, SIZE, (30, 2)), rng),
    "hot pixels": lambda light, rng: light + lights(rng.integers(0, SIZE, (200, 2)), rng).fainter(2.0),
    "double stars": companions,
    "a trail in pieces": lambda light, rng: light + trail(rng),
    "windows": lambda light, rng: light + windows(rng).fainter(1.5),
    "a ghost beside each star": lambda light, rng: light + light.moved(light.xy + np.array([31.0, 17.0])).fainter(3.5),
    "ghosts mirrored by the lens": lambda light, rng: light + light.moved(SIZE - light.xy).fainter(4.0),
    "a crowded field": lambda light, rng: light.fainter(-1.5),
}  # fmt: skip


@pytest.mark.parametrize("kind", LOOK_ALIKES)
def test_what_looks_like_a_second_sky_is_none(kind, catalogue, rng):
    for _ in range(FIELDS):
        light = LOOK_ALIKES[kind](sky_of(catalogue, random_attitude(rng)), rng)
        assert not warns(light, catalogue, rng)


@pytest.mark.parametrize("corner_px", [-40.0, -15.0, 15.0, 40.0])
def test_stars_that_an_unknown_lens_bends_out_of_place_are_no_second_sky(corner_px, catalogue, rng):
    for _ in range(FIELDS):
        assert not warns(sky_of(catalogue, random_attitude(rng), 1.0, corner_px), catalogue, rng)


@pytest.mark.parametrize("error_px", [1.5, 2.5])
def test_centroids_that_err_by_more_than_they_claim_are_one_sky(error_px, catalogue, rng):
    # as on photographs of telephones, which merge and sharpen several exposures
    for _ in range(FIELDS):
        light = sky_of(catalogue, random_attitude(rng))
        assert not warns(light.moved(light.xy + rng.normal(0, error_px, light.xy.shape)), catalogue, rng)


def exposed(light, rng, trail_px=(0.0, 0.0)) -> Stars:
    """The stars that the detector finds on a frame of these lights, trailed."""
    on = ((light.xy > 0) & (light.xy < np.array(SIZE))).all(1)
    electrons = 10 ** (-0.4 * (light.mag[on] - 17))
    image = field(SIZE[::-1], np.column_stack([light.xy[on], electrons]), trail=trail_px)
    return detect(Frame(noisy(image, rng))).stars


@pytest.mark.parametrize("trail_px", [(4.0, 1.0), (9.0, -4.0), (20.0, 8.0)])
def test_trailed_stars_are_one_sky(trail_px, catalogue, rng):
    stars = exposed(sky_of(catalogue, random_attitude(rng)), rng, trail_px)
    s = Solver(Instrument(FOCAL_PX), catalogue).identify(stars)
    assert s.ok and s.warnings == ()


def test_the_pixels_of_a_camera_that_moved_say_so(catalogue, rng):
    attitude = random_attitude(rng)
    light = sky_of(catalogue, attitude, 0.6) + sky_of(catalogue, turned(attitude, 25.0, rng), 0.4)
    s = Solver(Instrument(FOCAL_PX), catalogue).identify(exposed(light, rng))
    assert s.ok and s.warnings == (TWO_SKIES,)


def merged(a: Stars, b: Stars) -> Stars:
    """Two lists of one frame as one."""
    order = np.argsort(-np.concatenate([a.flux, b.flux]), kind="stable")
    columns = ("x", "y", "flux", "snr", "covariance", "flags")
    return replace(a, **{k: np.concatenate([getattr(a, k), getattr(b, k)])[order] for k in columns})


def test_there_is_no_fix_from_two_skies_but_a_sentence(catalogue, rng):
    scene = wide_scene()
    solver, stars, tilt = solver_of(scene, catalogue), stars_of(scene, catalogue, rng), tilt_of(scene, rng)
    moved = stars.select(stars.x < SIZE[0] - 41)
    s = solver.solve(merged(stars, replace(moved, x=moved.x + 40.0)), tilt)
    assert s.status is Status.POOR_FIT and s.fix is None and s.hint is None
    assert s.warnings == (TWO_SKIES,) and "two skies in one frame" in s.message
    assert s.pointing is not None
    once = solver.solve(stars, tilt)
    assert once.ok and once.warnings == ()


def test_stars_without_a_flux_raise_nothing(catalogue, rng):
    stars = stars_of(wide_scene(), catalogue, rng)
    stars = replace(stars, flux=np.zeros(len(stars)))
    assert Solver(Instrument(FOCAL_PX), catalogue).identify(stars).warnings == ()
