# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy import ndimage

from starpos.detection import DetectionSettings, detect
from starpos.errors import FrameError
from starpos.frames.frame import BLENDED, EDGE, ELONGATED, SATURATED, Frame
from starpos_testing.skies.rendered import BIAS, bound, coloured, field, grid, match, noisy

# In px: half a second of the sky.
TRAIL = (2.6, -2.2)


def errors(size, frames, electrons, seed, pattern="", gains=None, **shape):
    """Errors (M, 2) px, errors over their claimed sigmas, and how many stars were missed or invented."""
    rng = np.random.default_rng(seed)
    error, pull, missed, invented = [], [], 0, 0
    for _ in range(frames):
        stars = grid(size, 30, electrons, rng)
        pixels = noisy(field(size, stars, gains=gains and gains(len(stars), rng), **shape), rng)
        found = detect(Frame(pixels, pattern=pattern)).stars
        index = match(found, stars)
        missed += np.count_nonzero(index < 0)
        invented += len(found) - len(set(index[index >= 0]))
        hit = index[index >= 0]
        d = np.stack([found.x[hit], found.y[hit]], 1) - stars[index >= 0, :2]
        error.append(d)
        pull.append(d / np.sqrt(np.einsum("nii->ni", found.covariance[hit])))
    return np.concatenate(error), np.concatenate(pull), missed, invented


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


@pytest.mark.parametrize("electrons", [1500, 8000, 80000])
def test_trailed_stars_are_measured_at_the_cramer_rao_bound(electrons):
    error, pull, missed, invented = errors((520, 520), 3, electrons, seed=1, trail=TRAIL)
    assert (missed, invented) == (0, 0)
    assert np.all(rms(error) < 1.08 * bound(electrons, trail=TRAIL))
    assert 0.92 < rms(pull.ravel()) < 1.08
    assert np.all(np.abs(error.mean(0)) < 4 * bound(electrons, trail=TRAIL) / np.sqrt(len(error)))


@pytest.mark.parametrize(("fwhm", "electrons"), [(1.2, 4000), (8.0, 30000)])
def test_undersampled_and_defocused_stars_keep_near_the_bound(fwhm, electrons):
    error, pull, missed, invented = errors((520, 520), 2, electrons, seed=2, fwhm=fwhm)
    assert (missed, invented) == (0, 0)
    assert np.all(rms(error) < 1.12 * bound(electrons, fwhm))
    assert 0.9 < rms(pull.ravel()) < 1.1


def rings(diameter, electrons, rng, size=(500, 500)):
    """Electrons of stars out of focus in a telescope with an obstruction, and the stars (N, 3)."""
    # In px, each of five dots.
    y, x = np.mgrid[: 5 * size[0], : 5 * size[1]] / 5 - 0.4
    light, stars = np.zeros(size), grid(size, 45, electrons, rng)
    for star in stars:
        near = np.s_[
            5 * int(star[1]) - 75 : 5 * int(star[1]) + 80, 5 * int(star[0]) - 75 : 5 * int(star[0]) + 80
        ]
        r = np.hypot(x[near] - star[0], y[near] - star[1])
        ring = ndimage.gaussian_filter(1.0 * ((r < diameter / 2) & (r > 0.2 * diameter)), 4)
        ring = ring.reshape(31, 5, 31, 5).sum((1, 3))
        light[int(star[1]) - 15 : int(star[1]) + 16, int(star[0]) - 15 : int(star[0]) + 16] += electrons * (
            ring / ring.sum()
        )
    return light, stars


@pytest.mark.montecarlo
@pytest.mark.parametrize(
    ("diameter", "electrons"), [(8, 8000), (8, 30000), (11, 30000), (14, 8000), (14, 30000)]
)
def test_defocused_stars_with_a_hole_are_one_star_each(diameter, electrons, rng):
    light, stars = rings(diameter, electrons, rng)
    found = detect(Frame(noisy(light + 20, rng))).stars
    index = match(found, stars)
    assert np.all(index >= 0) and len(found) == len(stars)
    assert np.all(found.flags == 0)
    error = np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]
    assert np.all(np.abs(error.mean(0)) < 4 * rms(error) / np.sqrt(len(stars)))
    assert np.all(rms(error) < (0.03 if electrons > 10000 else 0.07))
    assert 0.5 < rms((error / np.sqrt(np.einsum("nii->ni", found.covariance[index]))).ravel()) < 1.2


