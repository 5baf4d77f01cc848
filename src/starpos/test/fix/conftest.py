# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos_testing.skies.scenes import solver_of, stars_of, tilt_of, wide_scene


@pytest.fixture(scope="module")
def night(catalogue):
    """A scene, the stars of one exposure, its tilt, and the solver of its instrument."""
    rng = np.random.default_rng(5)
    scene = wide_scene()
    return scene, stars_of(scene, catalogue, rng), tilt_of(scene, rng), solver_of(scene, catalogue)
