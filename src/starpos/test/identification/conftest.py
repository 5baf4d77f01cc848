# SPDX-License-Identifier: Apache-2.0
import pytest
from crowds import CAMERA

from starpos.identification import Sky, triangles


@pytest.fixture(scope="module")
def sky(catalogue):
    """The sky of the field of `crowds`."""
    return Sky(catalogue, triangles.cached_triangles(catalogue, CAMERA.half_diagonal_rad))