@pytest.mark.montecarlo
def test_hot_pixels_do_not_hide_that_stars_are_rings(rng):
    light, stars = rings(14, 30000, rng)
    pixels = noisy(light + 20, rng)
    y, x = rng.integers(0, 500, (2, 100))
    y, x = np.array([y, x])[:, np.hypot(x[:, None] - stars[:, 0], y[:, None] - stars[:, 1]).min(1) > 16]
    pixels[y, x] = 6000
    found = detect(Frame(pixels)).stars
    index = match(found, stars)
    assert len(x) > 50
    assert np.mean(index >= 0) > 0.97
    assert len(found) <= 1.05 * len(stars)


@pytest.mark.parametrize("fwhm", [1.2, 1.3])
def test_error_does_not_depend_on_where_in_a_pixel_a_star_falls(fwhm):
    rng = np.random.default_rng(3)
    stars = grid((700, 700), 28, 60000, rng)
    found = detect(Frame(noisy(field((700, 700), stars, fwhm=fwhm), rng))).stars
    index = match(found, stars)
    error = np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]
    phase = 2 * np.pi * stars[:, :2]
    for wave in (np.sin(phase), np.cos(phase), np.sin(2 * phase)):
        amplitude = 2 * np.mean(error * wave, axis=0)
        assert np.all(np.abs(amplitude) < (0.004 if fwhm < 1.3 else 0.002))


@pytest.mark.montecarlo
@pytest.mark.parametrize("pattern", ["rggb", ""])
def test_a_mosaic_declared_or_not_shifts_no_star_whatever_its_colour(pattern):
    error, pull, missed, invented = errors(
        (520, 520), 3, 20000, seed=4, pattern=pattern, gains=coloured, trail=TRAIL
    )
    assert (missed, invented) == (0, 0)
    assert np.all(rms(error) < 1.3 * bound(20000, trail=TRAIL, gain=np.array([[0.65, 1], [1, 0.65]])))
    assert 0.9 < rms(pull.ravel()) < 1.1
    assert np.all(np.abs(error.mean(0)) < 0.004)


@pytest.mark.montecarlo
@pytest.mark.parametrize("fwhm", [1.2, 1.4, 1.6])
def test_colours_of_undersampled_stars_are_told_from_their_shape(fwhm):
    error, pull, missed, invented = errors(
        (520, 520), 4, 20000, seed=3, pattern="rggb", gains=coloured, fwhm=fwhm
    )
    assert (missed, invented) == (0, 0)
    # four gains of its own cost a star 19 %, 10 % and 3 %
    assert np.all(rms(error) < 1.25 * bound(20000, fwhm, gain=np.array([[0.65, 1], [1, 0.65]])))
    assert 0.88 < rms(pull.ravel()) < 1.1


def test_colours_of_a_bgr_frame_are_added():
    rng = np.random.default_rng(5)
    stars = grid((300, 300), 50, 6000, rng)
    light = field((300, 300), stars, sky=40) / 30
    channels = [
        np.clip(np.rint(light * g + rng.normal(8, 1.5, light.shape)), 0, 255) for g in (0.6, 1.0, 0.8)
    ]
    found = detect(Frame(np.stack(channels, 2).astype(np.uint8))).stars
    index = match(found, stars)
    assert len(found) == len(stars) and np.all(index >= 0)
    assert np.all(rms(np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]) < 0.05)


def test_nothing_is_invented_from_noise():
    rng = np.random.default_rng(6)
    for _ in range(2):
        pixels = np.rint(rng.normal(500, 7, (1500, 1500))).astype(np.uint16)
        detection = detect(Frame(pixels))
        assert len(detection.stars) == 0
        assert detection.background == pytest.approx(500, abs=0.1)
        assert detection.noise == pytest.approx(np.hypot(7, 12**-0.5), rel=0.02)


