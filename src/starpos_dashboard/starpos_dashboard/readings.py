# SPDX-License-Identifier: Apache-2.0
"""Messages to what the page is told: JSON objects, in the units people read.

A number that is not finite becomes null; a text is cut and loses what could rearrange the page's own; what does not hold
together is told as trouble, never as a value.
"""

import math

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus

from starpos.recording.messages import stamp_to_unix
from starpos_interfaces.msg import Solution, Tilt

NAME_LETTERS, SENTENCE_LETTERS = 80, 300  # of a text from outside, at most
TERMS = 16  # of an error budget, at most
STALE, ERROR = 3, 2  # of DiagnosticStatus
UNIT = 1e-3  # by which a quaternion's length may be off 1
TILT_FLAGS = (
    (Tilt.OUT_OF_RANGE, "beyond ±30°"),
    (Tilt.STUCK, "the sensor repeats one value"),
    (Tilt.SATURATED, "the converter is at its limit"),
    (Tilt.GAP, "readings were lost"),
)


def number(value: float) -> float | None:
    """None for what is not finite, which JSON cannot hold and a person must not read as a number."""
    value = float(value)
    return value if math.isfinite(value) else None


def text(value: str, letters: int = SENTENCE_LETTERS) -> str:
    """One line of at most so many letters, without control characters and marks that turn the reading direction."""
    line = "".join(c if c.isprintable() else " " for c in value[: 2 * letters])
    line = " ".join(line.split())
    return line if len(line) <= letters else line[: letters - 1] + "…"


def position(message: NavSatFix) -> dict:
    """Place [deg], altitude [m], covariance of (east, north) [m2] as [ee, en, nn]; good: False where it is no fix."""
    told = {"good": False, "trouble": "", "stamp": stamp_to_unix(message.header.stamp)}
    latitude, longitude = number(message.latitude), number(message.longitude)
    if message.status.status == NavSatStatus.STATUS_NO_FIX:
        return told | {"trouble": "no fix"}
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 360:
        return told | {"trouble": "the position is not on Earth: it is not shown"}
    covariance = _covariance(message)
    return told | {
        "good": True,
        "trouble": "" if covariance else "how far it may be off is not known",
        "latitude": latitude,
        "longitude": math.remainder(longitude, 360.0),
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
    """Azimuth of the frame's x axis, clockwise from north, and its sigma [deg]; None where there is no attitude."""
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
    """Elevations of the inclinometer's axes and their sigmas [deg], temperature [deg C], what the flags say."""
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


def solution(message: Solution) -> dict:
    """What the newest frame gave, in words and counts, and the error budget: east, north [m], heading [deg], 1 sigma."""
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
        "budget": terms,
        "stamp": stamp_to_unix(message.header.stamp),
    }


def seen_from(namespace: str, name: str) -> str:
    """A diagnostic's name as it is in a namespace: `solver: Solution` of its own, else whole: `/b/solver: Solution`."""
    whole = name if name.startswith("/") else f"/{name}"
    return whole.removeprefix(namespace.rstrip("/") + "/")


def light(status: DiagnosticStatus, name: str) -> dict:
    """One diagnostic, under a name; a level that is none of the four is an error."""
    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    return {
        "name": text(name, NAME_LETTERS),
        "level": level if 0 <= level <= STALE else ERROR,
        "sentence": text(status.message),
    }


def silence(node: str) -> dict:
    """The light of a node that has said nothing yet: without it a page where all is green might lack the solver."""
    name = text(node, NAME_LETTERS)
    return {"name": name, "level": STALE, "sentence": "nothing heard yet"}
