# SPDX-License-Identifier: Apache-2.0
"""The mounting plate: its mesh is closed and has the source's sizes, and its flexure is a beam's."""

import math
import re
import runpy
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

HARDWARE = Path(__file__).resolve().parents[1] / "hardware"


def _triangles(path):
    """Read an ASCII STL, (n, 3, 3) mm."""
    numbers = re.findall(r"^\s*vertex (\S+) (\S+) (\S+)", path.read_text(), re.MULTILINE)
    return np.array(numbers, float).reshape(-1, 3, 3)


def _volume_mm3(triangles):
    return np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6


@pytest.fixture(scope="module")
def flexure():
    return runpy.run_path(str(HARDWARE.parents[1] / "tools" / "plate_flexure.py"))


@pytest.fixture(scope="module")
def mesh():
    return _triangles(HARDWARE / "plate.stl")


def test_mesh_is_closed_and_points_outwards(mesh):
    corners = [[tuple(corner) for corner in triangle] for triangle in mesh.tolist()]
    edges = Counter((t[i], t[(i + 1) % 3]) for t in corners for i in range(3))
    assert max(edges.values()) == 1
    assert all((b, a) in edges for a, b in edges)
    assert _volume_mm3(mesh) > 0


def test_mesh_has_the_sizes_of_its_source(mesh, flexure):
    size = flexure["sizes_mm"]()
    extent = np.ptp(mesh.reshape(-1, 3), axis=0)
    height = size["thickness_mm"] + size["post_height_mm"]
    assert extent == pytest.approx((size["length_mm"], size["width_mm"], height), abs=1e-3)
    # The plate with round corners and posts, less slots, the mount's hole and the threads.
    thickness, slot = size["thickness_mm"], size["slot_mm"]

    def stadium(diameter):
        return math.pi * diameter**2 / 4 + slot * diameter

    plate = (size["length_mm"] * size["width_mm"] - (4 - math.pi) * size["corner_mm"] ** 2) * thickness
    posts = 4 * math.pi / 4 * size["post_mm"] ** 2 * size["post_height_mm"]
    deep = size["camera_head_depth_mm"]
    screws = 2 * (
        stadium(size["camera_hole_mm"]) * (thickness - deep) + stadium(size["camera_head_mm"]) * deep
    )
    mount = math.pi / 4 * size["mount_hole_mm"] ** 2 * thickness
    threads = 4 * math.pi / 4 * size["thread_mm"] ** 2 * size["thread_depth_mm"]
    # Circles are polygons of 32 sides, which loses 0.6 % of them.
    assert _volume_mm3(mesh) == pytest.approx(plate + posts - screws - mount - threads, rel=2e-4)


def test_holes_and_posts_are_on_the_plate(flexure):
    size = flexure["sizes_mm"]()
    board_end = size["board_x_mm"] + (size["board_spacing_x_mm"] + size["post_mm"]) / 2
    half_slot = (size["slot_mm"] + size["camera_head_mm"]) / 2
    assert size["board_x_mm"] - (size["board_spacing_x_mm"] + size["post_mm"]) / 2 > 0
    assert board_end < size["camera_x_mm"] - half_slot
    assert size["camera_x_mm"] + half_slot < size["mount_x_mm"] - size["mount_hole_mm"] / 2
    assert size["mount_x_mm"] + size["mount_hole_mm"] / 2 < size["lens_x_mm"] - half_slot
    assert size["lens_x_mm"] + half_slot < size["length_mm"]
    assert size["board_spacing_y_mm"] + size["post_mm"] < size["width_mm"]
    assert size["thread_depth_mm"] < size["thickness_mm"] + size["post_height_mm"]


def test_holes_are_in_the_mesh_where_the_source_has_them(mesh, flexure):
    size = flexure["sizes_mm"]()
    lower = mesh.reshape(-1, 3)[mesh.reshape(-1, 3)[:, 2] == 0]
    # The middle line leaves each hole and enters it at a corner of the lower face.
    crossings = sorted(set(np.round(lower[np.abs(lower[:, 1]) < 1e-6, 0], 3).tolist()))
    half_slot = (size["slot_mm"] + size["camera_head_mm"]) / 2
    halves = {"camera_x_mm": half_slot, "mount_x_mm": size["mount_hole_mm"] / 2, "lens_x_mm": half_slot}
    expected = sorted(size[name] + side * half for name, half in halves.items() for side in (-1, 1))
    assert crossings == pytest.approx(expected, abs=1e-3)
    upper = mesh.reshape(-1, 3)[mesh.reshape(-1, 3)[:, 2] > size["thickness_mm"] + 1e-6]
    for x in (-1, 1):
        for y in (-1, 1):
            middle = (
                size["board_x_mm"] + x * size["board_spacing_x_mm"] / 2,
                y * size["board_spacing_y_mm"] / 2,
            )
            away = np.hypot(*(upper[:, :2] - middle).T)
            assert np.sum(away < size["post_mm"] / 2 + 1e-3) > 40


def test_flexure_is_that_of_a_beam_integrated_numerically(flexure):
    size = flexure["sizes_mm"]()
    span = (size["mount_x_mm"] - size["camera_x_mm"]) / 1000
    x, step = np.linspace(0, span, 10001, retstep=True)
    force = 2.5 * 9.81 * math.sin(math.radians(1))
    moment = force * (span - x) + force * 0.06
    second = (size["width_mm"] - size["camera_hole_mm"]) * size["thickness_mm"] ** 3 / 12 * 1e-12
    turn = np.sum((moment[1:] + moment[:-1]) / 2) * step / (69e9 * second)
    assert flexure["arcsec_per_deg"](69e9, 2.5, 0.06) == pytest.approx(math.degrees(turn) * 3600, rel=1e-6)
