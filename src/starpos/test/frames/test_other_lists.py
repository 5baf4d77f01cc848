# SPDX-License-Identifier: Apache-2.0
"""Lists of stars under the names that other programs give to their columns, which count from 1 or from 0."""

import numpy as np
import pytest

from starpos.cli.inputs import stated_site
from starpos.errors import FrameError
from starpos.frames.reading import read_frame

HEAD = '# {"NAXIS1": 100, "NAXIS2": 80}\n'


@pytest.mark.parametrize(
    ("names", "counted_from"),
    [
        ("x,y,flux", 0),
        ("X_IMAGE,Y_IMAGE,FLUX_AUTO", 1),
        ("X_IMAGE,Y_IMAGE,FLUX", 1),
        ("XCENTER,YCENTER,FLUX", 1),
        ("xcentroid,ycentroid,flux", 0),
    ],
)
def test_the_first_pixel_is_where_the_program_has_it(tmp_path, names, counted_from):
    path = tmp_path / "a.csv"
    path.write_text(f"{HEAD}{names}\n10.5,20.25,300\n30,40,900\n")
    stars = read_frame(path)
    assert np.allclose(stars.x, np.array([30, 10.5]) - counted_from)
    assert np.allclose(stars.y, np.array([40, 20.25]) - counted_from)
    assert stars.flux.tolist() == [900, 300]


def test_magnitudes_are_taken_where_there_is_no_flux(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"{HEAD}XCENTER,YCENTER,MAG\n10,20,-2.5\n30,40,-5\n")
    stars = read_frame(path)
    assert stars.x.tolist() == [29, 9] and np.allclose(stars.flux, [100, 10])


def test_a_list_of_two_places_keeps_ours(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"{HEAD}x,y,X_IMAGE,Y_IMAGE,flux\n10,20,11,21,5\n")
    assert read_frame(path).x.tolist() == [10]


def test_a_list_without_light_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"{HEAD}X_IMAGE,Y_IMAGE\n10,20\n")
    with pytest.raises(FrameError, match="flux"):
        read_frame(path)


ASCII_HEAD = """#   1 NUMBER                 Running object number
#   2 FLUX_APER              Flux vector within fixed circular aperture(s)  [count]
#   4 X_IMAGE                Object position along x                        [pixel]
#   5 Y_IMAGE                Object position along y                        [pixel]
#   6 MAG_AUTO               Kron-like elliptical aperture magnitude        [mag]
#   7 FLAGS                  Extraction flags
         1   10.0   12.0   11.5   21.25   -2.5    0
         2  100.0  120.0   31.0   41.00   -5.0    4
"""


def test_a_list_with_sextractors_own_head_is_read_below_the_frames_size(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(HEAD + ASCII_HEAD)
    stars = read_frame(path)
    assert stars.x.tolist() == [30, 10.5] and stars.y.tolist() == [40, 20.25]
    assert stars.flags.tolist() == [0, 0]
    path.write_text(ASCII_HEAD)
    with pytest.raises(FrameError, match="first line does not give the frame's size"):
        read_frame(path)


def test_a_site_of_the_header_is_said_where_one_is_wanted(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        '# {"NAXIS1": 100, "NAXIS2": 80, "SITELAT": "+47 06", "SITELONG": -11.3}\nx,y,flux\n1,2,3\n'
    )
    assert stated_site([str(path)]).endswith(
        "SITELAT +47 06 and SITELONG -11.3: if that is right, give it (east is positive)"
    )
    assert read_frame(path).site_deg == pytest.approx((47.1, -11.3))
    path.write_text(f"{HEAD}x,y,flux\n1,2,3\n")
    assert read_frame(path).site_deg is None
    assert stated_site([str(path)]) == stated_site(["none.csv"]) == stated_site([]) == ""
