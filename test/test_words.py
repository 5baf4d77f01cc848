# SPDX-License-Identifier: Apache-2.0
"""Breaches of all rules for sentences are found, with their lines; whether the documents keep them, `make lint` sees."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "words.py"
FORTY = " ".join(["word"] * 39)


def found(path: Path, text: str) -> tuple[int, list[str]]:
    """Exit status of the check of a file with this text, and what it printed without the file's name."""
    path.write_text(text)
    done = subprocess.run([sys.executable, TOOL, path], capture_output=True, text=True, check=False)
    assert not done.stderr
    return done.returncode, [line.removeprefix(f"{path}:") for line in done.stdout.splitlines()]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("The number is that\nof the format.", "that of"),
        ("A position that is none.", "is none"),
        ("A light that is higher tells no more.", "tells"),
        ("Errors beside their own.", "beside"),
        ("| at once | so many frames |", "so many"),
        ("- of each row its time", "of each ... its"),
        ("What a linear error makes of the circles that are wide.", "what ... that"),
        ("It is no want of stars.", "want of"),
        ("# What nobody knows", "nobody"),
        ("The center of the frame.", "spelling"),
        ("An optimized fit.", "spelling"),
        (f"It has {FORTY}.", "long"),
    ],
)
def test_a_breach_is_found_on_its_line(tmp_path, text, kind):
    status, lines = found(tmp_path / "page.md", f"# A page\n\nIt is clean.\n\n{text}\n")
    assert status == 1
    assert [said.split(":")[:2] for said in lines] == [["5", f" {kind}"]]


@pytest.mark.parametrize(
    "text",
    [
        "Run `starpos tells beside`, which prints so\nmuch.",
        "    starpos solve night   # it tells so many",
        "```\nwhat it tells that\n```",
        "<!-- table -->\n| beside |\n<!-- end of table -->",
        f"One {FORTY}. Two {FORTY}.",
        "[A link](beside/center.md) to robot_localization and its size.",
    ],
)
def test_what_is_quoted_or_generated_passes(tmp_path, text):
    assert found(tmp_path / "page.md", f"# A page\n\n{text}\n") == (0, [])


def test_comments_of_a_message_are_read_and_its_fields_are_not(tmp_path):
    text = "# Frame: that\n# of the fix.\nfloat64 beside  # how wide\n# Clean.\n"
    assert found(tmp_path / "New.msg", text) == (1, ["1: that of: that of (repeat the noun)"])


def test_docstrings_and_comments_of_code_are_read_and_its_strings_are_not(tmp_path):
    text = '"""Clean.\n\nIt tells."""\n\nname = "beside"\n# Errors of so\n# many stars.\n'
    assert found(tmp_path / "new.py", text) == (
        1,
        [
            "1: tells: tells (determines, gives, says or shows)",
            "6: so many: so many (give the number or name the quantity)",
        ],
    )


def test_a_long_sentence_in_an_indented_docstring_is_found(tmp_path):
    lines = "\n".join(f"    {'word ' * 14}" for _ in range(3))
    text = f'def f():\n    """Clean.\n\n{lines}.\n    """\n'
    status, [line] = found(tmp_path / "new.py", text)
    assert status == 1 and line.startswith("2: long: 42 words")
