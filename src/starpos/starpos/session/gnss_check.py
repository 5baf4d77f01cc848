# SPDX-License-Identifier: Apache-2.0
"""Whether GNSS, if present, agrees with the stars' place."""

from typing import Any

from starpos.earth.vertical import Vertical
from starpos.errors import GnssError
from starpos.fix.solution import Solution
from starpos.gnss.place import GnssPlace, message_to_gnss
from starpos.session.frames import ground_of
from starpos.session.gnss import OLDEST_S, UNSTATED_M, contradiction


class GnssComparison:
    """Keeps the last place of GNSS; it never changes a fix."""

    def __init__(self) -> None:
        self._place: GnssPlace | None = None

    def take(self, message: Any) -> None:
        """Take a sensor_msgs/NavSatFix; one without a usable place is forgotten."""
        try:
            self._place = message_to_gnss(message, UNSTATED_M)
        except GnssError:
            self._place = None

    def remark(self, answer: Solution | None, vertical: Vertical) -> str:
        """Sentence with the distance, where both places cannot be right; '' otherwise."""
        fix = None if answer is None else answer.fix
        if fix is None or self._place is None or abs(fix.utc_unix_s - self._place.utc_unix_s) > OLDEST_S:
            return ""
        _, wrong = contradiction(self._place, ground_of(fix, vertical), fix.utc_unix_s, 0.0)
        return f"{wrong}: check how frames are turned, A3 and the inclinometer's axes" if wrong else ""
