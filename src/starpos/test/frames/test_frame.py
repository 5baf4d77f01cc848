# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.frame import Frame


def test_depths_and_colours_a_camera_gives_are_accepted():
    assert Frame(np.zeros((2, 3), np.uint8)).width == 3
    assert Frame(np.zeros((2, 3), np.uint16), pattern="grbg").height == 2
    assert Frame(np.zeros((2, 3, 3), np.uint8), mid_unix_s=1.7e9, exposure_s=0.5).width == 3


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"pixels": [[1, 2]]}, "numpy array"),
        ({"pixels": np.zeros((4, 4), np.float32)}, "convert them to uint8 or uint16"),
        ({"pixels": np.zeros((4, 4, 3), np.uint16)}, "convert them to uint8"),
        ({"pixels": np.zeros((4, 4, 4), np.uint8)}, "shape"),
        ({"pixels": np.zeros(4, np.uint8)}, "shape"),
        ({"pixels": np.zeros((0, 0), np.uint8)}, "width"),
        ({"pattern": "rgb"}, "pattern"),
        ({"pixels": np.zeros((4, 4, 3), np.uint8), "pattern": "rggb"}, "pattern"),
        ({"mid_unix_s": float("nan")}, "time"),
        ({"exposure_s": -1.0}, "exposure"),
        ({"exposure_s": 1e300}, "exposure"),
        ({"focal_px": 0.0}, "focal"),
    ],
)
def test_anything_else_is_refused_in_a_sentence_that_names_the_source(wrong, says):
    with pytest.raises(FrameError, match=says) as raised:
        Frame(**{"pixels": np.zeros((4, 4), np.uint8), "source": "night/7.fits", **wrong})
    assert str(raised.value).startswith("night/7.fits: ") and str(raised.value).endswith(".")
