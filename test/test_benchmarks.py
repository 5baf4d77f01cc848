# SPDX-License-Identifier: Apache-2.0
"""The benchmarks' own arithmetic: rows, ratios, counts; that a peer which is not here only costs its rows."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "tools" / "benchmarks"


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))


def test_a_row_has_the_ratio_of_the_two_times():
    from table import Cost, Row

    assert str(Row("x", Cost(0.5, "99 %"), "sep", Cost(2.0))) == "| x | 0.50 ms; 99 % | sep | 2.0 ms | 0.25 |"
    assert str(Row("x", Cost(1500.0))) == "| x | 1.5 s |  |  |  |"


def test_a_peer_that_took_no_time_gives_no_ratio():
    from table import Cost, Row

    assert Row("x", Cost(1.0), "sep", Cost(0.0)).ratio is None


@pytest.mark.parametrize(
    ("ms", "text"), [(0.055, "55 us"), (0.17, "0.17 ms"), (381.4, "381 ms"), (0.0, "0 us"), (12345, "12 s")]
)
def test_a_time_is_in_a_unit_that_fits(ms, text):
    from table import time_text

    assert time_text(ms) == text


def test_works_are_done_by_turns_and_the_first_time_does_not_count(monkeypatch):
    import table

    done = []
    monkeypatch.setattr(table, "spent_ms", lambda work: work() or float(len(done)))
    works = {"a": lambda: done.append("a"), "b": lambda: done.append("b")}
    assert table.by_turns(works, 3) == {"a": 5.0, "b": 6.0} and "".join(done) == "abababab"


def test_a_document_gets_another_table_and_keeps_the_rest():
    from table import replaced

    document = "# A\n<!-- table -->\n| old |\n<!-- end of table -->\nB\n"
    assert replaced(document, "| new |") == document.replace("old", "new")
    with pytest.raises(SystemExit, match="no place for a table"):
        replaced("# A\n", "| new |")


def test_what_is_not_installed_is_named_with_how_to_get_it(monkeypatch):
    import peers

    monkeypatch.setattr(peers, "is_here", lambda name: name == "sep")
    line = peers.how_to_get(Path("beside"))
    assert "photutils" in line and "--target beside" in line and "sep" not in line
    monkeypatch.setattr(peers, "is_here", lambda name: True)
    assert peers.how_to_get(Path("beside")) == ""


def test_a_group_that_cannot_be_imported_is_skipped_with_a_line(monkeypatch, capsys):
    import bench
    from table import Cost, Row

    row = Row("x", Cost(1.0))
    monkeypatch.setattr(bench, "GROUPS", {"gone": "no_such_benchmark", "there": "there"})
    monkeypatch.setitem(bench.sys.modules, "there", SimpleNamespace(rows=lambda options: [row]))
    assert list(bench.rows(["gone", "there"], None)) == [row]
    assert "gone: skipped" in capsys.readouterr().err


def test_places_are_judged_by_the_brighter_half_of_the_stars():
    from benchmark_detection import off_px

    place = np.array([[10.0, 10.0], [50.0, 50.0], [90.0, 90.0]])
    assert off_px(place[:2] + np.array([0.3, 0.4]), place) == pytest.approx(0.5)
    assert np.isnan(off_px(np.empty((0, 2)), place)) and np.isnan(off_px(place[2:], place))


def test_the_instructions_of_all_parts_are_added(tmp_path):
    from instructions import total

    part = tmp_path / "count.1"
    part.write_text("events: Ir\nfn=(1)\n0 5\n\ntotals: 1200\n\npart: 2\ntotals: 34\n")
    assert total(part) == 1234


def test_an_estimate_is_instructions_over_rate_and_clock(monkeypatch):
    import instructions

    board = instructions.Board("a board", (0.5, 1.0, 2.0), 2.0)
    assert board.ms(4e9) == (1000.0, 2000.0, 4000.0)
    monkeypatch.setattr(instructions, "BOARDS", (board,))
    *_, row = instructions.table([("x", 4e6, 0.5)])
    assert row == "| x | 4.00 | 0.50 ms | 2.0 ms (1.0 ms to 4.0 ms) |"


def test_a_node_costs_its_detection_and_what_it_does_with_each_pixel(monkeypatch):
    import instructions

    monkeypatch.setattr(instructions, "FRAMES", {"small": ((1000, 500), 3)})
    monkeypatch.setattr(instructions, "NODES", {"seeing": (True, 10), "sending": (False, 50)})
    assert list(instructions.of_nodes({"small": 1e8})) == [
        ("seeing, small", 1.05e8, None),
        ("sending, small", 0.25e8, None),
    ]
