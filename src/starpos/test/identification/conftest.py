# SPDX-License-Identifier: Apache-2.0
import pytest
from crowds import CAMERA

from starpos.identification import Sky, triangle_cache


@pytest.fixture(scope="module")
def sky(catalogue):
    """The sky of the field of `crowds`."""
    return Sky(catalogue, triangle_cache.cached(catalogue, CAMERA.half_diagonal_rad))
