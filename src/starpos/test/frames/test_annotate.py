# SPDX-License-Identifier: Apache-2.0
"""The picture for people: things where they belong, whatever the frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from starpos.frames import annotate as module
from starpos.frames.annotate import DETECTED, FLAGGED, IDENTIFIED, Identified, annotate, shrink
from starpos.frames.frame import SATURATED, Frame, Stars, no_stars

SIZE = (641, 483)


def stars_at(places, size=SIZE, flags=0) -> Stars:
    x, y = np.asarray(places, float).reshape(-1, 2).T
    n = len(x)
    covariance = np.tile(np.eye(2) * 1e-3, (n, 1, 1))
    return Stars(
        x=x,
        y=y,
        flux=np.linspace(9e4, 1e4, n),
        snr=np.full(n, 50.0),
        covariance=covariance,
        flags=np.full(n, flags),
        width=size[0],
        height=size[1],
        mid_unix_s=1.8e9,
        exposure_s=0.5,
    )


def frame_of(places, size=SIZE, kind="mono16", sigma=1.5) -> Frame:
    """Noise and a round star at each place."""
    x, y = (np.arange(n) for n in size)
    light = np.random.default_rng(0).normal(40.0, 2.0, (size[1], size[0]))
    for cx, cy in places:
        across, down = (np.exp(-(off**2) / (2 * sigma**2)) for off in (x - cx, y - cy))
        light += 180.0 * np.outer(down, across)
    if kind.endswith("16"):
        pixels = (100 * light).clip(0, 65535).astype(np.uint16)
    else:
        pixels = light.clip(0, 255).astype(np.uint8)
    if kind == "bgr8":
        pixels = np.dstack([pixels] * 3)
    return Frame(pixels, pattern=kind[6:10] if kind.startswith("bayer") else "")


def sky(picture, frame) -> np.ndarray:
    """The picture without its caption."""
    return picture[: max(1, frame.height // shrink(frame))]


def coloured(picture, colour) -> np.ndarray:
    """(N, 2) x, y of the pixels that are of a colour, paler or full."""
    away = np.abs(picture.astype(int) - colour).max(2)
    return np.argwhere(away < 40)[:, ::-1]


KINDS = ("mono8", "mono16", "bgr8", "bayer_rggb8", "bayer_gbrg16")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [SIZE, (1601, 1203), (5003, 1207)])
def test_a_circle_is_around_the_light_of_its_star(kind, size):
    place = (size[0] * 0.43, size[1] * 0.61)
    frame = frame_of([place], size, kind, sigma=3.0)
    n = shrink(frame)
    picture = sky(annotate(frame, stars_at([place], size)), frame)
    assert max(picture.shape) <= 1600
    expected = (np.array(place) + 0.5) / n - 0.5
    ring = coloured(picture, DETECTED)
    away = np.hypot(*(ring - expected).T)
    assert len(ring) > 20 and away.min() > 7.5 and away.max() < 10.5
    chroma = np.ptp(picture, axis=2).astype(float)
    rows, columns = np.indices(chroma.shape)
    centre = [np.average(columns, weights=chroma), np.average(rows, weights=chroma)]
    np.testing.assert_allclose(centre, expected, atol=0.3)
    light = np.where(np.ptp(picture, axis=2) < 10, picture[..., 0], 0).astype(float)
    rows, columns = np.nonzero(light > 128)
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=0.6)


@pytest.mark.parametrize("kind", KINDS)
def test_background_is_dark_and_stars_are_white(kind):
    frame = frame_of([(100, 100), (400, 300)], kind=kind)
    picture = sky(annotate(frame, no_stars(*SIZE)), frame)
    assert np.median(picture) < 30 and picture.max() == 255


def test_a_strong_gradient_leaves_its_stars_to_be_seen():
    places = [(60, 240), (580, 240)]
    frame = frame_of(places)
    # Over a star of 18000.
    slope = np.linspace(0, 20000, SIZE[0])
    bright = Frame((frame.pixels + slope).astype(np.uint16))
    picture = annotate(bright, no_stars(*SIZE))[..., 0].astype(int)
    for x, y in places:
        assert picture[y, x] - np.median(picture[y - 30 : y + 30, x - 30 : x + 30]) > 25


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "grbg", "gbrg"])
@pytest.mark.parametrize("size", [(641, 483), (1999, 1201), (4801, 3001)])
def test_a_mosaic_leaves_no_chequers(pattern, size):
    pixels = np.zeros((size[1], size[0]), np.uint16)
    pixels[::2, ::2], pixels[::2, 1::2], pixels[1::2, ::2], pixels[1::2, 1::2] = 900, 2000, 2100, 600
    frame = Frame(pixels, pattern=pattern)
    assert np.ptp(sky(annotate(frame, no_stars(*size)), frame)) == 0


def test_each_kind_has_its_colour_in_picture_and_caption():
    places = [(100, 100), (300, 100), (500, 100)]
    stars = stars_at(places)
    flags = np.array([0, 0, SATURATED])
    stars = replace(stars, flags=flags)
    frame = frame_of(places)
    picture = annotate(frame, stars, Identified([1], ["HIP 1"], [7.0]))
    for (x, y), colour in zip(places, (DETECTED, IDENTIFIED, FLAGGED), strict=True):
        ring = coloured(picture[y - 10 : y + 11, x - 10 : x + 11], colour)
        assert len(ring) > 15
        assert len(coloured(picture[SIZE[1] :], colour)) > 15


def written(monkeypatch) -> list:
    """What is written in the picture from now on: (text, left, top, right, bottom)."""
    texts = []
    put = cv2.putText

    def spy(image, text, origin, font, scale, colour, thickness, *rest):
        (width, ascent), descent = cv2.getTextSize(text, font, scale, 1)
        if colour != module.OUTLINE:
            texts.append((text, origin[0], origin[1] - ascent, origin[0] + width, origin[1] + descent))
        return put(image, text, origin, font, scale, colour, thickness, *rest)

    monkeypatch.setattr(module.cv2, "putText", spy)
    return texts


def test_a_name_stands_beside_its_star_with_its_magnitude(monkeypatch):
    texts = written(monkeypatch)
    place = (200.0, 150.0)
    frame, stars = frame_of([place]), stars_at([place])
    named = annotate(frame, stars, Identified([0], ["HIP 32349"], [-1.44]))
    text, left, top, _, bottom = texts[0]
    assert text == "HIP 32349  -1.4"
    assert 9 < left - place[0] < 20 and top < place[1] < bottom
    changed = np.argwhere((sky(named, frame) != sky(annotate(frame, stars), frame)).any(2))
    assert len(coloured(named[top : bottom + 1, left : left + 40], IDENTIFIED)) > 20
    assert changed[:, 1].max() < left + 200


def test_an_unknown_magnitude_is_left_out(monkeypatch):
    texts = written(monkeypatch)
    annotate(frame_of([]), stars_at([(99, 99)]), Identified([0], ["TYC 1-2-3"], [np.nan]))
    assert texts[0][0] == "TYC 1-2-3"


@pytest.mark.parametrize("count", [2, 40, 300, 5000])
def test_names_keep_off_each_other_and_their_stars_and_stay_inside(monkeypatch, count):
    texts = written(monkeypatch)
    size = (1500, 1000)
    places = np.random.default_rng(count).uniform(0, size, (count, 2))
    names = [f"TYC {k}-999-1" for k in range(count)]
    picture = annotate(
        Frame(np.full(size[::-1], 7, np.uint8)),
        stars_at(places, size),
        Identified(range(count), names, [9.0] * count),
    )
    labels = [t for t in texts if t[0].startswith("TYC")]
    assert min(count, 25) <= len(labels) <= 40 or count == 2 == len(labels)
    assert picture.shape[1] == size[0]
    for k, (text, left, top, right, bottom) in enumerate(labels):
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1], text
        for _, left2, top2, right2, bottom2 in labels[:k]:
            assert right <= left2 or right2 <= left or bottom <= top2 or bottom2 <= top, text
        x, y = places[:40].T
        assert not np.any((x > left) & (x < right) & (y > top) & (y < bottom)), text


def test_the_caption_tells_time_counts_and_remarks_and_wraps(monkeypatch):
    texts = written(monkeypatch)
    frame = frame_of([])
    remark = "no part of the sky matches its 27 stars: check the focal length, clouds and exposure " * 2
    one, many = (
        annotate(frame, no_stars(*SIZE, mid_unix_s=1.8e9)),
        annotate(frame, no_stars(*SIZE, mid_unix_s=1.8e9), remarks=[remark]),
    )
    words = [text for text, *_ in texts]
    assert " ".join(words[:9]) == "2027-01-15 08:00:00.000 UTC 0 stars 0 identified 0 flagged"
    assert words[-2:] == ["and", "exposure"]
    assert many.shape[0] >= one.shape[0] + 2 * 18
    assert all(right <= SIZE[0] for *_, right, _ in texts)
    assert many[SIZE[1] :].max() > 200


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (1, 3), (3, 3), (9, 40), (1, 5000), (40000, 1), (40000, 3)])
@pytest.mark.parametrize("pattern", ["", "grbg"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("value", [0, 255])
def test_frames_that_are_no_frames_make_pictures_too(size, pattern, kind, value):
    frame = Frame(np.full(size[::-1], value, kind), pattern=pattern)
    picture = annotate(frame, stars_at([(0, 0)], size), Identified([0], ["HIP 1"], [3.0]), ["no solver"])
    assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[1] <= 1600


def test_the_frame_is_not_written_to():
    frame = frame_of([(50, 50)], kind="bgr8")
    before = frame.pixels.copy()
    annotate(frame, stars_at([(50, 50)]), Identified([0], ["HIP 1"], [3.0]))
    np.testing.assert_array_equal(frame.pixels, before)
