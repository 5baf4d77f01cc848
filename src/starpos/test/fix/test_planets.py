# SPDX-License-Identifier: Apache-2.0
"""Planets on a frame of stars: named, and not counted as false stars."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.earth.orientation import earth_state
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.camera import EQUIDISTANT, PLUMB_BOB, Camera
from starpos.instrument.instrument import Instrument
from starpos.rotation import normalised
from starpos.sky.bodies import body_at
from starpos.sky.catalogue import load_catalogue
from starpos.units import unix_of

# Jupiter was 0.1 deg from Saturn then, by the news of that day
CONJUNCTION = unix_of("2020-12-21T18:20:00")
SIZE = 1400, 1050


def shot(model: str, focal_px: float, when: float = CONJUNCTION) -> tuple[Solver, Stars, dict[str, int]]:
    """A frame towards Jupiter with the stars there, both planets among them as its brightest; which rows they are."""
    state, catalogue = earth_state(when), load_catalogue()
    camera, rng = Camera.from_focal(*SIZE, focal_px, model), np.random.default_rng(1)
    towards = body_at("jupiter", earth_state(CONJUNCTION)).itrs @ earth_state(CONJUNCTION).gcrs_to_itrs
    right = normalised(np.cross([0.0, 0.0, 1.0], towards))
    attitude = np.stack([right, np.cross(towards, right), towards])
    rows = catalogue.cone(towards, min(camera.half_diagonal_rad, 0.9), 8.0 if model == PLUMB_BOB else 4.5)
    rows = rows[np.argsort(catalogue.vmag(rows))]
    planets = [body_at(name, state).itrs @ state.gcrs_to_itrs for name in ("jupiter", "saturn")]
    seen = np.vstack([planets, catalogue.directions(rows, state.year, state.observer_au)]) @ attitude.T
    xy = camera.project(seen) + rng.normal(0, 0.2, (len(seen), 2))
    mag = np.array([-2.0, 0.6, *catalogue.vmag(rows)])
    inside = ((xy > 3) & (xy < np.array(SIZE) - 4)).all(1)
    xy, flux = xy[inside], 10 ** (-0.4 * mag[inside])
    order = np.argsort(-flux)
    number = len(order)
    stars = Stars(
        x=xy[order, 0], y=xy[order, 1], flux=flux[order], snr=np.full(number, 50.0), flags=np.zeros(number, np.uint8),
        covariance=np.tile(np.eye(2) * 0.04, (number, 1, 1)), width=SIZE[0], height=SIZE[1], mid_unix_s=when,
        exposure_s=1.0, source="drawn",
    )  # fmt: skip
    where = {name: int(np.flatnonzero(order == k)[0]) for k, name in enumerate(("jupiter", "saturn"))}
    return Solver(Instrument(focal_px, model=model), catalogue), stars, where


@pytest.mark.parametrize(("model", "focal_px"), [(PLUMB_BOB, 8000.0), (EQUIDISTANT, 600.0)])
def test_planets_are_named_and_no_false_stars(model, focal_px) -> None:
    solver, stars, where = shot(model, focal_px)
    found = solver.identify(stars)
    assert found.ok
    assert dict(found.planets) == where
    undated = solver.identify(replace(stars, mid_unix_s=None))
    assert undated.planets == ()
    assert undated.explained.bright == found.explained.bright + 2


def test_a_light_where_no_planet_stands_is_none() -> None:
    solver, stars, _ = shot(PLUMB_BOB, 8000.0)
    later = replace(stars, mid_unix_s=CONJUNCTION + 5 * 86400)
    assert solver.identify(later).planets == ()
