# SPDX-License-Identifier: Apache-2.0
"""Where a calibration may be written."""

import pytest

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Instrument
from starpos_solver.calibration_services import save_instrument

INSTRUMENT = Instrument(1234.0)


def test_the_path_that_is_given_wins_over_calibration_url(tmp_path):
    given, url = tmp_path / "given.yaml", tmp_path / "url.yaml"
    assert save_instrument(str(given), f"file://{url}", INSTRUMENT) == given
    assert instrument_file.read(given).focal_px == 1234.0 and not url.exists()
    assert save_instrument("", f"file://{url}", INSTRUMENT) == url
    assert instrument_file.read(url).focal_px == 1234.0


def test_an_instrument_file_is_replaced_and_nothing_else(tmp_path):
    path = tmp_path / "a.yaml"
    save_instrument(str(path), "", INSTRUMENT)
    save_instrument(str(path), "", Instrument(2000.0))
    assert instrument_file.read(path).focal_px == 2000.0
    path.write_text("a: b")
    with pytest.raises(InstrumentError, match="no instrument file"):
        save_instrument(str(path), "", INSTRUMENT)
    assert path.read_text() == "a: b"


def test_a_comment_in_an_instrument_file_is_not_lost(tmp_path):
    path = tmp_path / "a.yaml"
    save_instrument(str(path), "", INSTRUMENT)
    text = path.read_text() + "# the spare camera\n"
    path.write_text(text)
    with pytest.raises(InstrumentError, match="a comment, which would be lost: move it away"):
        save_instrument(str(path), "", INSTRUMENT)
    assert path.read_text() == text


@pytest.mark.parametrize(
    "path",
    ["", "a.yaml", "./a.yaml", "~nobody-here/a.yaml", "/dev/null", "/dev/null/a", "/" + "x" * 300, "/a\0b"],
)
def test_what_is_no_place_for_it_is_refused(path):
    with pytest.raises(InstrumentError):
        save_instrument(path, "", INSTRUMENT)


def test_a_folder_is_none(tmp_path):
    with pytest.raises(InstrumentError):
        save_instrument(str(tmp_path), "", INSTRUMENT)
