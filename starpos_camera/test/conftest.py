# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, someone who listens to them, and frames for them."""

import numpy as np
import pytest

from starpos.simulation.scene import expose, render, scene_of, write_fits
from starpos.sky.catalogue import load_catalogue
from starpos_testing.nodes import Listener, Process, take_domain

SIZE = (640, 480)
# 50 mm on 6.4 um.
FOCAL_PX = 7812.5
# 2026-11-02T18:00:00Z
START_S = 1793642400.0
EXPOSURE_S = 0.5


@pytest.fixture(scope="session", autouse=True)
def domain():
    take_domain()


@pytest.fixture
def listener():
    listener = Listener()
    yield listener
    listener.close()


@pytest.fixture
def start():
    processes = []

    def start(executable, *parameters):
        processes.append(Process("starpos_camera.main", executable, parameters))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()


@pytest.fixture(scope="session")
def scene():
    return scene_of(SIZE, FOCAL_PX)


@pytest.fixture(scope="session")
def frame(scene):
    """A frame with some tens of stars."""
    rng = np.random.default_rng(3)
    return render(scene, expose(scene, load_catalogue(), START_S, EXPOSURE_S, rng), START_S, EXPOSURE_S, rng)


@pytest.fixture
def folder(tmp_path, frame):
    """Three frames, 5 s apart, the middle one truncated; the others are 0.fits and 2.fits."""
    for k in range(3):
        write_fits(tmp_path / f"{k}.fits", frame, f"2026-11-02T18:00:{5 * k:02d}")
    middle = tmp_path / "1.fits"
    middle.write_bytes(middle.read_bytes()[:100_000])
    return tmp_path
