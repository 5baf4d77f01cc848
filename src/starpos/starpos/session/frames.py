# SPDX-License-Identifier: Apache-2.0
"""A frame in a session: while it waits, its answer, and what the last ones come to together."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from starpos.averaging.average import Average
from starpos.earth.vertical import Geodetic
from starpos.fix.attitude import CameraAttitude
from starpos.fix.solution import Solution
from starpos.frames.frame import Stars
from starpos.gnss.watch import GnssCheck
from starpos.session.driver import Now

if TYPE_CHECKING:
    from starpos.satellites.locating import SatelliteFix


@dataclass(frozen=True, kw_only=True)
class Answered:
    """The answer to a frame: its message's stamp, its solution, the place on the ellipsoid, None without one.

    no_camera: no camera calibration has arrived.
    attitude: the camera's, by its stars; None if they do not determine it.
    compared: the GNSS place at the frame, and what the guard says of it; None without one.
    """

    stamp: Any
    solution: Solution
    ground: Geodetic | None
    no_camera: bool
    attitude: CameraAttitude | None = None
    compared: GnssCheck | None = None


@dataclass(frozen=True)
class Averaged:
    """The average after a frame was added to it, with the stamp of that frame's message."""

    stamp: Any
    place: Average
    ground: Geodetic


@dataclass(frozen=True)
class BySatellites:
    """The place by the satellites on the last frames, None where they give none; with the stamp of the newest."""

    stamp: Any
    fix: "SatelliteFix | None"


Output = Answered | Averaged | BySatellites


@dataclass(frozen=True)
class Waiting:
    """A frame that waits: the header of its message, and its stars with the error of their time.

    since_s: when it came, by the clock in which waiting is counted.
    ahead_s: how far the middle of its exposure was ahead of the session's clock then.
    doubted: whether its stars contradict its time.
    """

    header: Any
    stars: Stars
    since_s: float
    ahead_s: float
    doubted: bool = False

    def dated(self, now: Now) -> "Waiting":
        """Correct how far it is ahead of a played clock, whose tick may have arrived only after the frame."""
        if not now.played:
            return self
        return replace(self, ahead_s=min(now.ahead_s(self.stars.mid_unix_s), self.ahead_s))
