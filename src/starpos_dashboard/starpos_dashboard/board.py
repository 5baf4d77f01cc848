# SPDX-License-Identifier: Apache-2.0
"""The newest message of each kind as JSON for the page, in the units that people read, and when it came.

A number that is not finite becomes null. A text is shortened and loses characters that could rearrange the text of the
page. An inconsistent message is shown as trouble, never as a value.
"""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.errors import StarposError
from starpos.messages.stamp import stamp_to_unix
from starpos.session.reports import SITE_LATITUDE, SITE_LONGITUDE
from starpos.sky.bodies import SUN, body_at
from starpos_interfaces.msg import GnssCheck, Solution, Tilt

# Maximum length of a text from outside.
NAME_LETTERS, SENTENCE_LETTERS = 80, 300
# Maximum number of terms of an error budget, and of warnings of an identification.
TERMS, WARNINGS = 16, 4
# Levels of DiagnosticStatus.
STALE, ERROR = 3, 2
# Tolerance on the length of a quaternion.
UNIT = 1e-3
TILT_FLAGS = (
    (Tilt.OUT_OF_RANGE, "beyond the sensor's range"),
    (Tilt.STUCK, "the sensor repeats one value"),
    (Tilt.SATURATED, "the converter is at its limit"),
    (Tilt.GAP, "readings were lost"),
    (Tilt.TIME_UNKNOWN, "its time is unknown"),
)

GNSS_WORDS = {
    GnssCheck.LEARNING: "learning",
    GnssCheck.AGREES: "agrees",
    GnssCheck.DOUBTFUL: "doubtful",
    GnssCheck.DISAGREES: "disagrees",
}


def number(value: float) -> float | None:
    """Return a number, None if it is not finite: JSON cannot hold it, and it must not be read as a number."""
    value = float(value)
    return value if math.isfinite(value) else None


def text(value: str, letters: int = SENTENCE_LETTERS) -> str:
    """Shorten a text to one line, without control characters and marks that change the reading direction."""
    line = "".join(c if c.isprintable() else " " for c in value[: 2 * letters])
    line = " ".join(line.split())
    return line if len(line) <= letters else line[: letters - 1] + "…"


def place_of(latitude: float, longitude: float) -> tuple[float, float] | None:
    """Latitude and longitude [deg]; None if there is no such place on Earth."""
    return (latitude, longitude) if abs(latitude) <= 90 and abs(longitude) <= 360 else None


def position(message: NavSatFix) -> dict:
    """Place [deg], altitude [m], covariance of (east, north) [m2] as [ee, en, nn]; good: False if it is no fix."""
    told: dict[str, Any] = {"good": False, "trouble": "", "stamp": stamp_to_unix(message.header.stamp)}
    place = place_of(message.latitude, message.longitude)
    if message.status.status == NavSatStatus.STATUS_NO_FIX:
        return told | {"trouble": "no fix"}
    if place is None:
        return told | {"trouble": "the position is not on Earth: it is not shown"}
    covariance = _covariance(message)
    return told | {
        "good": True,
        "trouble": "" if covariance else "its error is not known",
        "latitude": place[0],
        "longitude": math.remainder(place[1], 360.0),
        "altitude": number(message.altitude),
        "covariance": covariance,
    }


def _covariance(message: NavSatFix) -> list[float] | None:
    if message.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN:
        return None
    ee, en, _, ne, nn = (float(v) for v in message.position_covariance[:5])
    sound = all(map(math.isfinite, (ee, en, ne, nn))) and ee > 0 and nn > 0 and ee * nn >= en * en
    return [ee, (en + ne) / 2, nn] if sound else None


def heading(message: Imu) -> dict | None:
    """Azimuth of the frame's x axis, clockwise from north, and its sigma [deg]; None if there is no attitude."""
    q = message.orientation
    x, y, z, w = q.x, q.y, q.z, q.w
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if message.orientation_covariance[0] == -1 or not abs(length - 1) < UNIT:
        return None
    east, north = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z)
    variance = float(message.orientation_covariance[8])
    return {
        "azimuth": math.degrees(math.atan2(east, north)) % 360.0,
        "sigma": math.degrees(math.sqrt(variance)) if 0 < variance < math.inf else None,
        "frame": text(message.header.frame_id, NAME_LETTERS),
        "stamp": stamp_to_unix(message.header.stamp),
    }


