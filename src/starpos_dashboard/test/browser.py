# SPDX-License-Identifier: Apache-2.0
"""The dashboard's page in a browser, and the instrument that it shows: for the tests that look at it."""

import said
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image, Imu, NavSatFix

from starpos_interfaces.msg import GnssCheck, Solution, Tilt

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
    "gnss/check": GnssCheck,
    "/diagnostics": DiagnosticArray,
    "detector/image_annotated": Image,
}
LIGHTS = said.diagnostics(
    ("camera: Clock", OK, "the system's clock is kept to UTC within 0.0021 s"),
    ("solver: Clock", WARN, "the time is known to 0.12 s only"),
    ("solver: Inputs", ERROR, HOSTILE),
    ("wheels: Motor", ERROR, "not this instrument's"),
)
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
LAMPS = """
  return [...document.querySelectorAll("#lights li")].map((li) => [
    ...["name", "level", "sentence"].map((part) => li.querySelector("." + part).textContent),
    getComputedStyle(li.querySelector(".lamp")).getPropertyValue("--lamp"),
    getComputedStyle(li.querySelector(".level")).color]);
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
        """Wait until elements show these texts."""
        seen = {}

        def come():
            seen.update({name: self.text(name.replace("_", "-")).strip() for name in texts})
            return seen == texts

        try:
            self.until(come)
        except AssertionError:
            # It says which.
            assert seen == texts
            raise

    def is_dressed(self, kind: str) -> list[str]:
        return self.run(
            "return [...document.querySelectorAll('section.' + arguments[0])].map((e) => e.id)", kind
        )


def metres_per_px(seen) -> float:
    number, unit = seen["scale"].split()
    return float(number) * {"cm": 0.01, "m": 1.0, "km": 1000.0}[unit] / seen["bar"]
