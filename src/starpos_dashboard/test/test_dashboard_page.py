# SPDX-License-Identifier: Apache-2.0
"""The page as a person sees it: in a real browser, of a real node, from real messages."""

import math
import re

import pytest
import said
from browser import HOSTILE, LAMPS

from starpos_interfaces.msg import ErrorTerm, GnssCheck, Solution, Tilt


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
    assert re.fullmatch("[0-9] s", page.text("fix-age"))
    page.until(lambda: page.is_dressed("old") == page.is_dressed("missing") == [])


def test_south_and_west_and_a_better_fix_have_their_letters_and_digits(page):
    page.instrument.works(fix=said.fix(-0.5, -179.99999, (0.5**2, 0.0, 0.5**2)))
    page.shows(latitude="0°30′00.000″ S", longitude="179°59′59.964″ W", sigma_east="± 50.0 cm")


def test_both_places_are_shown_and_what_the_guard_says_of_gnss(page):
    hidden = "return document.getElementById('gnss').hidden"
    assert page.run(hidden)
    page.instrument.works(gnss__check=said.gnss())
    page.shows(
        gnss_word="disagrees",
        gnss_place="48.15530° 11.57550°",
        gnss_sentence="GNSS is 2 km north of where the stars put us (120 m): it is not believed",
    )
    places = """
      const rect = (q) => document.querySelector(q).getBoundingClientRect();
      const mid = (r) => [r.x + r.width / 2, r.y + r.height / 2];
      const status = document.querySelector("#map-gnss").dataset.status;
      return [...mid(rect("#map-gnss")), ...mid(rect("#ellipse-newest .mark")), rect("#map").y, status];
    """

    def north_of_the_fix_on_the_map():
        x, y, fix_x, fix_y, top, status = page.run(places)
        return abs(x - fix_x) < 1.5 and top < y < fix_y - 50 and status == "disagrees"

    # the map is drawn after the words
    page.until(north_of_the_fix_on_the_map)
    page.instrument.works(gnss__check=said.gnss(GnssCheck.AGREES, 48.1374))
    page.shows(gnss_word="agrees")


def test_the_place_is_copied_and_opens_in_a_map(page):
    page.instrument.works(fix=said.fix(-33.92487, 18.42406), fix_averaged=None)
    link = "return document.getElementById('geo').getAttribute('href')"
    page.until(lambda: page.run(link) == "geo:-33.924870,18.424060")
    page.run(
        "window.addEventListener('copy', (e) => (window.copied = e.clipboardData.getData('text/plain')))"
    )
    page.click("copy")
    assert page.text("copy") == "Copied"
    assert page.run("return window.copied") == "-33.924870, 18.424060"
    page.shows(copy="Copy")
    page.instrument.works(fix=said.fix(math.nan), fix_averaged=None)
    page.until(lambda: not page.run("return document.getElementById('place-tools').checkVisibility()"))


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


def test_the_bubble_is_at_its_place_and_red_where_a_flag_is_set(page):
    place = """
      const c = (id) => { const r = document.getElementById(id).getBoundingClientRect();
        return [r.x + r.width / 2, r.y + r.height / 2, r.width]; };
      const [x, y] = c("bubble-dot"), [rx, ry, width] = c("bubble-rim");
      return [(x - rx) / (width / 2) * 30, (ry - y) / (width / 2) * 30];
    """
    page.until(lambda: page.run(place) == pytest.approx([12.0, -6.0], abs=0.6))
    page.instrument.works(tilt=said.tilt(40.0, 0.0, flags=Tilt.OUT_OF_RANGE))
    # The rim is at 90 deg now.
    page.until(lambda: page.run(place) == pytest.approx([40.0 / 3, 0.0], abs=0.6))
    assert "90°" in page.run("return document.querySelector('#bubble').textContent")
    page.shows(tilt_flags="beyond the sensor's range")
    assert page.run("return document.querySelector('#bubble-dot.out') !== null")


def test_what_is_suspicious_about_an_identification_is_named(page):
    page.shows(warnings="")
    page.instrument.works(
        solver__solution=said.solution(
            Solution.POOR_FIT, "two skies in one frame", ["two_skies", "unexplained"]
        )
    )
    page.shows(warnings="identification: two_skies, unexplained")


def test_lights_have_their_colours_words_and_sentences_and_hostile_text_stays_text(page):
    def spoken():
        seen = [lamp for lamp in page.run(LAMPS) if ":" in lamp[0]]
        return seen if seen and all(lamp[1] != "SILENT" for lamp in seen) else None

    lamps = page.until(spoken)
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
    # The icon and the frame.
    assert page.run("return document.images.length") == 2
    assert page.run("return document.querySelectorAll('#lights img, #lights script').length") == 0


