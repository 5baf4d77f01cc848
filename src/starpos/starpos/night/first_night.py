# SPDX-License-Identifier: Apache-2.0
"""The first night of an instrument: what each frame shows, step by step, and what to do next.

The steps follow from the frames and the tilts alone, in their order, so reading a night again comes to the same step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from starpos import rotation
from starpos.calibration.misalignment import Calibrated
from starpos.earth.orientation import earth_state
from starpos.errors import StarposError
from starpos.fix.searching import Sight, of_one_camera
from starpos.fix.solver import Solver
from starpos.frames.frame import SATURATED
from starpos.frozen import at_once
from starpos.instrument.inclinometer import up_of
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.night.remarks import worth_saving
from starpos.night.together import turned

# Widths of star images that the detector measures well, px.
NARROWEST_PX, WIDEST_PX = 1.2, 4.0
# Number of frames in a row that are as sharp as the sharpest so far, within this share.
SHARP_FRAMES, AS_SHARP = 3, 1.1
MIN_STARS = 20
# Number of the brightest stars, and the share of them that may be saturated.
BRIGHTEST, MAX_SATURATED = 20, 0.2
# The level is watched so long; a lean that moves less than its noise, times this, is still.
LEVEL_S, STILL = 10.0, 3.0
# A level is still around a frame for so long before and after its middle.
AROUND_S = 1.5
MIN_LEAN_DEG, MAX_LEAN_DEG = 0.5, 10.0
# Two leans are about axes that differ by this at least.
OTHER_LEAN_DEG = 40.0
# The stars lean as the level does within this share. A turn of A3 beyond OFF_DEG contradicts what was stated.
OFF_SHARE, OFF_DEG = 0.1, 10.0
# Sigma of the turn of A3 about the vertical after the leans.
TURN_STDDEV_DEG = 3.0
HEADINGS, FRAMES_EACH, APART_DEG = 4, 3, 45.0
BAR = 20
# the step after which the clock is looked at
LEVEL = "level"


@dataclass(frozen=True)
class Look:
    """What a step found at a frame; todo: what to do next."""

    done: bool
    found: str
    todo: str


@at_once
@dataclass(frozen=True)
class Standing:
    """An identified frame of a still instrument: its sight, up (3,) in S, and ITRS into C (3, 3)."""

    sight: Sight
    up: np.ndarray
    camera: np.ndarray


class FirstNight:
    """Inspects the frames of a first night; `turned` is what the last step found, once A3 is known.

    solver: with A3 as far as it is known.
    """

    def __init__(self, solver: Solver) -> None:
        self.turned: Calibrated | None = None
        self._solver = solver
        self._steps: list[tuple[str, Callable[[Sight, TiltLog | str], Look]]] = [
            ("focus", self._focus),
            ("exposure", self._exposure),
            (LEVEL, self._level),
            ("horizon", partial(self._with_pose, self._horizon)),
            ("turn", partial(self._with_pose, self._turn)),
        ]
        self._widths: list[float] = []
        self._base: Standing | None = None
        # Direction in which each lean moved up in S (rad), and its pose.
        self._leans: list[tuple[float, Standing]] = []
        self._poses: list[Standing] = []
        self._headings: list[list[Standing]] = []

    @property
    def instrument(self) -> Instrument:
        """The instrument, with A3 as far as it is known."""
        return self._solver.instrument

    @property
    def step(self) -> str:
        """The step that the next frame is for; '' after the last."""
        return self._steps[0][0] if self._steps else ""

    def inspect(self, sight: Sight, log: TiltLog | str) -> Look:
        """Inspect the next frame, identified, with the tilts so far, or a sentence on why they are missing."""
        look = self._steps[0][1](sight, log)
        if look.done:
            self._steps.pop(0)
        return look

    def _focus(self, sight: Sight, _: TiltLog | str) -> Look:
        width = sight.stars.fwhm_px
        if width is None or not width > 0:
            return Look(False, "no width of stars", "check cap, clouds and exposure")
        self._widths.append(width)
        best = min(self._widths)
        bar = "#" * round(BAR * best / width)
        found = f"FWHM {width:4.1f} px [{bar:<{BAR}}] best {best:.1f}"
        last = self._widths[-SHARP_FRAMES:]
        if len(last) == SHARP_FRAMES and max(last) <= min(AS_SHARP * best, WIDEST_PX):
            return Look(True, found, "leave the focus as it is and fix it with tape")
        if width > AS_SHARP * best:
            return Look(False, found, "turn the ring back: it was sharper")
        if width > WIDEST_PX:
            return Look(False, found, f"turn the focus ring a little, until it is under {WIDEST_PX:g} px")
        return Look(False, found, "hands off for some frames")

    def _exposure(self, sight: Sight, _: TiltLog | str) -> Look:
        stars = sight.stars
        flags = stars.flags[:BRIGHTEST]
        saturated = np.count_nonzero(flags & SATURATED) / max(len(flags), 1)
        scale_arcsec = self._solver.instrument.camera_for(stars.width, stars.height).scale_arcsec
        trail_px = 15.04 * (stars.exposure_s or 0.0) / scale_arcsec
        found = (
            f"{len(stars)} stars, {saturated:.0%} of the brightest saturated, trails up to {trail_px:.1f} px"
        )
        if stars.fwhm_px is not None and stars.fwhm_px < NARROWEST_PX:
            found += f", FWHM {stars.fwhm_px:.1f} px: too sharp for its pixels"
        if saturated > MAX_SATURATED:
            return Look(False, found, "halve the exposure, or the gain")
        if len(stars) < MIN_STARS:
            return Look(False, found, "double the exposure, or the gain")
        if sight.found is None:
            return Look(False, found, sight.solution.message)
        return Look(True, f"{found}, {len(sight.found.star)} identified", "keep exposure and gain")

    def _level(self, sight: Sight, log: TiltLog | str) -> Look:
        if isinstance(log, str):
            return Look(False, log, "connect the inclinometer")
        end = log.utc_unix_s[-1]
        late_s = (sight.stars.mid_unix_s or 0.0) - end
        near = log.utc_unix_s > end - LEVEL_S
        if late_s > LEVEL_S or np.ptp(log.utc_unix_s[near]) < 0.8 * LEVEL_S:
            return Look(False, f"no tilts over {LEVEL_S:.0f} s yet", "leave the instrument alone")
        angles = np.degrees([log.theta_x[near], log.theta_y[near]]) * 3600
        minutes = (log.utc_unix_s[near] - end) / 60
        drift = np.polyfit(minutes, angles.T, 1)[0]
        noise = float(np.std(np.diff(angles), axis=1).max() / np.sqrt(2))
        stated = np.degrees(self._solver.instrument.inclinometer.noise_rad) * 3600
        found = f"noise {noise:.1f} arcsec (stated {stated:.1f}), drift {drift[0]:+.0f}, {drift[1]:+.0f} arcsec/min"
        if not _still(log, end - LEVEL_S, end):
            return Look(False, found, "wait until nothing moves: a firm ground, no wind, no hands")
        return Look(True, found, "the level is still")

    def _with_pose(self, look: Callable[[Standing], Look], sight: Sight, log: TiltLog | str) -> Look:
        if isinstance(log, str):
            return Look(False, log, "connect the inclinometer")
        mid = sight.stars.mid_unix_s
        if sight.found is None or mid is None:
            return Look(False, sight.solution.message, "wait for stars")
        try:
            tilt = log.average(mid, sight.stars.exposure_s or 0.0)
            self._solver.instrument.inclinometer.check_live(tilt)
        except StarposError as error:
            return Look(False, str(error), "wait for tilts")
        if not _still(log, mid - AROUND_S, mid + AROUND_S):
            return Look(False, "it moves", "hands off until it is still")
        camera = sight.found.attitude @ earth_state(mid).gcrs_to_itrs.T
        return look(Standing(sight, up_of(tilt.theta), camera))

    def _horizon(self, pose: Standing) -> Look:
        """Compare leans by the level with the same leans by the stars, through A3."""
        if self._base is None:
            self._base = pose
            return self._lean("the instrument as it stands")
        base = self._base
        moved = pose.up - base.up
        lean_deg = np.degrees(np.arccos(np.clip(pose.up @ base.up, -1, 1)))
        found = f"it leans by {lean_deg:.2f} deg from before"
        if not MIN_LEAN_DEG <= lean_deg <= MAX_LEAN_DEG:
            return self._lean(found)
        direction = float(np.arctan2(moved[1], moved[0]))
        if self._leans:
            other_deg = np.degrees(abs(rotation.half_turn(2 * (direction - self._leans[0][0])))) / 2
            if other_deg < OTHER_LEAN_DEG:
                return self._lean(found)
        leans = [*(pose for _, pose in self._leans), pose]
        off, misfit = self._turn_of(base, leans, mirrored=False)
        if misfit <= OFF_SHARE:
            self._leans.append((direction, pose))
            self._poses.append(pose)
            return self._lean(f"{found}, and the stars too") if len(leans) == 1 else self._agreed(found, off)
        found += f", the stars differ by {misfit:.0%}"
        if len(leans) > 1 and self._turn_of(base, leans, mirrored=True)[1] <= OFF_SHARE:
            todo = "one of X' and Y' has the wrong sign, or they are swapped: correct it, and begin anew"
            return Look(False, f"{found}: the level is mirrored", todo)
        return Look(False, found, "camera and level do not move together: look what is loose")

    def _turn_of(self, base: Standing, leans: Sequence[Standing], mirrored: bool) -> tuple[float, float]:
        """Turn of A3 about Z' (rad) with which the stars lean as the level does, and the misfit as a share of the lean.

        mirrored: as if Y' had the wrong sign.
        """
        sign = np.array([1.0, -1.0 if mirrored else 1.0, 1.0])
        a3 = self._solver.instrument.calibration.a3
        turns = np.radians(np.arange(-180.0, 180.0, 0.5))
        square = np.zeros(len(turns))
        for pose in leans:
            seen = a3 @ pose.camera @ base.camera.T @ a3.T
            about = np.array([rotation.about_axis(2, turn) for turn in turns])
            up = about @ seen @ about.transpose(0, 2, 1) @ (sign * base.up)
            lean = np.linalg.norm(pose.up - base.up)
            square += ((up - sign * pose.up) ** 2).sum(1) / lean**2
        best = int(square.argmin())
        return float(turns[best]), float(np.sqrt(square[best] / len(leans)))

    def _agreed(self, found: str, off: float) -> Look:
        """Turn A3 about Z' as the leans show."""
        instrument = self._solver.instrument
        rx, ry, rz = instrument.calibration.misalignment_deg
        now_deg = float(np.degrees(rotation.half_turn(np.radians(rz) + off)))
        calibration = Calibration.of((rx, ry, now_deg))
        self._solver = replace(self._solver, instrument=replace(instrument, calibration=calibration))
        found += ", and the stars too: "
        if abs(np.degrees(off)) > OFF_DEG:
            found += f"A3's rz is {now_deg:.0f} deg, not {rz:.0f}"
        else:
            found += f"A3's signs are right, its rz is {now_deg:.0f} deg"
        return Look(True, found, "set the foot back; then turn the whole instrument on the spot by 90 deg")

    def _lean(self, found: str) -> Look:
        foot = "only another foot, a quarter around," if self._leans else "one foot"
        return Look(False, found, f"raise {foot} by 1 to 5 deg, and wait")

    def _turn(self, pose: Standing) -> Look:
        near = [k for k, heading in enumerate(self._headings) if _angle_deg(heading[0], pose) < APART_DEG]
        if not near:
            self._headings.append([])
        number = near[0] if near else len(self._headings) - 1
        self._headings[number].append(pose)
        self._poses.append(pose)
        number, many = number + 1, len(self._headings[number])
        found = f"heading {number} of {HEADINGS}: frame {many}"
        if many < FRAMES_EACH:
            return Look(False, found, "hands off")
        if sum(len(h) >= FRAMES_EACH for h in self._headings) < HEADINGS:
            return Look(False, found, "turn by 90 deg on the spot, always the same way")
        return self._calibrated(found)

    def _calibrated(self, found: str) -> Look:
        solver, frames = of_one_camera(self._solver, [p.sight for p in self._poses])
        ups = np.array([p.up for p in self._poses])
        log = TiltLog.of(
            np.array([p.sight.stars.mid_unix_s for p in self._poses]),
            np.arcsin(ups[:, 0]),
            np.arcsin(ups[:, 1]),
            np.full(len(ups), np.nan),
            self._solver.instrument.inclinometer.noise_rad,
            # of a sensor that hangs, which has three axes
            np.arcsin(ups[:, 2]) if (ups[:, 2] < 0).any() else None,
        )
        a3, remarks = turned(solver, frames, log, TURN_STDDEV_DEG)
        said = f"{found}; {'; '.join(remarks)}"
        if not worth_saving(a3):
            return Look(False, said, "turn on, to other headings")
        self.turned = a3
        return Look(True, said, "A3 is known")


def _angle_deg(one: Standing, other: Standing) -> float:
    return float(np.degrees(np.linalg.norm(rotation.to_vector(one.camera @ other.camera.T))))


def _still(log: TiltLog, begin_s: float, end_s: float) -> bool:
    """Whether the level's readings between two times differ by no more than their stated noise explains."""
    near = (log.utc_unix_s >= begin_s) & (log.utc_unix_s <= end_s)
    angles = np.stack([log.theta_x, log.theta_y])[:, near]
    if angles.shape[1] < 2:
        return True
    noise = np.sqrt(np.trace(log.covariance[near], axis1=1, axis2=2).mean() / 2)
    halves = np.array_split(angles, 2, axis=1)
    moved = np.abs(halves[0].mean(1) - halves[1].mean(1)).max()
    return bool(angles.std(1).max() <= STILL * noise and moved <= STILL * noise)
