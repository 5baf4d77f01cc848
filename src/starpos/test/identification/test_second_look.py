# SPDX-License-Identifier: Apache-2.0
"""Frames with too few detections to decide: the light where fainter stars should be does, and chance does not."""

import numpy as np
import pytest

from starpos.detection import detect
from starpos.detection.second_look import SecondLook
from starpos.fix import searching
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame
from starpos.identification import search
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos_testing.skies.rendered import field, noisy
from starpos_testing.skies.scenes import random_attitude

# 5.5 x 4.1 deg, 22 arcsec a pixel
CAMERA = Camera.from_focal(900, 670, 9400.0)
# Detected are stars brighter than this, and the sky shows those down to the next.
BRIGHT, FAINT = 7.0, 9.5
ELECTRONS = 100


@pytest.fixture(scope="module")
def solver(catalogue):
    return Solver(Instrument(CAMERA.fx), catalogue)


def exposed(catalogue, attitude, rng, faint_px=0.0, mirrored=False):
    """A frame on which the stars below BRIGHT are too faint to be detected, and lie faint_px off their places."""
    index = catalogue.cone(attitude[2], CAMERA.half_diagonal_rad, FAINT)
    v, vmag = catalogue.directions(index, 2000.0), catalogue.vmag(index)
    xy = CAMERA.project(v @ attitude.T) + np.outer(vmag > BRIGHT, [faint_px, 0])
    light = field(
        (CAMERA.height, CAMERA.width), np.column_stack([xy, ELECTRONS * 10 ** (-0.4 * (vmag - BRIGHT))])
    )
    plane = noisy(light, rng)
    return Frame(np.ascontiguousarray(plane[::-1])) if mirrored else Frame(plane)


def answers(solver, catalogue, frames, rng, **more):
    """Yield the attitude of random frames, and the answers without and with a second look."""
    for _ in range(frames):
        attitude = random_attitude(rng)
        frame = exposed(catalogue, attitude, rng, **more)
        stars = detect(frame).stars
        alone = solver.identify(stars)
        look = SecondLook(frame, stars.window, stars.fwhm_px)
        yield attitude, alone, alone if alone.ok else solver.identify(stars, look=look)


def is_right(solution, attitude):
    a = solution.pointing
    axis = np.array([np.cos(a.dec) * np.cos(a.ra), np.cos(a.dec) * np.sin(a.ra), np.sin(a.dec)])
    return np.arccos(min(1.0, axis @ attitude[2])) < 6 / CAMERA.fx


@pytest.mark.parametrize("mirrored", [False, True])
def test_stars_too_faint_to_be_detected_decide(mirrored, solver, catalogue, rng):
    without = with_look = 0
    for attitude, first, second in answers(solver, catalogue, 25, rng, mirrored=mirrored):
        assert not second.ok or is_right(second, attitude)
        assert not first.ok or second.pointing.log_odds == first.pointing.log_odds
        without, with_look = without + first.ok, with_look + second.ok
    assert with_look >= without + 3, (without, with_look)


def test_stars_of_another_sky_do_not(solver, catalogue, rng):
    for _, first, second in answers(solver, catalogue, 25, rng, faint_px=25.0):
        assert second.ok == first.ok


def test_a_frame_that_is_identified_is_not_looked_at(solver, catalogue, rng, monkeypatch):
    attitude = random_attitude(rng)
    v = catalogue.directions(catalogue.cone(attitude[2], CAMERA.half_diagonal_rad, 8.5), 2000.0)
    xy = CAMERA.project(v @ attitude.T)
    frame = Frame(noisy(field((CAMERA.height, CAMERA.width), np.insert(xy, 2, 20000, axis=1)), rng))

    def look(*_):
        raise AssertionError("looked at")

    monkeypatch.setattr(searching, "look_at", look)
    question = searching.Question(item=frame, stars=detect(frame).stars)
    assert searching.identify_every_way(solver, question).solution.ok


@pytest.mark.parametrize("stars", [1, 10, 100])
def test_its_mean_is_at_most_one_without_stars(stars, rng):
    expected = rng.uniform(0.5, 6, stars)
    ratios = np.exp([search.log_ratio(rng.normal(size=stars), expected) for _ in range(20_000)])
    assert ratios.mean() < 1.1
    assert np.mean(ratios > 100) < 0.01


def test_it_grows_with_stars(rng):
    expected = np.full(20, 2.0)
    assert search.log_ratio(rng.normal(size=20) + 2, expected) > 12
    assert search.log_ratio(rng.normal(size=20), expected) < 0


def test_places_that_say_nothing_change_nothing():
    assert search.log_ratio(np.zeros(0), np.zeros(0)) == pytest.approx(0)
