# SPDX-License-Identifier: Apache-2.0
"""What a night is read from: the instrument of a frame, when it was exposed, and a table of tilts that changes."""

import os

import numpy as np
import pytest

from starpos.errors import FrameError, TiltError
from starpos.frames.frame import Frame, no_stars
from starpos.frames.tables import write_star_list
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.night.reading import Instruments, Reader, TiltFile
from starpos_testing.skies.scenes import START, random_stars

GIVEN = Instrument(5000.0)
CAMERAS = {(300, 200): Camera.from_focal(300, 200, 700.0)}


@pytest.mark.parametrize(
    ("instruments", "header_px", "focal_px"),
    [
        (Instruments(GIVEN), 900.0, 5000.0),
        (Instruments(GIVEN, by_header=True), 900.0, 900.0),
        (Instruments(GIVEN, by_header=True), None, 5000.0),
        (Instruments(None, by_header=True), 900.0, 900.0),
        (Instruments(None), 900.0, None),
        (Instruments(GIVEN, cameras=CAMERAS), 900.0, 700.0),
        (Instruments(GIVEN, cameras=CAMERAS, any_size=False), None, 700.0),
        (Instruments(GIVEN, cameras={(100, 100): CAMERAS[300, 200]}), None, 5000.0),
        (Instruments(GIVEN, any_size=False), 900.0, None),
    ],
)
def test_which_focal_length_a_frame_has(instruments, header_px, focal_px):
    known = instruments.of(no_stars(300, 200, focal_px=header_px))
    assert (None if known is None else known.focal_px) == focal_px


@pytest.fixture
def stars_file(tmp_path, rng):
    path = tmp_path / "stars.csv"
    write_star_list(path, random_stars(9, rng), "2026-11-02T18:00:00", 6.4)
    return str(path)


def test_a_shutter_that_opens_late_moves_the_time_and_widens_it(stars_file):
    plain, late = (Reader(delay_s=d)(stars_file) for d in ((0.0, 0.0), (0.2, 0.05)))
    assert late.mid_unix_s - plain.mid_unix_s == pytest.approx(0.2)
    assert late.stamp_stddev_s == pytest.approx(np.hypot(plain.stamp_stddev_s, 0.05))
    assert abs(plain.mid_unix_s - START) < 1.0


def test_the_first_frame_that_can_be_read_tells_of_all_and_is_read_once(stars_file, tmp_path, monkeypatch):
    read = Reader()
    about = read.first((str(tmp_path / "none.fits"), stars_file))
    assert (about.width, about.height, len(about)) == (1000, 700, 0)
    kept = read(stars_file)
    monkeypatch.setattr("starpos.night.reading.read_frame", lambda *_: Frame(np.zeros((2, 2), np.uint8)))
    # once kept, then read anew
    assert kept.width == 1000 and read(stars_file).width == 2
    assert Reader().first(()) is None


def test_a_frame_that_cannot_be_read_is_an_error_of_its_own(tmp_path):
    with pytest.raises(FrameError):
        Reader()(str(tmp_path / "none.fits"))
    assert Reader().first((str(tmp_path / "none.fits"),)) is None


def test_a_table_of_tilts_is_read_again_only_if_it_has_changed(tmp_path):
    path = tmp_path / "tilt.csv"
    rows = [f"{START + k},0.1,0.2" for k in range(3)]
    path.write_text("\n".join(["utc_unix_s,theta_x_deg,theta_y_deg", *rows]) + "\n")
    file = TiltFile(str(path), 1e-5)
    assert file.log is file.log and len(file.log.utc_unix_s) == 3
    path.write_text(path.read_text() + f"{START + 3},0.1,0.2\n")
    assert len(file.log.utc_unix_s) == 4
    assert np.degrees(file.average(START + 1.0, 1.0).theta_x) == pytest.approx(0.1)
    os.remove(path)
    with pytest.raises(TiltError):
        _ = file.log
