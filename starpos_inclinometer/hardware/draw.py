# SPDX-License-Identifier: Apache-2.0
"""Draw the boards: KiCad's schematics and projects, bills of materials, SVG. `python draw.py` writes every file again."""

import csv
import io
from pathlib import Path

from boards import BOARDS, Board
from drawing import svg
from kicad import project, schematic
from sheet import lay_out

HERE = Path(__file__).resolve().parent
IMAGES = HERE.parents[1] / "docs" / "images"


def bill_of_materials(board: Board) -> str:
    """List a board's parts as CSV, equal ones in one row."""
    equal: dict[tuple[str, str, str], list[str]] = {}
    for part in board.parts():
        equal.setdefault((part.value, part.manufacturer, part.number), []).append(part.reference)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("quantity", "references", "value", "manufacturer", "manufacturer_part_number"))
    for (value, manufacturer, number), references in equal.items():
        writer.writerow((len(references), " ".join(references), value, manufacturer, number))
    return text.getvalue()


def files() -> dict[Path, str]:
    """Make the content of all files that are drawn."""
    made = {}
    for board in BOARDS:
        sheet = lay_out(board)
        made[HERE / f"{board.name}.kicad_sch"] = schematic(sheet)
        made[HERE / f"{board.name}.kicad_pro"] = project(sheet)
        made[HERE / f"{board.name}_parts.csv"] = bill_of_materials(board)
        made[IMAGES / f"board_{board.name}.svg"] = svg(sheet)
    return made


if __name__ == "__main__":
    for path, text in files().items():
        path.write_text(text, encoding="utf-8")
        print(path.name)
