# SPDX-License-Identifier: Apache-2.0
"""The page as a person sees it: in a real browser, of a real node, from real messages."""

import json
import math
import shutil
import signal
from importlib.util import find_spec

import dashboard as said
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, Imu, NavSatFix

from starpos_common.testing import Listener, Process, lacks, take_domain
from starpos_interfaces.msg import ErrorTerm, Solution, Tilt

OK, WARN, ERROR = 0, 1, 2
STALE_AFTER_S = 2.0
HOSTILE = "<img src=x onerror=\"document.title='broken'\"><script>document.title='broken'</script>"
CHROMIUM = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1440,1200",
]
TOPICS = {
    "fix": NavSatFix,
    "fix_averaged": NavSatFix,
    "heading/imu": Imu,
    "tilt": Tilt,
    "solver/solution": Solution,
    "/diagnostics": DiagnosticArray,
    "detector/image_annotated": Image,
}
LIGHTS = said.diagnostics(
    ("camera: Clock", OK, "the system's clock is kept to UTC within 0.0021 s"),
    ("solver: Clock", WARN, "the time is known to 0.12 s only"),
    ("solver: Inputs", ERROR, HOSTILE),
    ("wheels: Motor", ERROR, "not this instrument's"),
)
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


class Instrument:
    """The nodes the dashboard listens to: what each says, again and again."""

    def __init__(self, listener):
        self.listener = listener
        self.publishers = {
            name: listener.node.create_publisher(kind, name, 10) for name, kind in TOPICS.items()
        }
        self.says = {}

    def works(self, **changes):
        """Everything good, but for the changes; topics with _ for /."""
        self.says = {
            "fix": said.fix(),
            "fix_averaged": said.fix(48.1382, 11.5755, (80.0**2, 0.0, 60.0**2)),
            "heading/imu": said.imu(217.25, 0.004),
            "tilt": said.tilt(12.0, -6.0),
            "solver/solution": said.solution(),
            "/diagnostics": LIGHTS,
            "detector/image_annotated": said.image(),
        } | {k.replace("__", "/"): v for k, v in changes.items()}

    def speak(self):
        """Once, under a stamp of now."""
        now = self.listener.node.get_clock().now().to_msg()
        for name, message in self.says.items():
            if message is not None:
                message.header.stamp = now
                self.publishers[name].publish(message)


class Page:
    """The open page and the instrument it shows."""

    def __init__(self, driver, instrument, url):
        self.driver, self.instrument, self.url = driver, instrument, url

    def run(self, script: str, *arguments):
        return self.driver.execute_script(script, *arguments)

    def text(self, name: str) -> str:
        return self.run("return document.getElementById(arguments[0]).innerText", name)

    def click(self, name: str):
        self.driver.find_element("id", name).click()

    def until(self, condition):
        """What the condition gives, once it is true; the instrument goes on meanwhile."""
        result = []

        def come():
            self.instrument.speak()
            result[:] = [condition()]
            return result[0]

        self.instrument.listener.wait(come)
        return result[0]

    def shows(self, **texts):
        """Until elements show these texts."""
        seen = {}

        def come():
            seen.update({name: self.text(name.replace("_", "-")).strip() for name in texts})
            return seen == texts

        try:
            self.until(come)
        except AssertionError:
            assert seen == texts  # says which
            raise

    def is_dressed(self, kind: str) -> list[str]:
        return self.run(
            "return [...document.querySelectorAll('section.' + arguments[0])].map((e) => e.id)", kind
        )


@pytest.fixture(scope="module")
def listener():
    take_domain()
    listener = Listener()
    yield listener
    listener.close()


