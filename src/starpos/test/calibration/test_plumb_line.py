# SPDX-License-Identifier: Apache-2.0
"""The plumb line from attitudes and tilts alone: no star, no sky; every error drawn from its size."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from starpos import rotation
from starpos.calibration.plumb_line import KNOWN, Readings, hang, level
from starpos.instrument.inclinometer import up_of
from starpos.units import ARCSEC

SCA100T, QUIET = 12.6 * ARCSEC, 0.1 * ARCSEC


@dataclass(frozen=True)
class Truth:
    a3: np.ndarray
    zenith: np.ndarray
    # Another A3, some degrees of lean and any turn away.
    given: np.ndarray


def upright(rng) -> np.ndarray:
    """Up in S of an inclinometer that stands upright to some degrees."""
    x, y = rng.normal(0, 0.03, 2)
    return np.array([x, y, np.sqrt(1 - x * x - y * y)])


def readings(rng, headings, noise=SCA100T, lean=0.0, wander=0.0, leans=None) -> tuple[Readings, Truth]:
    """Readings of an instrument turned to these headings (deg) about an axis that is `lean` deg off the zenith.

    wander: 1 sigma of what the inclinometer's zero follows, like a temperature.  leans: each frame's
    (deg), by a tilted foot instead of a turn.
    """
    a3 = rotation.from_vector(rng.normal(size=3) * [0.05, 0.05, 2.0])
    zenith = rng.normal(size=3)
    zenith /= np.linalg.norm(zenith)
    plumb = upright(rng)
    # at heading 0, the camera stands so that the inclinometer reads `plumb`
    axis = rotation.from_vector(np.radians(lean) * np.linalg.svd(zenith[None])[2][1]) @ zenith
    first = rotation.shortest_turn(zenith, a3.T @ plumb)
    to_camera, read = [], []
    for k, heading in enumerate(np.radians(headings)):
        attitude = first @ rotation.from_vector(-heading * axis)
        if leans is not None:
            attitude = rotation.from_vector(np.radians([0.0, leans[k], 0.0])) @ attitude
        up = a3 @ attitude @ zenith
        theta = np.arcsin(up[:2]) + rng.normal(0, noise, 2)
        to_camera.append(attitude)
        read.append(theta)
    read, n = np.array(read), len(headings)
    # drift and temperature of either axis, and a response of five coefficients
    shared = np.zeros((n, 3, 9))
    if wander:
        warm = np.linspace(-1, 1, n)
        read = read + np.outer(warm, rng.normal(0, wander, 2))
        for axis_of in range(2):
            shared[:, axis_of, 2 + axis_of] = warm * wander
    rows = up_of(read)
    given = rotation.from_vector(rng.normal(0, 0.05, 3) * [1, 1, 0] + [0, 0, rng.uniform(-3, 3)]) @ a3
    made = Readings(
        utc_unix_s=60.0 * np.arange(n),
        to_camera=np.array(to_camera),
        plumb=rows,
        sigma=np.full(n, noise),
        common2=np.zeros(n),
        pose=np.arange(n),
        pose_sigma=0.0,
        columns=shared,
        column_sigma=np.repeat([1.0, KNOWN], [4, 5]),
        axes=2,
    )
    return made, Truth(a3, zenith, given)


def plumb_error(found, truth, at: np.ndarray) -> np.ndarray:
    """Error of the direction in C that A3 takes to `at` (3,), as small rotations across it, rad (2,)."""
    off = rotation.shortest_turn(found.a3.T @ at, truth.a3.T @ at)
    w = found.a3 @ rotation.to_small_vector(off)
    return np.linalg.svd(at[None])[2][1:] @ w


def chi2_of_plumb(found, truth, at) -> float:
    """2 on average."""
    across = np.linalg.svd(at[None])[2][1:]
    w = plumb_error(found, truth, at)
    return float(w @ np.linalg.solve(across @ found.covariance @ across.T, w))


def zenith_sigmas(found, truth) -> float:
    return np.linalg.norm(found.zenith - truth.zenith) / found.zenith_sigma


FOUR, MANY = (0, 90, 180, 270), tuple(range(0, 720, 40))
TURNS = {
    "two opposite headings": {"headings": (0, 180)},
    "four headings": {"headings": FOUR},
    "four headings by hand": {"headings": FOUR, "leans": (0.1, -0.05, 0.03, 0.0)},
    "an axis that leans, a foot raised": {
        "headings": (0, 90, 180, 270, 270),
        "lean": 0.05,
        "leans": (0, 0, 0, 0, 0.5),
    },
    "two headings, a foot raised": {"headings": (0, 180, 180), "lean": 0.05, "leans": (0, 0, 0.5)},
    "many headings, zero wandering": {"headings": MANY, "wander": 30 * ARCSEC},
    "a narrow turn": {"headings": (0, 15, 30)},
}


@pytest.mark.montecarlo
@pytest.mark.parametrize("noise", [SCA100T, QUIET])
@pytest.mark.parametrize("kind", TURNS)
def test_level_errs_as_it_says(kind, noise):
    """Plumb line and zenith over 12 instruments anywhere on Earth: chi-squares of 2 on average."""
    plumb, zenith = [], []
    for seed in range(12):
        made, truth = readings(np.random.default_rng(seed), noise=noise, **TURNS[kind])
        found = level(made, truth.given)
        plumb.append(chi2_of_plumb(found, truth, made.mean_plumb))
        zenith.append(zenith_sigmas(found, truth))
    bound = 3.5 * np.sqrt(4 / 12)
    assert np.mean(plumb) == pytest.approx(2, abs=bound)
    # The worse of two axes, without the turn of A3.
    assert np.quantile(zenith, 0.9) < 2.7


def test_leans_by_hand_tell_the_turn_of_a3_too():
    leans, chi2 = (1.5, -2, 1, 2, -1, 0.5), []
    for seed in range(30):
        made, truth = readings(np.random.default_rng(seed), (0, 60, 120, 180, 240, 300), leans=leans)
        found = level(made, truth.given)
        w = rotation.to_small_vector(truth.a3 @ found.a3.T)
        chi2.append(w @ np.linalg.solve(found.covariance, w))
        turn = np.sqrt(made.mean_plumb @ found.covariance @ made.mean_plumb)
        assert turn < 3 * SCA100T / np.radians(np.std(leans)) / np.sqrt(6)
    assert np.mean(chi2) == pytest.approx(3, abs=4 * np.sqrt(6 / 30))


@pytest.mark.parametrize("noise", [SCA100T, QUIET])
def test_without_a_lean_the_turn_stays_what_it_was(noise):
    """Its error is as for any angle."""
    for seed in range(10):
        made, truth = readings(np.random.default_rng(seed), FOUR, noise)
        found = level(made, truth.given)
        turned = found.a3 @ truth.given.T
        angle = np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1))
        at = made.mean_plumb
        assert np.sqrt(at @ found.covariance @ at) > np.radians(60)
        assert angle < np.radians(150)


@pytest.mark.parametrize("noise", [SCA100T, QUIET])
@pytest.mark.parametrize("lean", [0.05, 1.0])
@pytest.mark.parametrize("headings", [(0, 180), FOUR, MANY])
def test_about_an_axis_that_leans_the_zenith_is_lost_on_a_circle(headings, lean, noise):
    """However often: turn A3 about it, and the zenith goes round it.  A raised foot decides (above), or a prior."""
    for seed in range(3):
        made, truth = readings(np.random.default_rng(seed), headings, noise, lean=lean)
        found = level(made, truth.given)
        assert found.astray == pytest.approx(np.sqrt(1.5) * np.radians(lean), rel=0.3)
        assert np.linalg.norm(found.zenith - truth.zenith) < 2 * found.astray
        narrow = level(made, truth.a3, np.radians(0.5))
        assert narrow.astray < np.radians(0.5) * np.radians(lean) * 1.1 + np.radians(0.5) * 4 * noise
        assert np.linalg.norm(narrow.zenith - truth.zenith) < 4 * np.hypot(narrow.astray, narrow.zenith_sigma)


@pytest.mark.parametrize("noise", [SCA100T, QUIET])
def test_a_zero_that_wanders_is_no_lean(noise):
    for seed in range(10):
        made, truth = readings(np.random.default_rng(seed), MANY, noise, wander=30 * ARCSEC)
        # No FixError.
        level(made, truth.given)


def test_one_heading_tells_nothing_and_says_so():
    """SAME_AXIS: no turn, no axis of a turn; A3 stays as given and its plumb line is unknown to degrees."""
    for seed in range(10):
        made, truth = readings(np.random.default_rng(seed), (20, 20, 20, 20))
        found = level(made, truth.given)
        at = made.mean_plumb
        assert np.linalg.norm(found.a3 - truth.given) < 1e-3
        assert np.degrees(found.stddev_across(at)) > 5
        assert np.linalg.norm(plumb_error(found, truth, at)) < 3 * found.stddev_across(at)


@pytest.mark.parametrize("turn_arcsec", [5, 20, 60, 600, 36000])
def test_the_smaller_the_turn_the_wider_the_claim(turn_arcsec):
    """Never narrower than the circle that the zenith goes round is seen; and an answer, not frames that disagree."""
    for seed in range(8):
        made, truth = readings(np.random.default_rng(seed), (0, turn_arcsec / 3600, 2 * turn_arcsec / 3600))
        found = level(made, truth.given)
        at = made.mean_plumb
        assert found.scatter < 12
        assert chi2_of_plumb(found, truth, at) < 16
        seen = SCA100T / np.sqrt(2) / (turn_arcsec * ARCSEC)
        # No A3 is off by more.
        assert found.stddev_across(at) > 0.9 / np.hypot(1 / seen, 1 / np.radians(10))


def test_frames_of_two_places_scatter():
    """One half under a zenith 20 km off."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        made, truth = readings(rng, MANY)
        away = rotation.from_vector(0.003 * np.cross(truth.zenith, [0.6, 0.8, 0.0]))
        moved = made.to_camera.copy()
        moved[9:] = moved[9:] @ away
        for found in (
            level(replace(made, to_camera=moved), truth.given),
            hang(replace(made, to_camera=moved), truth.given, truth.zenith, 0.0, np.pi),
        ):
            assert np.sqrt(np.mean(found.left**2)) > 0.0005
        assert level(made, truth.given).scatter < 3
        assert hang(made, truth.given, truth.zenith, 0.0, np.pi).scatter < 3


