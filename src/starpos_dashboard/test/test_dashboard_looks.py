# SPDX-License-Identifier: Apache-2.0
"""Whether the dashboard's page, and a report's, can be read and used: by night, on a phone, by keyboard."""

from contextlib import contextmanager

import pytest
import said
from browser import ELLIPSES, LAMPS, OK, metres_per_px

from starpos.cli import main
from starpos_testing.command_line import A3, OPTICS

CONTRAST = """
const parse = (c) => c.match(/[\\d.]+/g).map(Number);
const bright = ([r, g, b]) => [r, g, b].map((v) => v / 255)
  .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
  .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
const ground = (e) => {
  for (; e; e = e.parentElement) {
    const c = parse(getComputedStyle(e).backgroundColor);
    if (c.length === 3 || c[3] === 1) return c;
  }
  return [0, 0, 0];
};
const found = [];
for (const e of document.querySelectorAll("body *")) {
  const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim());
  if (!own || !e.checkVisibility() || e.namespaceURI.endsWith("svg") || e.closest("noscript")) continue;
  const [a, b] = [bright(parse(getComputedStyle(e).color)), bright(ground(e))];
  found.push([(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), e.id || e.className || e.tagName, e.textContent]);
}
return found;
"""
OVERLAPS = """
const texts = [];
for (const e of document.querySelectorAll("main *, header *")) {
  if (!e.checkVisibility() || e.closest("svg, #map")) continue;
  for (const n of e.childNodes) {
    if (n.nodeType !== 3 || !n.data.trim()) continue;
    const range = document.createRange();
    range.selectNodeContents(n);
    for (const r of range.getClientRects()) texts.push([n.data.trim(), r]);
  }
}
const depth = (a, b) => Math.min(Math.min(a.right, b.right) - Math.max(a.left, b.left),
                                 Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top));
return texts.flatMap(([s, a], i) => texts.slice(i + 1).filter(([, b]) => depth(a, b) > 3).map(([t]) => [s, t]));
"""

# In CSS pixels as they reach the eye: a drawing's are scaled with it.
LETTERS = """
return [...document.querySelectorAll("body *")].filter((e) => e.checkVisibility() && !e.closest("noscript, sub")
  && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim())).map((e) => [
    parseFloat(getComputedStyle(e).fontSize) * (e.getScreenCTM?.().a ?? 1), e.textContent, e.id || e.className]);
"""
# Of each card: the share of its height that lies empty below what it shows.
EMPTY = """
return [...document.querySelectorAll("section:not(#map-card)")].filter((c) => c.checkVisibility()).map((card) => {
  const box = card.getBoundingClientRect();
  const ends = [...card.querySelectorAll("*")].filter((e) => e.checkVisibility() && (e.tagName === "IMG"
    || (e.textContent.trim() && !e.children.length))).map((e) => e.getBoundingClientRect().bottom);
  return [(box.bottom - Math.max(...ends)) / box.height, card.id];
});
"""


@contextmanager
def screen(page, width, height, scale=1, mobile=False):
    metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        page.until(lambda: page.run("return innerWidth") == width)
        yield
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.parametrize("width", [360, 820, 1440])
@pytest.mark.parametrize("speaks", [True, False])
def test_no_text_lies_over_another(page, width, speaks):
    with screen(page, width, 800):
        page.until(lambda: page.is_dressed("missing") == [] and page.run(LAMPS))
        if not speaks:
            page.instrument.says = {}
            page.until(
                lambda: (
                    all(lamp[1] == "SILENT" for lamp in page.run(LAMPS)) and len(page.is_dressed("old")) == 6
                )
            )
        assert page.run(OVERLAPS) == []


@pytest.mark.parametrize("width, height", [(360, 740), (820, 1180), (1366, 768), (1920, 1080), (2560, 1440)])
def test_no_card_is_empty_by_a_third_and_no_letter_too_small(page, width, height):
    lights = [(f"solver: Task{k}", OK, "all is well") for k in range(9)]
    page.instrument.works(**{"/diagnostics": said.diagnostics(*lights)})
    with screen(page, width, height):
        page.until(lambda: len([lamp for lamp in page.run(LAMPS) if "Task" in lamp[0]]) == 9)
        page.until(lambda: page.run("return document.images.frame.checkVisibility()"))
        # a drawing is laid out anew some time after the window has its size
        page.until(lambda: max(page.run(EMPTY))[0] < 0.3)
        page.until(lambda: min(page.run(LETTERS))[0] >= 11)
        page.until(lambda: page.run("return document.documentElement.scrollWidth") <= width)


