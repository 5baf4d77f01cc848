# SPDX-License-Identifier: Apache-2.0
"""Frames of an instrument at a known place, with a lean of its own for each frame, for the tests of calibration."""

from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.instrument.tilt_log import TiltsByTime
from starpos.simulation.scene import Scene
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import FOCAL_PX, START, stars_of, tilt_of, wide_scene

TRUE_A3_DEG = (1.5, -2.0, 130.0)


@dataclass
class Shots:
    """Frames and the tilt of each; scene: of the last; tilts: by the middle of the exposure."""

    scene: Scene
    frames: list[Stars]
    tilts: dict[float | None, Tilt]

    @property
    def tilt(self) -> TiltsByTime:
        """The tilts as a solver takes them."""
        return TiltsByTime(self.tilts)

    def spoil(self, k: int, x_deg: float) -> None:
        """Put an error on the tilt of frame k."""
        mid = self.frames[k].mid_unix_s
        self.tilts[mid] = replace(self.tilts[mid], theta_x=self.tilts[mid].theta_x + np.radians(x_deg))

    @property
    def true_a3(self) -> np.ndarray:
        return self.scene.instrument.calibration.a3

    def solver(self, catalogue, given=(0.0, 0.0, 0.0)) -> Solver:
        """The solver of an instrument with the given A3 without a stated error, so it is not known."""
        instrument = Instrument(
            FOCAL_PX, calibration=Calibration(misalignment_deg=given), inclinometer=SCA100T_CALIBRATED
        )
        return Solver(instrument, catalogue, self.scene.site.atmosphere)


def shots(catalogue, rng, leans=(0.0,), a3_deg=TRUE_A3_DEG, start=START, noise_deg=0.0035, **scene) -> Shots:
    """One frame for each lean (deg, from 78 deg of altitude), at least one, 20 s apart."""
    frames, tilts = [], {}
    for n, lean in enumerate(leans):
        here = wide_scene(pointing_deg=(40.0, 78.0 + lean, 15.0), tilt_noise_deg=noise_deg, **scene)
        calibration = Calibration(misalignment_deg=a3_deg)
        shot = replace(here, instrument=replace(here.instrument, calibration=calibration))
        stars = stars_of(shot, catalogue, rng, start + 20.0 * n)
        frames.append(stars)
        tilts[stars.mid_unix_s] = tilt_of(shot, rng, start + 20.0 * n)
    return Shots(shot, frames, tilts)


def a3_error(shot: Shots, calibration: Calibration) -> tuple[np.ndarray, float]:
    """Error of A3 as a small rotation (3,) in arcsec about S's axes, and its chi-square by the stated covariance."""
    off = rotation.to_small_vector(shot.true_a3 @ calibration.a3.T) / ARCSEC
    return off, float(off @ np.linalg.solve(np.asarray(calibration.covariance_arcsec2), off))