@pytest.mark.montecarlo
@pytest.mark.parametrize("noise", [SCA100T, QUIET])
@pytest.mark.parametrize("bad", [(0,), (3, 10), (17,)])
def test_misread_tilts_stand_out_and_pull_no_harder_than_three_sigma(bad, noise):
    for seed in range(5):
        made, truth = readings(np.random.default_rng(seed), MANY, noise)
        plumb = made.plumb.copy()
        for k in bad:
            plumb[k] = rotation.from_vector([0.01, -0.02 * (k + 1) / 10, 0]) @ plumb[k]
        found = level(replace(made, plumb=plumb), truth.given)
        off = np.linalg.norm(found.left, axis=1) / noise
        assert set(np.argsort(off)[-len(bad) :]) == set(bad)
        assert off[list(bad)].min() > 20 > 6 > np.delete(off, bad).max()
        # the pull of 3 sigma from each, besides the noise
        pull = (4 + 3.5 * len(bad)) * noise * np.sqrt(2) / np.sqrt(len(MANY))
        assert np.linalg.norm(plumb_error(found, truth, made.mean_plumb)) < pull * 1.5


HUNG = {
    "one frame": {"headings": (30,)},
    "one heading": {"headings": (30,) * 5},
    "a zero that wanders": {"headings": (30,) * 8, "wander": 30 * ARCSEC},
    "two leans": {"headings": (30,) * 4, "leans": (0, 0, 5, 5)},
    "all round": {"headings": FOUR, "leans": (0, 3, -3, 1)},
}