@pytest.fixture(scope="module")
def node(listener):
    """The dashboard as a process; its address."""
    if find_spec("tornado") is None:
        lacks("tornado", "pip install")
    parameters = (
        "port:=0",
        f"stale_after:={STALE_AFTER_S}",
        "rate:=20.0",
        "image_rate:=5.0",
        "image_side:=800",
    )
    process = Process("starpos_solver.dashboard.main", "dashboard", parameters)
    listener.wait_for_state("dashboard: Page", OK)
    yield listener.states["dashboard: Page"].message.split()[-1]
    status, output = process.end(signal.SIGINT, signal.SIGINT)
    assert status == 0 and "Traceback" not in output, output


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    if find_spec("selenium") is None:
        lacks("selenium", "pip install")
    for program, package in (("chromium", "chromium"), ("chromedriver", "chromium-driver")):
        if not shutil.which(program):
            lacks(package)
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for argument in (*CHROMIUM, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    yield driver
    driver.quit()


@pytest.fixture
def page(driver, node, listener):
    """A fresh page of a working instrument; at the end: nothing came from elsewhere, and no error in its console."""
    page = Page(driver, Instrument(listener), node)
    page.instrument.works()
    driver.get_log("performance"), driver.get_log("browser")
    driver.get(node)
    page.run("localStorage.clear()")
    driver.get(node)
    page.shows(status_word="Fix")
    yield page
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    assert asked and all(url.startswith(node + "/") for url in asked), asked
    assert [e for e in driver.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
    assert driver.title == "starpos"
    driver.get("about:blank")
    for publisher in page.instrument.publishers.values():
        listener.node.destroy_publisher(publisher)


def test_the_numbers_are_those_of_the_messages(page):
    page.shows(
        latitude="48°08′14″ N",
        longitude="11°34′32″ E",
        sigma_east="± 300 m",
        sigma_north="± 100 m",
        altitude="—",
        heading="217.250°",
        heading_sigma="± 14.4″",
        heading_frame="of starpos_link",
        theta_x="12.000° ± 12.6″",
        theta_y="−6.000° ± 12.6″",
        tilt_warmth="11.3 °C",
        stars="21 of 41",
        residual="0.83″",
        status_sentence="± 300 m east, ± 100 m north, 21 stars",
        average="48°08′17.5″ N  11°34′32″ E",
        average_sigma="± 80.0 m east, ± 60.0 m north",
    )
    assert page.text("fix-age") in ("0 s", "1 s")
    page.until(lambda: page.is_dressed("old") == page.is_dressed("missing") == [])


def test_south_and_west_and_a_better_fix_have_their_letters_and_digits(page):
    page.instrument.works(fix=said.fix(-0.5, -179.99999, (0.5**2, 0.0, 0.5**2)))
    page.shows(latitude="0°30′00.000″ S", longitude="179°59′59.964″ W", sigma_east="± 50.0 cm")


def test_the_needle_points_where_the_heading_is(page):
    tip = """
      const g = document.querySelector("#needle"), m = g.getScreenCTM();
      const at = (x, y) => new DOMPoint(x, y).matrixTransform(m);
      const [a, b] = [at(0, 0), at(0, -88)];
      return (Math.atan2(b.x - a.x, a.y - b.y) * 180 / Math.PI + 360) % 360;
    """
    for azimuth in (217.25, 0.0, 90.0):
        page.instrument.works(heading__imu=said.imu(azimuth))
        page.until(lambda a=azimuth: abs(math.remainder(page.run(tip) - a, 360.0)) < 0.01)


ELLIPSES = """
  const box = (q) => { const r = document.querySelector(q).getBBox(); return [r.x, r.y, r.width, r.height]; };
  const path = document.querySelector("#ellipse-newest .inner"), n = path.getTotalLength();
  const points = [...Array(721).keys()].map((i) => path.getPointAtLength((n * i) / 720));
  const [top, height] = [Math.min(...points.map((p) => p.y)), path.getBBox().height];
  const cap = points.filter((p) => p.y < top + 0.04 * height).map((p) => p.x);
  return {
    newest: box("#ellipse-newest .inner"), outer: box("#ellipse-newest .outer"), average: box("#ellipse-average .inner"),
    cap: (Math.min(...cap) + Math.max(...cap)) / 2,
    bar: document.getElementById("scale-bar").getBoundingClientRect().width,
    scale: document.getElementById("scale-text").innerText,
  };
"""


def metres_per_px(seen) -> float:
    number, unit = seen["scale"].split()
    return float(number) * {"cm": 0.01, "m": 1.0, "km": 1000.0}[unit] / seen["bar"]


def middle(box) -> tuple[float, float]:
    return box[0] + box[2] / 2, box[1] + box[3] / 2


def test_the_ellipses_have_their_size_place_and_lean_at_the_scale_of_the_map(page):
    page.until(lambda: page.run(ELLIPSES)["newest"][2] > 10)
    for _ in range(3):
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
    assert page.run(land) == 0
    page.click("zoom-earth")
    page.until(lambda: page.run(land) > 5000)
    sphere = page.run("return document.querySelector('#map-view .sphere').getBBox().width")
    assert metres_per_px(page.run(ELLIPSES)) * sphere == pytest.approx(2 * 6371008.8, rel=0.01)


def test_the_track_has_a_dot_for_every_fix_before(page):
    for k in range(4):
        page.instrument.works(fix=said.fix(48.1373 + 1e-4 * k))
        page.shows(decimal=f"{48.1373 + 1e-4 * k:.4f}° 11.575°")
    dots = page.run("return document.querySelector('.dots').getAttribute('d')")
    assert len(set(dots.split("M")[1:])) >= 3 and "NaN" not in dots


def test_the_bubble_is_at_its_place_and_red_beyond_the_limit(page):
    place = """
      const c = (id) => { const r = document.getElementById(id).getBoundingClientRect();
        return [r.x + r.width / 2, r.y + r.height / 2, r.width]; };
      const [x, y] = c("bubble-dot"), [rx, ry, width] = c("bubble-rim");
      return [(x - rx) / (width / 2) * 30, (ry - y) / (width / 2) * 30];
    """
    page.until(lambda: page.run(place) == pytest.approx([12.0, -6.0], abs=0.6))
    page.instrument.works(tilt=said.tilt(40.0, 0.0, flags=Tilt.OUT_OF_RANGE))
    page.until(lambda: page.run(place) == pytest.approx([30.0, 0.0], abs=0.6))
    page.shows(tilt_flags="beyond ±30°")
    assert page.run("return document.querySelector('#bubble-dot.out') !== null")


LAMPS = """
  return [...document.querySelectorAll("#lights li")].map((li) => [
    ...["name", "level", "sentence"].map((part) => li.querySelector("." + part).textContent),
    getComputedStyle(li.querySelector(".lamp")).getPropertyValue("--lamp"),
    getComputedStyle(li.querySelector(".level")).color]);
"""


def test_lights_have_their_colours_words_and_sentences_and_hostile_text_stays_text(page):
    lamps = [lamp for lamp in page.until(lambda: page.run(LAMPS)) if ":" in lamp[0]]
    assert [lamp[:3] for lamp in lamps] == [
        ["camera: Clock", "OK", "the system's clock is kept to UTC within 0.0021 s"],
        ["solver: Clock", "WARN", "the time is known to 0.12 s only"],
        ["solver: Inputs", "ERROR", HOSTILE],
    ]
    green, amber, red = ([int(v) for v in lamp[4][4:-1].split(",")] for lamp in lamps)
    assert green[1] > green[0] + 80 and red[0] > red[1] + 80
    assert amber[0] > 200 and amber[1] > amber[2] + 80
    clocks = page.run("return [...document.querySelectorAll('#clocks .name')].map((e) => e.textContent)")
    assert clocks == ["camera: Clock", "solver: Clock"]
    assert page.run("return document.images.length") == 2  # the icon and the frame
    assert page.run("return document.querySelectorAll('#lights img, #lights script').length") == 0


def test_a_node_that_has_never_spoken_is_silent_not_missing(page):
    def silent():
        return [lamp[0] for lamp in page.run(LAMPS) if lamp[1] == "SILENT" and "nothing heard" in lamp[2]]

    page.until(lambda: silent() == ["detector", "inclinometer"])


def test_the_budget_is_bars_the_longest_the_largest(page):
    bars = page.run(
        "return [...document.querySelectorAll('#budget li')].map((li) => [li.className, "
        "li.querySelector('.bar i').getBoundingClientRect().width / li.querySelector('.bar').clientWidth, li.innerText])"
    )
    assert [b[0] for b in bars] == ["common", "random"]
    assert bars[0][1] == pytest.approx(1.0, abs=0.01) and bars[1][1] == pytest.approx(5 / 200, abs=0.01)
    assert bars[0][2].split("\n") == ["deflection", "200 m", "7.20″"]


def test_what_is_too_small_to_see_is_summed_up(page):
    message = said.solution()
    message.budget += [ErrorTerm(name=f"t{k}", east=0.3, north=0.4, heading=0.001) for k in range(4)]
    page.instrument.works(solver__solution=message)
    last = "return document.querySelector('#budget li:last-child').innerText.split('\\n')"
    page.until(lambda: page.run(last) == ["4 smaller ones", "1.00 m", "7.20″"])


def test_the_frame_is_shown_and_drawn_only_while_a_page_looks(page, listener):
    image = "const i = document.images.frame; return [i.checkVisibility(), i.naturalWidth, i.naturalHeight, i.alt]"
    page.until(lambda: page.run(image)[:3] == [True, 800, 500])
    assert page.run(image)[3].startswith("annotated frame of ")
    colours = (
        "const canvas = document.createElement('canvas'); [canvas.width, canvas.height] = [800, 500];"
        "const c = canvas.getContext('2d', {willReadFrequently: true});"
        "c.drawImage(document.getElementById('frame'), 0, 0);"
        "return [100, 700].map((x) => [...c.getImageData(x, 250, 1, 1).data].slice(0, 3).map((v) => v > 120))"
    )
    blue, green = [False, False, True], [False, True, False]
    assert page.run(colours) == [blue, green]
    page.instrument.works(detector__image_annotated=said.image(left=(0, 200, 0), right=(200, 0, 0)))
    page.until(lambda: page.run(colours) == [green, blue])
    viewers = page.instrument.publishers["detector/image_annotated"].get_subscription_count
    assert viewers() == 1
    page.click("frame-switch")
    page.until(lambda: viewers() == 0 and not page.run(image)[0])
    page.click("frame-switch")
    page.until(lambda: viewers() == 1 and page.run(image)[0])


def test_a_frame_that_cannot_be_shown_says_why(page):
    page.instrument.works(detector__image_annotated=said.image(encoding="rgb16"))
    page.until(lambda: "encoding" in page.text("frame-note"))
    assert not page.run("return document.getElementById('frame').checkVisibility()")


def test_no_fix_looks_like_no_fix_and_nan_is_no_number(page):
    nan = math.nan
    sentence = "none of the sky fits these 41 stars: look at the frame"
    page.instrument.works(
        fix=said.fix(nan),
        fix_averaged=None,
        heading__imu=None,
        tilt=said.tilt(nan, nan, nan),
        solver__solution=said.solution(Solution.NOT_IDENTIFIED, sentence),
    )
    page.shows(status_word="No fix", status_sentence=sentence, latitude="—", longitude="—", sigma_east="—",
               theta_x="—", residual="—", position_age="no fix", budget_age="none")  # fmt: skip
    assert page.text("decimal").startswith("last fix 48.1373° 11.575°, ")
    page.until(lambda: page.is_dressed("missing") == ["position-card", "tilt-card", "budget-card"])
    page.until(lambda: "heading-card" in page.is_dressed("old"))
    assert page.run("return document.querySelector('.old > #ellipse-newest') !== null")
    assert page.run("return document.querySelector('#bubble-dot').checkVisibility()") is False
    everything = page.run("return document.documentElement.outerHTML")
    assert "NaN" not in everything and "undefined" not in everything and "null" not in everything.lower()


def test_a_fix_without_a_known_error_has_no_ellipse(page):
    page.instrument.works(fix=said.fix(48.1373, 11.5755, (nan := math.nan, nan, nan)))
    page.shows(sigma_east="± —", status_sentence="how far it may be off is not known")
    drawn = [
        page.run(f"return document.querySelector('#ellipse-newest .{q}').getAttribute('d')")
        for q in ("inner", "outer")
    ]
    assert drawn == ["", ""] and page.run(
        "return document.querySelector('#ellipse-newest .mark').checkVisibility()"
    )


def test_an_old_stamp_is_an_old_fix(page, listener):
    page.instrument.works()
    fix = page.instrument.says.pop("fix")
    fix.header.stamp.sec = int(listener.node.get_clock().now().nanoseconds * 1e-9) - 7200

    def spoken():
        page.instrument.publishers["fix"].publish(fix)
        return page.text("status-word") == "Old fix"

    page.until(spoken)
    assert "2 h 00 min ago" in page.text("status-sentence")
    assert "position-card" in page.is_dressed("old")


def test_everything_grows_old_when_the_instrument_falls_silent_and_lives_again(page):
    page.until(lambda: page.is_dressed("missing") == [])
    speaks, page.instrument.says = page.instrument.says, {}
    cards = {"position-card", "time-card", "heading-card", "tilt-card", "frame-card", "budget-card"}
    page.until(lambda: set(page.is_dressed("old")) == cards)
    page.until(lambda: page.text("status-word") == "No fix now")

    def tops():
        return page.run("""return [...document.querySelectorAll("#clocks li")].flatMap((li) =>
          [".name", ".sentence"].map((part) => li.querySelector(part).getBoundingClientRect().top))""")

    page.until(
        lambda: len(tops()) == 4 and min(tops()) > 0
    )  # each is old and has its sentence, which else is not shown
    assert tops() == sorted(tops()), "each clock's sentence stands under its name"
    lamps = page.until(lambda: all(lamp[1] == "SILENT" for lamp in page.run(LAMPS)) and page.run(LAMPS))
    for *_, colour in lamps:
        r, g, b = (int(v) for v in colour[4:-1].split(","))
        assert max(r, g, b) - min(r, g, b) < 50, "a silent light is grey"
    assert page.text("average") == "—" and page.text("stars") == "—"
    assert page.text("heading") == "217.250°" and page.text("heading-age").endswith(" old")
    page.instrument.says = speaks
    page.shows(status_word="Fix", heading_age="", tilt_age="")
    page.until(lambda: page.is_dressed("old") == [])


@pytest.mark.parametrize("width", [360, 820, 1440])
@pytest.mark.parametrize("speaks", [True, False])
def test_no_text_lies_over_another(page, width, speaks):
    metrics = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        page.until(lambda: page.is_dressed("missing") == [] and page.run(LAMPS))
        if not speaks:
            page.instrument.says = {}
            page.until(
                lambda: (
                    all(lamp[1] == "SILENT" for lamp in page.run(LAMPS)) and len(page.is_dressed("old")) == 6
                )
            )
        assert page.run(OVERLAPS) == []
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_page_one_too_many_says_so(page, listener):
    assert listener.set("dashboard", clients=1).successful
    first = page.driver.current_window_handle
    page.driver.switch_to.new_window("tab")
    second = page.driver.current_window_handle

    def refused():  # whichever came last: a page whose connection broke on a busy machine comes again
        for window in (second, first):
            page.driver.switch_to.window(window)
            if page.text("status-word") == "No place":
                return True
        return False

    try:
        page.driver.get(page.url)
        page.until(refused)
    finally:
        page.driver.switch_to.window(second)
        page.driver.close()
        page.driver.switch_to.window(first)
        assert listener.set("dashboard", clients=8).successful


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
    metrics = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        page.until(lambda: page.run("return innerWidth") == 360)
        assert page.run("return document.documentElement.scrollWidth") == 360
        wide = page.run(
            "return [...document.querySelectorAll('main *')].filter((e) => e.getBoundingClientRect().right > 361"
            " && !e.closest('svg')).map((e) => e.id || e.className)"
        )
        assert wide == []
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


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