def test_faint_stars_down_to_snr_8_are_found():
    # matched SNR of a star of E electrons in this sky is E / sqrt(4 pi s^2 (sky + read^2)), s^2 = 1.04 + 1/12
    noise = np.sqrt(4 * np.pi * (1.04 + 1 / 12) * (20 + 25))
    _, _, missed, invented = errors((520, 520), 2, 9 * noise, seed=7)
    # There are 512.
    assert missed < 10 and invented == 0


def test_moonlit_gradient_hot_pixels_and_cosmic_rays_add_no_star():
    rng = np.random.default_rng(8)
    size = (600, 600)
    stars = grid(size, 50, 12000, rng)
    moon = np.add.outer(np.linspace(0, 1500, 600), np.linspace(200, 900, 600))
    pixels = noisy(field(size, stars, trail=TRAIL, sky=0) + moon, rng).astype(np.int64)
    bad = rng.integers(4, 596, (2, 150))
    bad = bad[:, np.hypot(*(bad[::-1, :, None] - stars.T[:2, None])).min(1) > 14]
    pixels[bad[0], bad[1]] += rng.integers(400, 30000, bad.shape[1])
    rays = bad[:, :40]
    pixels[rays[0] + 1, rays[1]] += 800
    found = detect(Frame(np.clip(pixels, 0, 65535).astype(np.uint16))).stars
    index = match(found, stars)
    assert np.all(index >= 0)
    assert len(found) == len(stars)


def test_saturated_edge_blended_and_elongated_stars_are_flagged_and_others_not():
    rng = np.random.default_rng(10)
    size = (400, 400)
    stars = grid(size, 80, 15000, rng)
    special = np.array(
        [
            # Far over the full well.
            [120.3, 120.4, 9e5],
            # Half outside.
            [1.2, 200.4, 15000],
            [280.2, 120.1, 15000],
            # Its neighbour 2.8 px off.
            [283.0, 120.3, 12000],
            [120.2, 280.0, 9000],
            # A pair closer than the resolution: one long image.
            [120.2, 282.1, 9000],
        ]
    )
    light = field(size, np.concatenate([stars, special]))
    found = detect(Frame(noisy(light, rng, top=16383))).stars
    flags = np.where((index := match(found, special, 2.0)) >= 0, found.flags[index], 0)
    assert flags[0] & SATURATED
    assert np.hypot(found.x[index[0]] - 120.3, found.y[index[0]] - 120.4) < 0.1
    assert flags[1] & EDGE
    assert flags[2] & BLENDED and flags[3] & BLENDED
    assert flags[4] & (ELONGATED | BLENDED)
    assert np.all(found.flags[match(found, stars)] == 0)


def test_a_hot_pixel_on_a_star_costs_little():
    rng = np.random.default_rng(11)
    stars = grid((400, 400), 40, 15000, rng)
    pixels = noisy(field((400, 400), stars, trail=TRAIL), rng)
    hit = stars[::3]
    pixels[np.rint(hit[:, 1]).astype(int) + 3, np.rint(hit[:, 0]).astype(int) + 1] += 1500
    found = detect(Frame(pixels)).stars
    index = match(found, stars)
    error = np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]
    assert np.all(index >= 0) and len(found) == len(stars)
    assert np.all(rms(error[::3]) < 1.5 * bound(15000, trail=TRAIL))


def test_eight_bits_are_enough():
    rng = np.random.default_rng(12)
    stars = grid((400, 400), 40, 10000, rng)
    light = field((400, 400), stars)
    pixels = np.clip(np.rint((rng.poisson(light) + rng.normal(0, 5, light.shape)) / 12 + 6), 0, 255)
    found = detect(Frame(pixels.astype(np.uint8))).stars
    index = match(found, stars)
    assert len(found) == len(stars) and np.all(index >= 0)
    assert np.all(rms(np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]) < 1.2 * bound(10000))


