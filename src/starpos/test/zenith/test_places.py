# SPDX-License-Identifier: Apache-2.0
"""Stars' places that a session adjusts itself: frames whose stars come and go, one axis of displacements drawn."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import drawn

from starpos import rotation
from starpos.zenith.sighting import StarPlaces

# a frame's stars, of all that pass; error of a seen place in units of the catalogue's sigma; that sigma in rad
WIDE, STARS, SEEN, SIGMA = 20, 60, 0.5, 2e-7


def passing(rng, frames, displaced):
    """Sightings of frames that lose one star and gain another, with the attitudes that the catalogue's places give."""
    sightings = []
    for number, s in enumerate(frames):
        rows = (number + np.arange(WIDE)) % STARS
        seen = displaced[rows, 0] + rng.normal(0, SEEN, WIDE)
        # the attitude follows the mean of its stars, along one axis; residuals are predicted minus seen
        by_star = np.zeros((3, WIDE, 3))
        by_star[0, :, 0] = SIGMA / WIDE
        common, weight, pull = np.zeros((4, WIDE, 3)), np.zeros((WIDE, 3, 3)), np.zeros((WIDE, 3))
        common[0, :, 0], weight[:, 0, 0] = 1 / SEEN / np.sqrt(WIDE), 1 / SEEN**2
        pull[:, 0] = (seen - seen.mean()) / SEEN**2
        turn = rotation.from_vector([SIGMA * seen.mean(), 0.0, 0.0])
        sightings.append(
            replace(
                s.turned(turn),
                stars=rows + 100,
                by_star=by_star,
                star_common=common,
                star_weight=weight,
                star_pull=pull,
            )
        )
    return sightings


@pytest.mark.parametrize("factor", [0.4, 1.0, 2.5])
def test_the_size_of_the_catalogues_errors_comes_from_the_stars(rng, factor):
    frames = drawn(rng, frames=10).sightings
    found = StarPlaces.of(passing(rng, frames, factor * rng.normal(0, 1, (STARS, 3))))
    assert found.factor == pytest.approx(factor, rel=0.35)


def test_corrected_places_move_the_attitudes_towards_the_truth(rng):
    frames = drawn(rng, frames=10).sightings
    sightings = passing(rng, frames, rng.normal(0, 1, (STARS, 3)))
    corrected = StarPlaces.of(sightings).applied(sightings)

    def off(seen):
        turns = [
            rotation.to_small_vector(a.enu_to_camera @ b.enu_to_camera.T)[0]
            for a, b in zip(seen, frames, strict=True)
        ]
        # no star determines errors that all frames share
        return np.std(turns) / SIGMA

    assert off(corrected) < 0.7 * off(sightings)