@pytest.mark.montecarlo
@pytest.mark.parametrize("site", [0.0, 20 * ARCSEC])
@pytest.mark.parametrize("noise", [SCA100T, QUIET])
@pytest.mark.parametrize("kind", HUNG)
def test_hang_errs_as_it_says(kind, noise, site):
    """The zenith is known, or off by as much as is said of it."""
    plumb, whole = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        made, truth = readings(rng, noise=noise, **HUNG[kind])
        off = rotation.from_vector(rng.normal(0, site, 3))
        found = hang(made, truth.given, off @ truth.zenith, site, np.pi)
        plumb.append(chi2_of_plumb(found, truth, made.mean_plumb))
        w = rotation.to_small_vector(truth.a3 @ found.a3.T)
        whole.append(w @ np.linalg.solve(found.covariance, w))
    assert np.mean(plumb) == pytest.approx(2, abs=3.5 * np.sqrt(4 / 12))
    if "leans" in HUNG[kind]:
        assert np.mean(whole) == pytest.approx(3, abs=3.5 * np.sqrt(6 / 12))


def test_under_a_known_zenith_two_frames_that_disagree_are_seen():
    made, truth = readings(np.random.default_rng(1), (30, 30))
    plumb = made.plumb.copy()
    plumb[0] = rotation.from_vector([0.002, 0.0, 0.0]) @ plumb[0]
    assert hang(made, truth.given, truth.zenith, 0.0, np.pi).scatter < 5
    assert hang(replace(made, plumb=plumb), truth.given, truth.zenith, 0.0, np.pi).scatter > 16