def test_chi_square_tells_the_star_that_is_not_like_the_others():
    rng = np.random.default_rng(16)
    stars = grid((400, 400), 40, 15000, rng)
    # The first is a nebula.
    fwhm = np.where(np.arange(len(stars)) == 0, 3.2, 2.4)
    detection = detect(Frame(noisy(field((400, 400), stars, fwhm), rng)))
    index = match(detection.stars, stars[1:])
    assert len(detection.chi2) == len(detection.stars) and np.all(index >= 0)
    assert np.mean(detection.chi2[index]) == pytest.approx(1, abs=0.06)
    assert detection.typical_chi2 == pytest.approx(1, abs=0.06)
    odd = np.setdiff1d(np.arange(len(detection.stars)), index)
    assert np.all(detection.chi2[odd] > 1.6)
    assert len(detect(Frame(np.zeros((80, 80), np.uint16))).chi2) == 0


def test_time_size_and_source_reach_the_stars_brightest_first():
    rng = np.random.default_rng(13)
    stars = grid((200, 300), 50, lambda n: np.geomspace(2000, 50000, n), rng)
    found = detect(
        Frame(
            noisy(field((200, 300), stars), rng),
            pattern="",
            mid_unix_s=1.75e9,
            exposure_s=0.5,
            source="night 1",
            focal_px=1000.0,
        )
    ).stars
    assert (found.width, found.height, found.mid_unix_s, found.exposure_s) == (300, 200, 1.75e9, 0.5)
    assert (found.source, found.focal_px) == ("night 1", 1000.0)
    assert np.all(np.diff(found.flux) <= 0)
    assert found.flux == pytest.approx(np.sort(stars[:, 2])[::-1], rel=0.1)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (3, 5), (7, 7), (40, 3), (64, 64), (65, 130)])
@pytest.mark.parametrize("value", [0, 1, 65535])
def test_a_frame_of_one_value_has_no_stars(shape, value):
    assert len(detect(Frame(np.full(shape, value, np.uint16))).stars) == 0
    assert len(detect(Frame(np.full((*shape, 3), min(value, 255), np.uint8))).stars) == 0


def test_one_pixel_brighter_than_light_makes_does_not_hide_what_is_full():
    rng = np.random.default_rng(21)
    stars = grid((300, 300), 60, 2_000_000, rng)
    pixels = np.minimum(noisy(field((300, 300), stars), rng), 16383)
    before = detect(Frame(pixels)).stars
    assert np.sum(before.flags & SATURATED > 0) >= 5
    pixels[0, 0] = 65535
    after = detect(Frame(pixels)).stars
    np.testing.assert_array_equal(after.flags, before.flags)


def test_the_brightest_stars_are_kept_not_the_brightest_hot_pixels():
    rng = np.random.default_rng(22)
    stars = grid((300, 300), 50, 12000, rng)
    pixels = noisy(field((300, 300), stars), rng)
    hot = rng.integers(0, 300, (2, 60))
    pixels[hot[0], hot[1]] = 60000
    assert len(detect(Frame(pixels), DetectionSettings(max_stars=20)).stars) == 20


def test_settings_that_make_no_sense_are_refused():
    for wrong in ({"threshold": 0}, {"max_stars": 0}, {"mesh_px": float("nan")}, {"saturation_dn": -1},
                  {"mesh_px": 33.5}, {"max_stars": 5.5}, {"max_stars": "5"}):  # fmt: skip
        with pytest.raises(FrameError, match="detection setting"):
            DetectionSettings(**wrong)
    rng = np.random.default_rng(15)
    stars = grid((300, 300), 50, 12000, rng)
    pixels = noisy(field((300, 300), stars), rng)
    assert len(detect(Frame(pixels), DetectionSettings(max_stars=5)).stars) == 5
    full = detect(Frame(pixels), DetectionSettings(saturation_dn=BIAS + 800)).stars
    assert np.all(full.flags & SATURATED)
