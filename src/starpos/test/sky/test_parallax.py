# SPDX-License-Identifier: Apache-2.0
"""Stars are seen from where the Earth stands: their parallaxes against ERFA's, in every answer and every catalogue."""

from dataclasses import replace

import erfa
import numpy as np
import pytest

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.inclinometer import EXACT, Tilt
from starpos.instrument.instrument import Instrument
from starpos.navigation.sightings import sighting_of
from starpos.sky.catalogue import load_catalogue, pack, read, save
from starpos.sky.site import Site
from starpos.units import ARCSEC, DAY_S, MAS
from starpos.zenith.sighting import sighting

# HIP: J2000 place (deg), motions and parallax (mas) as SIMBAD has them: Hipparcos (van Leeuwen 2007), Gaia for Barnard's
NEAREST = {
    "alpha Cen A": (71683, 219.90205833, -60.83399269, -3679.25, 473.67, 742.12),
    "Barnard's star": (87937, 269.45207696, 4.69336497, -801.55, 10362.39, 546.98),
    "Sirius": (32349, 101.28715533, -16.71611586, -546.01, -1223.07, 379.21),
}
BEGIN = 1.7e9


def apparent(state, ra, dec, pm_ra, pm_dec, parallax):
    """CIRS directions (n, 3) by ERFA's eraAtciq, of places in deg and mas; it takes motions in right ascension itself."""
    ra, dec = np.radians([ra, dec])
    pm = np.array([pm_ra / np.cos(dec), pm_dec]) * MAS
    ri, di = erfa.atciq(ra, dec, *pm, np.asarray(parallax) / 1000, 0.0, state.astrom)
    return erfa.s2c(ri, di)


@pytest.mark.parametrize("name", NEAREST)
def test_the_nearest_stars_through_a_year(name):
    hip, ra, dec, pm_ra, pm_dec, parallax = NEAREST[name]
    one = pack([[1, 1, 1]], [hip], [0.0], [ra], [dec], [pm_ra], [pm_dec], [1.0], [0.1], [1991.0], [parallax])
    off, without = [], []
    for k in range(12):
        state = earth_state(BEGIN + k * 30.4 * DAY_S)
        there = state.cirs_to_itrs @ apparent(state, ra, dec, pm_ra, pm_dec, parallax)
        for seen, kept in ((state.observer_au, off), (None, without)):
            found = state.to_itrs(one.directions(np.array([0]), state.year, seen))[0]
            kept.append(np.linalg.norm(found - there) / MAS)
    # a place is rounded to 1 mas, and the light's way across the Earth's orbit adds 0.2 mas to the fastest motion
    assert max(off) < 1.2
    assert max(without) > 0.9 * parallax


@pytest.mark.parametrize("name", NEAREST)
def test_the_committed_catalogue_has_the_nearest_stars_parallaxes(name, catalogue):
    hip, *_, parallax = NEAREST[name]
    rows = np.flatnonzero(catalogue.hip == hip)
    assert catalogue.parallax_mas(rows) == pytest.approx(parallax, rel=0.005)


def test_near_stars_are_few_and_their_tables_stay(catalogue):
    near = catalogue.parallax_mas() > 0
    assert 100 < near.sum() < 200 and catalogue.parallax_mas()[near].min() >= 100
    # stars of one parallax move together: half of all near ones by more than this, mas a year
    assert np.median(np.hypot(*catalogue.motions(near))) > 500
    # so the triangles in a user's cache still belong to it
    assert catalogue.fingerprint == "15e0a9fd5bc29a88"


@pytest.fixture
def near(rng):
    """A few stars with the identifiers of near ones."""
    committed = load_catalogue()
    rows = np.flatnonzero(committed.parallax_tenths)[::7]
    n = len(rows)
    return pack(
        committed.tyc[rows], np.arange(1, n + 1), np.full(n, 9.0), rng.uniform(0, 360, n), rng.uniform(-80, 80, n),
        rng.normal(0, 50, n), rng.normal(0, 50, n), np.full(n, 9.0), np.full(n, 9.0), np.full(n, 1990.0),
        rng.uniform(1, 500, n),
    )  # fmt: skip


NEWER = ("pm_ra_centi", "pm_dec_centi", "parallax_tenths")