def tilt(message: Tilt) -> dict:
    """Elevations of the inclinometer's axes and their sigmas [deg], temperature [deg C], the flags in words."""
    xx, _, _, yy = (float(v) for v in message.covariance)
    sigma_x, sigma_y = (math.degrees(math.sqrt(v)) if 0 < v < math.inf else None for v in (xx, yy))
    return {
        "x": number(math.degrees(message.x)),
        "y": number(math.degrees(message.y)),
        "sigma_x": sigma_x,
        "sigma_y": sigma_y,
        "temperature": number(message.temperature),
        "flags": [said for flag, said in TILT_FLAGS if message.flags & flag],
    }


def gnss(message: GnssCheck) -> dict | None:
    """Place [deg] of GNSS, and its comparison with the stars; None for an unknown status."""
    if message.status not in GNSS_WORDS:
        return None
    latitude, longitude = place_of(message.latitude, message.longitude) or (None, None)
    return {
        "status": GNSS_WORDS[message.status],
        "sentence": text(message.status_text),
        "latitude": latitude,
        "longitude": longitude,
        "stamp": stamp_to_unix(message.header.stamp),
    }


def solution(message: Solution) -> dict:
    """Result of the newest frame in words and counts, and the error budget (1 sigma: position [m], heading [deg])."""
    terms = [
        {
            "name": text(term.name, NAME_LETTERS),
            "position": number(np.hypot(term.east, term.north)),
            "heading": number(term.heading),
            "common": bool(term.common),
        }
        for term in message.budget[:TERMS]
    ]
    return {
        "good": message.status == Solution.OK,
        "sentence": text(message.status_text),
        "stars_detected": int(message.stars_detected),
        "stars_matched": int(message.stars_matched),
        "residual": number(message.residual),
        "warnings": [text(w, NAME_LETTERS) for w in message.warnings[:WARNINGS]],
        "budget": terms,
        "stamp": stamp_to_unix(message.header.stamp),
    }


def seen_from(namespace: str, name: str) -> str:
    """Name of a diagnostic seen from a namespace: `solver: Solution` inside it, else whole: `/b/solver: Solution`."""
    whole = name if name.startswith("/") else f"/{name}"
    return whole.removeprefix(namespace.rstrip("/") + "/")


def light(status: DiagnosticStatus, name: str) -> dict:
    """Convert a diagnostic to a light; a level other than the four is an error."""
    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    return {
        "name": text(name, NAME_LETTERS),
        "level": level if 0 <= level <= STALE else ERROR,
        "sentence": text(status.message),
    }


# Seconds before and after now for which the Sun's way is shown, and its interval.
SUN_WAY_S, SUN_STEP_S = 12 * 3600, 1200


@lru_cache(maxsize=1)
def sun_way(latitude_deg: float, longitude_deg: float, unix_s: float) -> list[list[float]] | None:
    """Azimuth and altitude [deg] of the Sun from half a day before a time to half a day after; None without tables."""
    place = Place.on_ellipsoid(latitude_deg, longitude_deg)
    way = []
    try:
        for at_s in np.arange(unix_s - SUN_WAY_S, unix_s + SUN_WAY_S + 1, SUN_STEP_S).tolist():
            east, north, up = place.plumb_axes @ body_at(SUN, earth_state(at_s)).from_place(
                place.plumb_axes[2]
            )
            way.append([math.degrees(math.atan2(east, north)) % 360, math.degrees(math.asin(up))])
    except StarposError:
        return None
    return way


# Age at which messages of 1 Hz or faster are old.
FAST_S = 5.0
# Diagnostics kept.
LIGHTS = 64
# Fixes kept, the most that the parameter `track` can ask for.
MAX_TRACK = 10_000
# Looked at in one message.
STATUSES = 256


