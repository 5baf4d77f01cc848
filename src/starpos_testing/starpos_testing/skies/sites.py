# SPDX-License-Identifier: Apache-2.0
"""Frames of one instrument at a known place that leans otherwise from frame to frame, for the tests of calibration."""

from dataclasses import dataclass, field, replace

import numpy as np

from starpos import rotation
from starpos.fix.solver import Solver
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.simulation.scene import Scene
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import FOCAL_PX, START, stars_of, tilt_of, wide_scene

TRUE_A3_DEG = (1.5, -2.0, 130.0)


@dataclass
class Shots:
    """Frames and the tilt of each; scene: of the last; tilts: by the middle of the exposure."""

    scene: Scene | None = None
    frames: list = field(default_factory=list)
    tilts: dict = field(default_factory=dict)

    def tilt(self, mid_unix_s: float, _exposure_s: float) -> Tilt:
        return self.tilts[mid_unix_s]

    def spoil(self, k: int, x_deg: float) -> None:
        """Misread the tilt of frame k."""
        mid = self.frames[k].mid_unix_s
        self.tilts[mid] = replace(self.tilts[mid], theta_x=self.tilts[mid].theta_x + np.radians(x_deg))

    @property
    def true_a3(self) -> np.ndarray:
        return self.scene.instrument.calibration.a3

    def solver(self, catalogue, given=(0.0, 0.0, 0.0)) -> Solver:
        """That of an instrument whose A3 is said to be as given, without its error."""
        instrument = Instrument(FOCAL_PX, calibration=Calibration(misalignment_deg=given))
        return Solver(instrument, catalogue, self.scene.site.atmosphere)


def shots(catalogue, rng, leans=(0.0,), a3_deg=TRUE_A3_DEG, start=START, noise_deg=0.0035, **scene) -> Shots:
    """One frame for each lean (deg, from 78 deg of altitude), 20 s apart."""
    made = Shots()
    for n, lean in enumerate(leans):
        here = wide_scene(pointing_deg=(40.0, 78.0 + lean, 15.0), tilt_noise_deg=noise_deg, **scene)
        made.scene = replace(
            here, instrument=replace(here.instrument, calibration=Calibration(misalignment_deg=a3_deg))
        )
        stars = stars_of(made.scene, catalogue, rng, start + 20.0 * n)
        made.frames.append(stars)
        made.tilts[stars.mid_unix_s] = tilt_of(made.scene, rng, start + 20.0 * n)
    return made


def a3_error(shot: Shots, calibration: Calibration) -> tuple[np.ndarray, float]:
    """Found to true as a small rotation about S's axes (3,) in arcsec, and its chi-square against what is claimed."""
    off = rotation.to_small_vector(shot.true_a3 @ calibration.a3.T) / ARCSEC
    return off, float(off @ np.linalg.solve(np.asarray(calibration.covariance_arcsec2), off))