def test_a_nights_report_fits_a_phone(driver, tmp_path):
    night, report = tmp_path / "night", tmp_path / "report"
    assert main(["simulate", str(night), "-n", "2", "--stars-only", "--size", "1000", "700", *OPTICS]) == 0
    assert main(["report", str(night), *OPTICS, *A3, "-o", str(report)]) == 0
    metrics = {"width": 360, "height": 740, "deviceScaleFactor": 3, "mobile": True}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        driver.get((report / "index.html").as_uri())
        shown = driver.execute_script("return [...document.images].map((e) => [e.naturalWidth, e.width])")
        assert len(shown) > 5 and all(natural > 0 and 0 < width <= 360 for natural, width in shown)
        assert driver.execute_script("return document.documentElement.scrollWidth") <= 360
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        driver.get("about:blank")


def test_the_night_is_red_and_is_remembered(page):
    page.click("night")
    page.driver.refresh()
    page.shows(status_word="Fix")
    assert page.driver.find_element("id", "night").get_attribute("aria-pressed") == "true"
    reds = page.run("""
      return [...document.querySelectorAll("body, body *")].filter((e) => e.checkVisibility()).flatMap((e) => {
        const s = getComputedStyle(e);
        return [s.color, s.backgroundColor, s.fill, s.stroke, ...s.scrollbarColor.split(/ (?=rgb)/)]
          .filter((c) => c.startsWith("rgb("));
      })""")
    assert page.run("return getComputedStyle(document.documentElement).scrollbarColor") != "auto"
    for r, g, b in ([float(v) for v in c[4:-1].split(",")] for c in set(reds)):
        assert g <= 0.55 * r and b <= 0.55 * r, (r, g, b)


@pytest.mark.parametrize("night", [False, True])
def test_every_text_can_be_read(page, night):
    if night:
        page.click("night")
    worst = min(page.run(CONTRAST))
    assert worst[0] >= 4.5, worst


def test_a_phone_scrolls_one_way_only(page):
    with screen(page, 360, 740, scale=2, mobile=True):
        assert page.run("return document.documentElement.scrollWidth") == 360
        wide = page.run(
            "return [...document.querySelectorAll('main *')].filter((e) => e.getBoundingClientRect().right > 361"
            " && !e.closest('svg')).map((e) => e.id || e.className)"
        )
        assert wide == []


def test_it_is_worked_by_keyboard_and_told_to_a_screen_reader(page):
    from selenium.webdriver.common.keys import Keys

    focus = "return document.activeElement.id"
    seen = []
    for _ in range(12):
        page.driver.switch_to.active_element.send_keys(Keys.TAB)
        seen.append(page.run(focus))
    assert [s for s in seen if s][:6] == ["night", "map", "zoom-in", "zoom-out", "zoom-fix", "zoom-earth"]
    page.run("document.getElementById('map').focus()")
    before = metres_per_px(page.run(ELLIPSES))
    page.driver.switch_to.active_element.send_keys("+")
    page.until(lambda: metres_per_px(page.run(ELLIPSES)) == pytest.approx(before / 2, rel=0.02))
    page.driver.switch_to.active_element.send_keys(Keys.ARROW_RIGHT)
    page.until(lambda: page.run("return document.getElementById('zoom-fix').ariaPressed") == "false")
    tree = page.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    spoken = [(n["role"]["value"], n.get("name", {}).get("value", "")) for n in tree if not n["ignored"]]
    assert all(name for role, name in spoken if role in ("button", "image", "heading"))
    assert ("image", "heading 217.250°") in spoken and ("image", "tilt 12.00 and -6.00 degrees") in spoken
    assert any(role == "status" for role, _ in spoken)
    regions = {name.upper() for role, name in spoken if role == "region"}
    assert {"MAP", "TIME", "TILT", "FRAME", "LINKS"} <= regions