class Board:
    """Takes messages and gives one JSON text, of bounded size. `changed`: a message came since the last `as_json`.

    values: the node's parameters as they are at any time.
    """

    def __init__(
        self, values: Mapping[str, Any], clock: Callable[[], float] = time.monotonic, namespace: str = "/"
    ) -> None:
        self.changed = False
        self._values, self._namespace = values, namespace
        self._clock, self._since = clock, clock()
        # the nodes that have lights, since then
        self._lit = self._nodes
        # By topic: when it was heard, and what it said.
        self._heard: dict[str, tuple[float, dict[str, Any]]] = {}
        self._lights: dict[str, tuple[float, dict[str, Any]]] = {}
        self._track: deque[tuple[int, float, float]] = deque(maxlen=MAX_TRACK)
        self._count = 0
        # a known place by the solver's diagnostics, deg
        self._site: tuple[float, float] | None = None

    @property
    def track(self) -> tuple[tuple[int, float, float], ...]:
        """(number, latitude, longitude) [deg] of the newest fixes, counted from 1."""
        return tuple(self._track)[-self._values["track"] :]

    @property
    def _nodes(self) -> frozenset[str]:
        """The nodes whose diagnostics are shown as lights, by their names in the namespace, or whole ones; empty: all."""
        wanted = names(self._values["lights"])
        return frozenset(seen_from(self._namespace, n) if n[0] == "/" else n for n in wanted)

    def hear_fix(self, message: NavSatFix) -> None:
        told = position(message)
        self.show("fix", told)
        if told["good"]:
            self.show("last_fix", told)
            self._count += 1
            self._track.append((self._count, told["latitude"], told["longitude"]))

    def show(self, name: str, told: dict[str, Any] | None) -> None:
        """Show what a message says, under a name; None: nothing any more."""
        self.changed = True
        if told is None:
            self._heard.pop(name, None)
        else:
            self._heard[name] = self._clock(), told

    def hear_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep the diagnostics of the nodes that have lights."""
        nodes = self._nodes
        for status in message.status[:STATUSES]:
            self._hear_site(status)
            name = seen_from(self._namespace, status.name)
            if nodes and _node_of(name) not in nodes:
                continue
            told = light(status, name)
            # The newest has to be the last.
            self._lights.pop(told["name"], None)
            self._lights[told["name"]] = self._clock(), told
            if len(self._lights) > LIGHTS:
                del self._lights[next(iter(self._lights))]
            self.changed = True

    def _hear_site(self, status: DiagnosticStatus) -> None:
        """Keep the known place that a solver reports, from which the Sun is shown before any fix."""
        told = {v.key: v.value for v in status.values[:STATUSES]}
        try:
            place = place_of(float(told[SITE_LATITUDE]), float(told[SITE_LONGITUDE]))
        except (KeyError, ValueError):
            return
        self._site = place or self._site

    def _sun(self, now_s: float) -> list[list[float]] | None:
        """The Sun's way at the newest place, of the stars or of GNSS, or at a known one; None without any."""
        places = [self._heard.get(name, (0.0, {}))[1] for name in ("last_fix", "gnss")]
        known = [(p["latitude"], p["longitude"]) for p in places if p.get("latitude") is not None]
        for place in (*known, *([self._site] if self._site else [])):
            # to a tenth of a degree, so that it is worked out seldom
            return sun_way(*(round(v, 1) for v in place), now_s // SUN_STEP_S * SUN_STEP_S)
        return None

    def as_json(self, now_s: float, slow_s: float) -> str:
        """Write everything as one line of JSON; each `age` [s] counts since it came, on the monotonic clock.

        now_s: the node's time (Unix).  slow_s: age at which the values that come with each frame are old.
        """
        self.changed = False
        now, nodes = self._clock(), self._nodes
        told: dict[str, Any] = {
            name: {**what, "age": now - since} for name, (since, what) in self._heard.items()
        }
        shown = {n: lit for n, lit in self._lights.items() if not nodes or _node_of(n) in nodes}
        lights = [{**light, "age": now - since} for since, light in shown.values()]
        # A node that has said nothing yet has a light, too; otherwise an all-green page might lack the solver.
        silent = nodes - {_node_of(name) for name in shown}
        if nodes != self._lit:
            self._lit, self._since = nodes, now
        unheard = {"level": STALE, "sentence": "nothing heard yet", "age": now - self._since}
        lights += [{"name": text(node, NAME_LETTERS), **unheard} for node in silent]
        told["sun"] = self._sun(now_s)
        told["lights"] = sorted(lights, key=lambda light: light["name"])
        told["now"] = now_s
        told["old_after"] = {"slow": slow_s, "fast": min(FAST_S, slow_s)}
        return json.dumps(told, allow_nan=False, separators=(",", ":"))


def names(text: str) -> frozenset[str]:
    """Split a list separated by commas into its words."""
    return frozenset(word.strip() for word in text.split(",") if word.strip())


def _node_of(name: str) -> str:
    """Node of a diagnostic: `solver` for `solver: Solution`."""
    return name.split(":", 1)[0].strip()