def test_a_file_from_before_parallaxes_has_those_of_its_near_stars(near, tmp_path):
    save(near, tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as f:
        np.savez(tmp_path / "old.npz", **{name: f[name] for name in f if name not in NEWER})
    old = read(tmp_path / "old.npz")
    expected = dict(zip(map(tuple, load_catalogue().tyc), load_catalogue().parallax_tenths, strict=True))
    assert old.parallax_tenths.tolist() == [expected[tuple(t)] for t in old.tyc]
    assert not old.pm_ra_centi.any() and (old.pm_ra == near.pm_ra).all()
    assert old.fingerprint == near.fingerprint


def test_motions_are_kept_to_a_hundredth(near):
    assert near.motions().shape == (2, len(near))
    exact = pack([[1, 1, 1]], [0], [9.0], [10.0], [0.0], [-7.48], [0.0149], [1.0], [1.0], [2000.0])
    assert exact.motions()[:, 0] == pytest.approx([-7.48, 0.01], abs=1e-9)
    assert exact.directions([0], 2100.0)[0] @ [0, 0, 1] == pytest.approx(1.0 * MAS, rel=1e-3)


PLACE, FOCAL_PX, SIZE = (47.0, 8.0), 93750.0, (5616, 3744)
VACUUM = Atmosphere(pressure_pa=0.0)


@pytest.fixture(scope="module")
def frame():
    """A frame of the zenith whose stars all are near: the catalogue, the stars by ERFA, and the camera's true axes."""
    rng = np.random.default_rng(4)
    committed = load_catalogue()
    parallax = rng.uniform(150, 450, len(committed))
    near = replace(committed, parallax_tenths=np.round(parallax * 10).astype(np.uint16))
    instrument = Instrument(FOCAL_PX, inclinometer=replace(EXACT, noise_rad=1e-9))
    camera, site, state = instrument.camera_for(*SIZE), Site(*PLACE, VACUUM), earth_state(BEGIN)
    index = site.overhead(near, state, np.array([0.0, 0.0, 1.0]), camera.half_diagonal_rad, 9.0)
    ra, dec = near.ra_mas[index] / 3.6e6, near.dec_mas[index] / 3.6e6
    cirs = apparent(state, ra, dec, *near.motions(index), near.parallax_mas(index))
    itrs = cirs @ state.cirs_to_itrs.T + _ground(site)
    axes = rotation.about_axis(2, 0.7)
    xy = camera.project(rotation.normalised(itrs) @ site.enu.T @ axes.T)
    on = ((xy > 2) & (xy < np.array(SIZE) - 3)).all(1)
    n = on.sum()
    stars = Stars(
        x=xy[on, 0], y=xy[on, 1], flux=10 ** (-0.4 * near.vmag(index[on])), snr=np.full(n, 100.0),
        covariance=np.broadcast_to(np.eye(2) * 0.03**2, (n, 2, 2)), flags=np.zeros(n), width=SIZE[0], height=SIZE[1],
        mid_unix_s=BEGIN, exposure_s=0.5,
    )  # fmt: skip
    return near, stars, axes, instrument


def _ground(site):
    """Velocity of the ground in units of c, along ITRS: 465 m/s at the equator."""
    east, _, up = site.enu
    return east * np.hypot(up[0], up[1]) * 465.1 / 299_792_458


ANSWERS = {
    "deflection": lambda solver, stars, found, tilt: (
        sighting(solver, stars, found.found, Place.on_ellipsoid(*PLACE, height_m=0.0), tilt).enu_to_camera
    ),
    "fix": lambda solver, stars, found, tilt: solver.solve(stars, tilt).fix,
    "under way": lambda solver, stars, found, tilt: (
        sighting_of(stars, solver, found).under(Site(*PLACE).enu[2], VACUUM)[0].rotation.T
        @ Site(*PLACE).enu.T
    ),
}


def _off_arcsec(answer, axes):
    """How far the camera's axis, or the place, is off across the line of sight."""
    if hasattr(answer, "latitude"):
        latitude, longitude = np.radians(PLACE)
        north, east = answer.latitude - latitude, (answer.longitude - longitude) * np.cos(latitude)
        return np.hypot(north, east) / ARCSEC
    return np.linalg.norm(answer[2] - axes[2]) / ARCSEC


@pytest.mark.parametrize("what", ANSWERS)
def test_an_answer_from_near_stars_is_not_where_the_sun_would_have_it(what, frame):
    near, stars, axes, instrument = frame
    tilt, off = Tilt(0.0, 0.0, np.eye(2) * 1e-18, utc_unix_s=BEGIN, times=(BEGIN,)), []
    for parallaxes in (near, replace(near, parallax_tenths=np.zeros_like(near.parallax_tenths))):
        solver = Solver(instrument, parallaxes, VACUUM)
        answer = ANSWERS[what](solver, stars, solver.identify(stars), tilt)
        off.append(_off_arcsec(answer, axes))
    assert off[0] < 0.004 and off[1] > 0.1
