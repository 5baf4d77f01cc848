# SPDX-License-Identifier: Apache-2.0
"""Tilts on their way into a session's buffer: which are kept, and when."""

from collections import deque
from dataclasses import replace
from typing import Any

from starpos.errors import StarposError, TiltError
from starpos.messages.stamp import stamp_to_unix
from starpos.session import reports
from starpos.session.log import Heard
from starpos.session.now import Now, Sent
from starpos.session.settings import Settings
from starpos.session.tilts import TiltBuffer
from starpos.session.transforms import FrameNames, name_in

MAX_EARLY = 1000


class TiltIntake:
    """Gives tilts to a buffer; names: of the frames of the messages taken."""

    def __init__(self, tilts: TiltBuffer, names: FrameNames, settings: Settings, heard: Heard) -> None:
        self._tilts, self._names, self._settings, self._heard = tilts, names, settings, heard
        # those ahead of a clock that may have been heard only after them
        self._early: deque[Any] = deque(maxlen=MAX_EARLY)

    @property
    def waits(self) -> bool:
        """Whether a tilt waits for its time."""
        return bool(self._early)

    def clear(self) -> None:
        self._early.clear()

    def take(self, message: Any, sent: Sent, now: Now) -> None:
        """Take a Tilt."""
        stamp_s = stamp_to_unix(message.header.stamp)
        if sent.unix_s is not None and not now.played:
            # A process that stood still may read it only when its time has come.
            now = replace(now, unix_s=min(sent.unix_s, sent.unix_s if now.unix_s is None else now.unix_s))
        try:
            self._tilts.heard(message, sent.number, now.waiting_s)
            ahead_s = now.ahead_s(stamp_s)
        except StarposError as e:
            self._heard.refuse("tilt", str(e))
            return
        if now.played and ahead_s > reports.AHEAD_S:
            self._early.append(message)
        else:
            self._add(message, now)

    def go_on(self, now: Now) -> None:
        """Look again at those that were ahead of the clock."""
        early, self._early = self._early, deque(maxlen=MAX_EARLY)
        for message in early:
            self._add(message, now)

    def _add(self, message: Any, now: Now) -> None:
        """Keep a tilt, unless it is broken, or of the future: the instrument may lean otherwise when its time comes."""
        try:
            if (ahead_s := now.ahead_s(stamp_to_unix(message.header.stamp))) > reports.AHEAD_S:
                raise TiltError(f"a tilt is stamped {ahead_s:.3g} s in the future: {reports.ONE_CLOCK}")
            self._tilts.add(message, self._settings.tilt_stddev_rad)
            self._tilts.came_late(-ahead_s)
            self._heard.came("tilt")
            self._names.inclinometer = name_in(message)
        except StarposError as e:
            self._heard.refuse("tilt", str(e))