def test_a_turn_that_is_held_stays_near_the_given():
    made, truth = readings(np.random.default_rng(2), (30, 30, 30))
    at = made.mean_plumb
    given = rotation.from_vector(np.radians(2) * at) @ truth.a3
    found = hang(made, given, truth.zenith, 0.0, np.radians(1))
    turn = at @ rotation.to_small_vector(found.a3 @ truth.a3.T)
    assert np.degrees(turn) == pytest.approx(2, abs=0.01)
    assert np.sqrt(at @ found.covariance @ at) == pytest.approx(np.radians(1), rel=0.01)


def test_a_weak_lean_and_a_wide_prior_meet_between_them():
    """Leans determine the turn to 30 deg, the given A3 is stated to 30 deg: it ends half way, wherever it began."""
    lean = np.degrees(SCA100T / np.radians(30) * np.sqrt(2))
    off, chi2 = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        made, truth = readings(rng, (30, 30), leans=(0, lean))
        at = made.mean_plumb
        given = rotation.from_vector(rng.normal(0, np.radians(30)) * at) @ truth.a3
        found = hang(made, given, truth.zenith, 0.0, np.radians(30))
        turned = found.a3 @ truth.a3.T
        w = (
            at
            @ np.array(
                [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
            )
            / 2
        )
        w = np.arctan2(w, (np.trace(turned) - 1) / 2)
        off.append(w)
        chi2.append(w**2 / (at @ found.covariance @ at))
    assert np.degrees(np.std(off)) < 27
    assert np.mean(chi2) == pytest.approx(1, abs=4 * np.sqrt(2 / 25))


def test_the_prior_of_the_turn_counts_from_the_given_a3():
    """Half a turn off by leans that determine it to 15 deg, and stated to 30: the answer lies between, towards the
    leans; where every start had a prior of its own, it was theirs alone."""
    lean = np.degrees(SCA100T / np.radians(15) * np.sqrt(2))
    between = []
    for seed in range(12):
        made, truth = readings(np.random.default_rng(seed), (30, 30), leans=(0, lean))
        given = rotation.from_vector(np.pi * made.mean_plumb) @ truth.a3
        found = hang(made, given, truth.zenith, 0.0, np.radians(30))
        between.append(np.degrees(np.arccos(np.clip((np.trace(found.a3 @ given.T) - 1) / 2, -1, 1))))
    assert 90 < np.median(between) < 160


def test_half_a_turn_of_a3_is_found_from_anywhere():
    """Half a turn off, the slope of the turn is nothing: a search from the given A3 alone would stay there."""
    for seed in range(10):
        made, truth = readings(np.random.default_rng(seed), FOUR, leans=(0, 3, -3, 1))
        given = rotation.from_vector(np.pi * made.mean_plumb) @ truth.a3
        found = hang(made, given, truth.zenith, 0.0, np.pi)
        assert np.linalg.norm(found.a3 - truth.a3) < 0.02


def test_covariances_are_symmetric_and_positive():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        made, truth = readings(rng, rng.uniform(0, 360, int(rng.integers(3, 9))), wander=ARCSEC)
        for found in (level(made, truth.given), hang(made, truth.given, truth.zenith, 0.0, np.pi)):
            np.testing.assert_array_equal(found.covariance, found.covariance.T)
            assert np.linalg.eigvalsh(found.covariance)[0] > 0
            assert np.linalg.det(found.a3) == pytest.approx(1)
