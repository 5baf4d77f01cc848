# SPDX-License-Identifier: Apache-2.0
"""The catalogue of messages has what commands and nodes say."""

import re
from pathlib import Path

import pytest

from starpos.session.driver import Level
from starpos.session.reports import of_clock
from starpos_testing.command_line import run

ROOT = Path(__file__).parents[1]
ROW = re.compile(r"\| `` (.+?) `` \| (?:`` (.+) ``)? \|")


@pytest.fixture(scope="module")
def entries() -> list[re.Pattern]:
    """The messages of the catalogue as expressions, in which anything stands for the values."""
    page = ROOT / "docs" / "reference" / "troubleshooting.md"
    rows = [ROW.fullmatch(line) for line in page.read_text().splitlines() if line.startswith("| ``")]
    assert len(rows) > 500 and all(rows)
    parts = [[re.escape(part.replace("\\|", "|")) for part in row.groups() if part] for row in rows]
    return [re.compile("(?:: |; )".join(both).replace("…", ".*")) for both in parts]


def test_an_error_of_a_command_is_in_the_catalogue(entries, capsys, tmp_path):
    status, _, [error] = run(capsys, "solve", tmp_path / "a.fits", "--tilt", tmp_path / "none.csv")
    assert status == 2
    assert any(entry.search(error) for entry in entries), error


@pytest.mark.parametrize("about", [(0.01, 0.0, 3.5), (0.01, 0.0, 0.0, 12.0), (2.0, 0.0, 0.0)])
def test_a_diagnostic_of_a_node_is_in_the_catalogue(entries, about):
    said = of_clock(*about, *[0.0] * (4 - len(about)))
    assert said.level is Level.WARN
    assert any(entry.fullmatch(said.message) for entry in entries), said.message


def test_advice_that_messages_share_is_filled_in(entries):
    assert any("set the clocks of camera" in entry.pattern.replace("\\", "") for entry in entries)
