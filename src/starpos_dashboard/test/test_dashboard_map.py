# SPDX-License-Identifier: Apache-2.0
"""The dashboard's map as a person sees it."""

import math

import numpy as np
import pytest
import said
from browser import ELLIPSES, metres_per_px


def middle(box) -> tuple[float, float]:
    return box[0] + box[2] / 2, box[1] + box[3] / 2


def test_the_ellipses_have_their_size_place_and_lean_at_the_scale_of_the_map(page):
    def redrawn():
        """Both ellipses at the map's scale: each is drawn anew by itself."""
        seen = page.run(ELLIPSES)
        sizes = np.array([seen[name][2] for name in ("newest", "average")]) * metres_per_px(seen)
        return sizes == pytest.approx((600, 160), rel=0.01)

    for _ in range(3):
        page.until(redrawn)
        seen = page.run(ELLIPSES)
        per_px = metres_per_px(seen)
        assert seen["newest"][2:] == pytest.approx((600 / per_px, 200 / per_px), rel=0.01, abs=0.5)
        assert seen["outer"][2] == pytest.approx(2.4477 * 600 / per_px, rel=0.01)
        assert seen["average"][2:] == pytest.approx((160 / per_px, 120 / per_px), rel=0.01, abs=0.5)
        (x, y), (ax, ay) = middle(seen["newest"]), middle(seen["average"])
        assert (ax - x, y - ay) == pytest.approx((0.0, 0.0009 * 111195 / per_px), rel=0.01, abs=1.0)
        # its northernmost point lies en / sigma_north = 90 m to the east, the middle of the chord below it 0.92 of that
        assert seen["cap"] - x == pytest.approx(0.92 * 90 / per_px, rel=0.05)
        page.click("zoom-in")
        page.until(lambda p=per_px: metres_per_px(page.run(ELLIPSES)) < 0.6 * p)


@pytest.mark.parametrize("metres, latitude", [(0.5, 48.0), (50_000.0, -33.0), (200.0, 89.9), (200.0, 0.0)])
def test_the_map_fits_ellipses_of_every_size_everywhere(page, metres, latitude):
    page.instrument.works(fix=said.fix(latitude, 179.9999, (metres**2, 0.0, metres**2)), fix_averaged=None)

    def fits():
        seen = page.run(ELLIPSES)
        return seen["newest"][2] > 30 and seen["newest"][2] == pytest.approx(
            2 * metres / metres_per_px(seen), rel=0.01
        )

    page.until(fits)
    labels = page.run("return [...document.querySelectorAll('.labels text')].map((e) => e.textContent)")
    assert len(labels) > 2 and len(labels) == len(set(labels))


def test_the_whole_earth_has_coast_lines_and_the_ellipses_scale_has_none(page):
    land = "return document.querySelector('#map-view .land').getAttribute('d').length"
    page.until(lambda: page.run(land) == 0)
    page.click("zoom-earth")
    page.until(lambda: page.run(land) > 5000)
    sphere = page.run("return document.querySelector('#map-view .sphere').getBBox().width")
    assert metres_per_px(page.run(ELLIPSES)) * sphere == pytest.approx(2 * 6371008.8, rel=0.01)


def test_the_track_has_a_dot_for_every_fix_before(page):
    for k in range(4):
        page.instrument.works(fix=said.fix(48.1373 + 1e-4 * k))
        page.shows(decimal=f"{48.1373 + 1e-4 * k:.4f}° 11.575°")
    dots = "return document.querySelector('.dots').getAttribute('d')"
    # The map is drawn after the texts.
    page.until(lambda: len(set(page.run(dots).split("M")[1:])) >= 3)
    assert "NaN" not in page.run(dots)


def test_a_fix_without_a_known_error_has_no_ellipse(page):
    page.instrument.works(fix=said.fix(48.1373, 11.5755, (nan := math.nan, nan, nan)))
    page.shows(sigma_east="± —", status_sentence="its error is not known")
    drawn = "return ['inner', 'outer'].map((q) => document.querySelector(`#ellipse-newest .${q}`).getAttribute('d'))"
    page.until(lambda: page.run(drawn) == ["", ""])
    assert page.run("return document.querySelector('#ellipse-newest .mark').checkVisibility()")