def test_the_card_of_the_deflection_is_there_while_one_is_measured(page):
    seen = "return document.getElementById('deflection-card').checkVisibility()"
    assert not page.run(seen)
    sentence = "enough; xi +3.120 +- 0.070, eta -1.020 +- 0.080 arcsec, 8 faces, 192 frames"
    page.instrument.works(__diagnostics=said.diagnostics(("solver: Deflection", 0, sentence)))
    page.until(lambda: page.run(seen) and sentence in page.text("deflection"))


def test_a_node_that_has_never_spoken_is_silent_not_missing(page):
    def silent():
        lamps = [lamp for lamp in page.run(LAMPS) if lamp[1] == "SILENT" and "nothing heard" in lamp[2]]
        # A diagnostic that another test sent has grown old on a busy machine.
        return [name for name, *_ in lamps if ":" not in name]

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
    # The next frame may be loading.
    page.until(lambda: page.run(colours) == [blue, green])
    page.instrument.works(detector__image_annotated=said.image(left=(0, 200, 0), right=(200, 0, 0)))
    page.until(lambda: page.run(colours) == [green, blue])
    viewers = page.instrument.publishers["detector/image_annotated"].get_subscription_count
    assert viewers() == 1
    covered = (
        "Object.defineProperty(document, 'hidden', {value: arguments[0], configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    page.run(covered, True)
    page.until(lambda: viewers() == 0)
    page.run(covered, False)
    page.until(lambda: viewers() == 1 and page.run(image)[0])


def test_a_frame_that_cannot_be_shown_says_why(page):
    page.instrument.works(detector__image_annotated=said.image(encoding="rgb16"))
    page.until(lambda: "encoding" in page.text("frame-note"))
    assert not page.run("return document.getElementById('frame').checkVisibility()")


def test_no_fix_looks_like_no_fix_and_nan_is_no_number(page):
    nan = math.nan
    sentence = "no part of the sky matches these 41 stars: look at the frame"
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
    page.until(lambda: page.is_dressed("missing") == ["position-card", "budget-card", "tilt-card"])
    page.until(lambda: "heading-card" in page.is_dressed("old"))
    assert page.run("return document.querySelector('.old > #ellipse-newest') !== null")
    assert page.run("return document.querySelector('#bubble-dot').checkVisibility()") is False
    everything = page.run("return document.documentElement.outerHTML")
    assert "NaN" not in everything and "undefined" not in everything and "null" not in everything.lower()


def test_why_there_is_no_fix_is_never_another_instruments_reason(page, listener):
    own, other = "waiting for the first frame", "the other one is under clouds"
    lights = (("/b/solver: Solution", 1, other), ("solver: Solution", 1, own))
    page.instrument.works(
        fix=said.fix(math.nan), solver__solution=None, **{"/diagnostics": said.diagnostics(*lights)}
    )
    assert listener.set("dashboard", lights="").successful
    try:
        page.shows(status_word="No fix", status_sentence=own)
        page.instrument.says["/diagnostics"] = said.diagnostics(lights[0])
        page.shows(status_word="No fix", status_sentence="no fix")
        page.until(lambda: other in [lamp[2] for lamp in page.run(LAMPS)])
    finally:
        assert listener.set("dashboard", lights="camera, detector, inclinometer, solver").successful


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

    # Each is old and has its sentence, which else is not shown, under its name; the page may still be laying them out.
    page.until(lambda: len(found := tops()) == 4 and found[0] > 0 and found == sorted(found))
    lamps = page.until(lambda: all(lamp[1] == "SILENT" for lamp in page.run(LAMPS)) and page.run(LAMPS))
    for *_, colour in lamps:
        r, g, b = (int(v) for v in colour[4:-1].split(","))
        assert max(r, g, b) - min(r, g, b) < 50, "a silent light is grey"
    page.shows(average="—", stars="—", heading="217.250°")
    page.until(lambda: page.text("heading-age").endswith(" old"))
    page.instrument.says = speaks
    page.shows(status_word="Fix", heading_age="", tilt_age="")
    page.until(lambda: page.is_dressed("old") == [])


def test_a_page_one_too_many_says_so(page, listener):
    assert listener.set("dashboard", clients=1).successful
    first = page.driver.current_window_handle
    page.driver.switch_to.new_window("tab")
    second = page.driver.current_window_handle

    # Whichever came last: a page whose connection broke on a busy machine comes again.
    def refused():
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


def test_the_sun_is_on_the_compass_where_it_stands_and_will_be(page):
    def drawn():
        return page.run(
            "return ['.sun-way.past', '.sun-way.coming'].map((q) => document.querySelector(q).getAttribute('d').length)"
        )

    page.until(lambda: min(drawn()) > 20 or max(drawn()) > 200)
