# SPDX-License-Identifier: Apache-2.0
"""All-sky frames of which nothing is known: found behind horizons, trees, domes, aurora, Moon; never found wrong."""

from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest

from starpos.detection import detect
from starpos.fix.blind import BlindSolver
from starpos.fix.solution import Status
from starpos.identification.blind import disc_radius_px
from starpos.instrument.camera import EQUIDISTANT
from starpos_testing.skies.all_sky import LENSES, AllSky

# what stands in the way, and what is no star
SKIES = {
    "horizon": ("horizon",),
    "trees": ("horizon", "trees", "planets"),
    "dome": ("dome",),
    "aurora": ("horizon", "aurora"),
    "moon": ("horizon", "moon", "planets"),
    "all at once": ("horizon", "trees", "aurora", "moon", "planets"),
}


@pytest.fixture(scope="module")
def solver(catalogue):
    return BlindSolver(catalogue)


def axis_of(s):
    a = s.pointing
    return np.array([np.cos(a.dec) * np.cos(a.ra), np.cos(a.dec) * np.sin(a.ra), np.sin(a.dec)])


def check(s, sky, off_deg=0.5):
    assert np.degrees(np.arccos(min(1.0, axis_of(s) @ sky.axis))) < off_deg
    assert s.pointing.model == EQUIDISTANT and not s.pointing.mirrored


# each sky by one lens, and the worst by all
@pytest.mark.parametrize(
    ("sky", "lens"),
    [*zip([*SKIES][:-1], cycle(LENSES), strict=False), *(("all at once", lens) for lens in LENSES)],
)
def test_an_all_sky_frame_is_found_with_no_option_at_all(sky, lens, solver, catalogue, rng):
    kinds = SKIES[sky]
    sky = AllSky(
        catalogue=catalogue,
        rng=rng,
        lens=lens,
        field_deg=rng.uniform(150, 195),
        limit_mag=rng.uniform(4.0, 5.5),
    )
    for kind in kinds:
        getattr(sky, kind)()
    s = solver.identify(sky.stars)
    assert s.ok, s.message
    check(s, sky)
    assert s.pointing.log_odds > 25


@pytest.mark.parametrize(
    ("width", "height", "radius_px", "field_deg"),
    [(1500, 1000, 901.0, 170.0), (1500, 1000, 901.0, 100.0), (6000, 4000, 1950.0, 180.0), (1280, 960, 470.0, 120.0)],
    ids=["full frame", "full frame of 100 deg", "24 megapixels", "disc of 120 deg"],
)  # fmt: skip
def test_other_fields_and_sizes_are_found(width, height, radius_px, field_deg, solver, catalogue, rng):
    sky = AllSky(
        catalogue=catalogue,
        rng=rng,
        lens="equisolid",
        width=width,
        height=height,
        radius_px=radius_px,
        field_deg=field_deg,
        limit_mag=5.5,
        off_px=0.01 * width,
    ).horizon()
    s = solver.identify(sky.stars)
    assert s.ok, s.message
    check(s, sky)


def test_a_mirrored_frame_looks_where_the_other_does(solver, catalogue, rng):
    sky = AllSky(catalogue=catalogue, rng=rng, limit_mag=5.0, off_px=15.0).horizon()
    stars = sky.stars
    s, flipped = solver.identify(stars), solver.identify(replace(stars, y=sky.height - 1 - stars.y))
    check(s, sky)
    assert flipped.ok and flipped.pointing.mirrored
    assert np.degrees(np.arccos(min(1.0, axis_of(flipped) @ axis_of(s)))) < 0.05
    turned = np.degrees(flipped.pointing.roll - s.pointing.roll - np.pi) % 360
    assert min(turned, 360 - turned) < 0.2


def test_most_stars_of_the_frame_are_named_though_the_lens_was_not_known(solver, catalogue, rng):
    sky = AllSky(catalogue=catalogue, rng=rng, lens="stereographic", limit_mag=5.0)
    s = solver.identify(sky.stars)
    assert s.ok, s.message
    assert len(s.names) > 0.8 * len(sky.stars) and s.warnings == ()


@pytest.mark.parametrize("kinds", [(), ("horizon", "trees"), ("horizon", "aurora"), ("horizon", "moon")])
def test_a_picture_of_the_sky_is_found(kinds, solver, catalogue, rng):
    sky = AllSky(
        catalogue=catalogue, rng=rng, lens="between", width=1000, height=800, radius_px=380.0, limit_mag=5.0
    )
    for kind in kinds:
        getattr(sky, kind)()
    s = solver.identify(detect(sky.picture()).stars)
    assert s.ok, s.message
    check(s, sky)


def test_random_points_in_a_disc_are_no_sky_and_the_fisheye_is_named(solver, rng):
    r, around = 470 * np.sqrt(rng.random(100)), rng.uniform(0, 2 * np.pi, 100)
    s = replace(solver, search_s=2.0).identify(scattered(640 + r * np.cos(around), 480 + r * np.sin(around)))
    assert s.status is Status.NOT_IDENTIFIED and "--lens equidistant" in s.message


def test_a_frame_whose_lens_is_called_a_fisheye_is_searched_as_one_first(catalogue, rng):
    said = []
    solver = BlindSolver(catalogue, lambda what, done: said.append(what), search_s=0.1)
    stars = scattered(*rng.uniform(0, [[1280], [960]], (2, 60)))
    assert "EXIF" not in solver.identify(stars).message and "fisheyes" not in said[0]
    said.clear()
    s = solver.identify(replace(stars, fisheye=True))
    assert said[0] == "searching fisheyes" and "its EXIF calls the lens a fisheye" in s.message


def scattered(x, y):
    from starpos.frames.frame import Stars

    n = len(x)
    return Stars(
        x=x, y=y, flux=np.arange(n, 0, -1.0), snr=np.full(n, 20.0), flags=np.zeros(n), width=1280, height=960,
        covariance=np.broadcast_to(0.09 * np.eye(2), (n, 2, 2)),
    )  # fmt: skip


def test_stars_over_the_whole_frame_lie_in_no_disc(rng):
    assert disc_radius_px(rng.uniform(0, [1280, 960], (200, 2)), 1280, 960) is None
    # too few to leave corners empty by more than chance
    assert disc_radius_px(np.array([[600.0, 400], [700, 500], [650, 480], [600, 500]]), 1280, 960) is None
    r, around = 450 * np.sqrt(rng.random(200)), rng.uniform(0, 2 * np.pi, 200)
    xy = np.stack([640 + r * np.cos(around), 480 + r * np.sin(around)], 1)
    lettering = np.array([[10.0, 10], [20, 10], [30, 10]])
    assert disc_radius_px(np.concatenate([xy, lettering]), 1280, 960) == pytest.approx(450, abs=15)
