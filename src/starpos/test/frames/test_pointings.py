# SPDX-License-Identifier: Apache-2.0
"""Tables of pointings: what is read from them, and what is refused in a sentence."""

import os

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.tables import MAX_CSV_BYTES, read_pointings
from starpos.units import ARCSEC

FULL = "utc_unix_s,ra_deg,dec_deg,roll_deg,sigma_arcsec,sigma_roll_arcsec\n"
ROW = "1793642400.25,13.83,44.29,241.9,1.5,20\n"


def table(folder, text):
    path = folder / "table.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_row_is_a_pointing_with_its_line(tmp_path):
    path = table(tmp_path, FULL + ROW + "\n1793642401.25,-350,-90,,2,\n")
    first, second = read_pointings(path)
    assert (first.mid_unix_s, first.exposure_s, first.source) == (1793642400.25, None, f"{path}:2")
    np.testing.assert_allclose(np.degrees([first.ra, first.dec, first.roll]), [13.83, 44.29, 241.9])
    np.testing.assert_allclose(np.array([first.sigma, first.sigma_roll]) / ARCSEC, [1.5, 20])
    assert first.has_roll and not second.has_roll
    assert second.source == f"{path}:4" and np.degrees(second.dec) == -90


@pytest.mark.parametrize(
    "text",
    [
        "utc_unix_s,ra_deg,dec_deg,sigma_arcsec\n1,2,3,4\n",
        "# UTC_unix_s , ra_deg,dec_deg,sigma_arcsec,field,exposure_s\r\n1,2,3,4,M 31,0.5\r\n",
        "\ufeffutc_unix_s,ra_deg,dec_deg,roll_deg,sigma_arcsec,sigma_roll_arcsec\n1,2,3, ,4,\n",
    ],
    ids=["no roll", "other columns", "byte order mark"],
)
def test_other_tables_that_can_be_read(text, tmp_path):
    (p,) = read_pointings(table(tmp_path, text))
    assert (p.mid_unix_s, p.has_roll) == (1, False)


REFUSED = {
    "nothing": ("", "no column utc_unix_s"),
    "no row": (FULL, "has no rows"),
    "other names": ("utc,ra,dec,sigma\n1,2,3,4\n", "no column utc_unix_s"),
    "a name twice": (FULL.strip() + ",ra_deg\n" + ROW.strip() + ",3\n", "no column ra_deg, or two"),
    "a short row": (FULL + "1,2,3\n", "table.csv:2: the row has not as many cells"),
    "a long row": (FULL + ROW.strip() + ",7\n", "the row has not as many cells"),
    "words": (FULL + ROW.replace("44.29", "north"), "table.csv:2: dec_deg is 'north', which is no number"),
    "nan": (FULL + ROW.replace("13.83", "nan"), "ra_deg is empty: give a number from -360 to 360"),
    "infinity": (FULL + ROW.replace("1793642400.25", "inf"), "utc_unix_s is inf"),
    "beyond the pole": (FULL + ROW.replace("44.29", "91"), "dec_deg is 91"),
    "no error": (FULL + ROW.replace("1.5", "0"), "sigma_arcsec is 0"),
    "a negative error": (FULL + ROW.replace(",20", ",-20"), "sigma_roll_arcsec is -20"),
    "an error of degrees": (FULL + ROW.replace("1.5", "36000"), "from 0.0001 to 3600"),
    "half a roll": (FULL + ROW.replace("241.9", ""), "belong together"),
    "no time": (FULL + ROW.replace("1793642400.25", ""), "utc_unix_s is empty"),
    "a cell of megabytes": (FULL + ROW.replace("44.29", "4" * 1_000_000), "no"),
    "no text": (b"\xff\xfe\x00\x01", "not a text file"),
    "a NUL": (FULL.encode() + b"1,2,3,\x00,5,6\n", "roll_deg is"),
    "too large": (b"1" * (MAX_CSV_BYTES + 1), "not a readable table"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_a_table_that_is_none_is_refused_in_a_sentence(kind, tmp_path):
    text, words = REFUSED[kind]
    with pytest.raises(FrameError, match=words.replace("(", r"\(")) as refused:
        read_pointings(table(tmp_path, text))
    assert len(str(refused.value)) < 500 and "\n" not in str(refused.value)


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, tmp_path / "none.csv", "/dev/zero", "a\0b"):
        with pytest.raises(FrameError, match=r"no such file|not a readable table of pointings"):
            read_pointings(path)
