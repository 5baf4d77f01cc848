# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.frame import EDGE, SATURATED, Stars, no_stars

GOOD = {
    "x": [1.5, 20.25],
    "y": [3.0, 4.0],
    "flux": [900, 100],
    "snr": [30, 10],
    "covariance": np.tile(np.eye(2) * 0.01, (2, 1, 1)),
    "flags": [SATURATED, EDGE],
    "width": 640,
    "height": 480,
}


def test_sequences_become_arrays_of_double_precision():
    stars = Stars(**GOOD)
    assert len(stars) == 2
    assert stars.x.dtype == stars.flux.dtype == np.float64 and stars.flags.dtype == np.uint8
    assert len(no_stars(10, 10)) == 0


def test_taking_some_stars_keeps_the_frame_they_belong_to():
    faint = Stars(**GOOD, mid_unix_s=1e9, source="a").select([False, True])
    assert (faint.x.tolist(), faint.flags.tolist(), faint.mid_unix_s, faint.source) == (
        [20.25],
        [EDGE],
        1e9,
        "a",
    )


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"x": [1.0, np.nan]}, "NaN"),
        ({"flux": [1.0]}, "shape"),
        ({"flux": [100, 900]}, "brightest first"),
        ({"covariance": np.zeros((2, 2, 2))}, "positive definite"),
        ({"covariance": np.stack([np.eye(2), [[1.0, -2.0], [0.1, 1.0]]])}, "symmetric"),
        ({"covariance": np.stack([np.eye(2), np.eye(2) * 1e300])}, "error is 1e\\+150 px"),
        ({"covariance": np.ones((2, 2))}, "shape"),
        ({"snr": ["bright", "faint"]}, "not numbers"),
        ({"flags": [256, 0]}, "not numbers"),
        ({"width": 0}, "width"),
        ({"height": 10.5}, "height"),
        ({"mid_unix_s": np.inf}, "time"),
    ],
)
def test_what_does_not_fit_together_is_refused(wrong, says):
    with pytest.raises(FrameError, match=says):
        Stars(**{**GOOD, **wrong})
