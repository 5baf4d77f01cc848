# SPDX-License-Identifier: Apache-2.0
"""Small fields: frames of 0.5 to 1.3 deg in a simulated sky that only the deeper catalogue knows well enough."""

import numpy as np
import pytest

from starpos.fix.solution import Status
from starpos.fix.solver import Solver, focal_that_fits
from starpos.frames.frame import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.rotation import normalised
from starpos.sky import deeper
from starpos.sky.catalogue import pack

pytestmark = pytest.mark.montecarlo

# The simulated part of the sky, deg, its stars per deg2, and how many of them the catalogue that is too thin has.
RA, DEC, STARS_PER_DEG2, THIN = (40.0, 52.0), (-6.0, 6.0), 110.0, 0.1
WIDTH, HEIGHT = 1600, 860
CAMERA = Camera.from_focal(WIDTH, HEIGHT, WIDTH / np.radians(1.3))


@pytest.fixture(scope="module")
def sky():
    """Right ascensions, declinations and magnitudes (N,), brightest first, 2.5 times as many with each magnitude."""
    rng = np.random.default_rng(16)
    n = int(STARS_PER_DEG2 * (RA[1] - RA[0]) * (DEC[1] - DEC[0]))
    mag = 13.0 + np.log(np.sort(rng.random(n))) / np.log(2.5)
    return rng.uniform(*RA, n), rng.uniform(*DEC, n), mag


@pytest.fixture(scope="module")
def thin(sky):
    return packed(*(column[: int(THIN * len(sky[0]))] for column in sky))


def packed(ra, dec, mag):
    none, tyc = np.zeros(len(mag)), np.ones((len(mag), 3), int)
    return pack(tyc, none, mag, ra, dec, none, none, none + 10, none + 1, none + 1990)


@pytest.fixture(scope="module", autouse=True)
def own_cache(sky, tmp_path_factory):
    """A cache with the deeper catalogue, which holds all stars of the simulated sky."""
    folder = tmp_path_factory.mktemp("small")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        deeper.keep(packed(*sky))
        yield
    deeper.KEPT.forget()


def seen(sky, camera, rng):
    """The Stars of a frame somewhere in the simulated part, its middle (3,), with the errors of real ones."""
    ra, dec, mag = sky
    place = np.radians([rng.uniform(RA[0] + 1, RA[1] - 1), rng.uniform(DEC[0] + 1, DEC[1] - 1)])
    v, middle = (unit(*np.radians([ra, dec])), unit(*place))
    side = normalised(rng.normal(size=3) @ (np.eye(3) - np.outer(middle, middle)))
    xy = camera.project(v @ np.stack([side, np.cross(middle, side), middle]).T)
    on = ((xy > 0) & (xy < [camera.width - 1, camera.height - 1])).all(1) & (rng.random(len(ra)) > 0.05)
    on = np.flatnonzero(on)
    on = on[np.argsort(mag[on] + rng.normal(0, 0.2, len(on)))]
    n = len(on)
    xy = xy[on] + rng.normal(0, 0.1, (n, 2))
    stars = Stars(
        x=xy[:, 0],
        y=xy[:, 1],
        flux=np.arange(n, 0, -1.0),
        snr=np.full(n, 20.0),
        covariance=np.broadcast_to(0.01 * np.eye(2), (n, 2, 2)),
        flags=np.zeros(n),
        width=camera.width,
        height=camera.height,
    )
    return stars, middle


def unit(ra, dec):
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)


def off_px(s, middle, camera):
    return np.linalg.norm(unit(s.pointing.ra, s.pointing.dec) - middle) * camera.fx


@pytest.mark.parametrize("focal_error", [0.0, 0.02, -0.02])
def test_a_field_that_the_catalogue_is_too_thin_for_is_found_with_the_deeper_one(focal_error, sky, thin, rng):
    assert deeper.too_thin(thin, CAMERA)
    solver = Solver(Instrument(CAMERA.fx * (1 + focal_error)), thin)
    found = 0
    for _ in range(12):
        stars, middle = seen(sky, CAMERA, rng)
        s = solver.identify(stars)
        if s.ok:
            assert off_px(s, middle, CAMERA) < 1.5
            assert len(s.names) > 0.6 * len(stars) and s.pointing.focal_px == pytest.approx(
                CAMERA.fx, rel=1e-3
            )
            found += 1
    assert found >= 11


def test_a_focal_length_out_of_range_is_told_the_one_that_fits(sky, thin, rng):
    stars, _ = seen(sky, CAMERA, rng)
    wrong = Solver(Instrument(1.2 * CAMERA.fx), thin)
    assert wrong.identify(stars).status is Status.NOT_IDENTIFIED
    assert focal_that_fits(wrong, stars) == pytest.approx(CAMERA.fx, rel=2e-3)


def test_no_focal_length_fits_random_points(thin, rng):
    stars, _ = seen((rng.uniform(*RA, 9000), rng.uniform(*DEC, 9000), rng.uniform(5, 13, 9000)), CAMERA, rng)
    assert focal_that_fits(Solver(Instrument(CAMERA.fx), thin), stars) is None
