# SPDX-License-Identifier: Apache-2.0
"""SVG drawings, for documents, of the sheets that `kicad` writes for KiCad."""

from xml.sax.saxutils import escape

from kicad import strokes
from sheet import HEIGHT_MM, WIDTH_MM, Placed, Sheet

MARGIN_MM = 8.0
STYLE = """
    text { font-family: "DejaVu Sans", Verdana, sans-serif; font-size: 2px; fill: #222 }
    .title { font-size: 2.6px; font-weight: bold }
    .net { fill: #06508a }
    .number { font-size: 1.5px; fill: #777 }
    .low { text-decoration: overline }
    path { fill: none; stroke: #7a1f1f; stroke-width: 0.25 }
    .open { stroke: #06508a }
"""


def svg(sheet: Sheet) -> str:
    """Write a sheet as an SVG file, cut to what is drawn."""
    board = sheet.board
    lines = []
    for title in sheet.titles:
        lines.append(_text(title.x, title.y, title.text, "title"))
    for placed in sheet.placed:
        lines += _part(placed)
    lines.append(_text(15.24, 12.0, f"{board.title}. Nobody has built this board.", "title"))
    right = min(WIDTH_MM, max(placed.x + placed.part.symbol.width_mm / 2 for placed in sheet.placed) + 22)
    low = min(
        HEIGHT_MM, max(placed.y + placed.part.symbol.height_mm / 2 for placed in sheet.placed) + MARGIN_MM
    )
    view = f"{MARGIN_MM:g} 6 {right - MARGIN_MM:.2f} {low - 6:.2f}"
    return "\n".join(
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{view}" width="{4 * (right - MARGIN_MM):.0f}">',
            f"  <title>{escape(board.title)}</title>",
            f"  <style>{STYLE}  </style>",
            f'  <rect x="0" y="0" width="{WIDTH_MM:g}" height="{HEIGHT_MM:g}" fill="#fff"/>',
            *(f"  {line}" for line in lines),
            "</svg>\n",
        )
    )


def _text(x: float, y: float, text: str, kind: str = "", anchor: str = "start") -> str:
    look = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.2f}" y="{y:.2f}" text-anchor="{anchor}"{look}>{escape(text)}</text>'


def _path(points: list[tuple[float, float]], kind: str = "") -> str:
    look = f' class="{kind}"' if kind else ""
    return f'<path d="M{" L".join(f"{x:.2f} {y:.2f}" for x, y in points)}"{look}/>'


def _part(placed: Placed) -> list[str]:
    part, symbol, x, y = placed.part, placed.part.symbol, placed.x, placed.y
    box = symbol.shape == "box"
    lines = [_path([(x + u, y + v) for u, v in line]) for line in strokes(symbol)]
    above = max(symbol.height_mm / 2, 1.5) + 0.8
    if box:
        lines.append(_text(x, y - above, f"{part.reference}  {part.value}", anchor="middle"))
    else:
        lines.append(_text(x, y - above, part.reference, anchor="middle"))
        lines.append(_text(x, y + above + 1.4, part.value, anchor="middle"))
    for pin in symbol.pins:
        u, v = x + pin.x, y + pin.y
        inside = u + pin.inward * pin.length
        outward = "end" if pin.inward > 0 else "start"
        lines.append(_path([(u, v), (inside, v)]))
        if box:
            inward = "start" if pin.inward > 0 else "end"
            low = "low" if "~" in pin.name else ""
            lines.append(_text(inside + 0.7 * pin.inward, v + 0.7, pin.name.replace("~", ""), low, inward))
            lines.append(_text(inside - 0.3 * pin.inward, v - 0.3, pin.number, "number", outward))
        if net := part.nets.get(pin.number):
            lines.append(_text(u - 0.5 * pin.inward, v + 0.7, net, "net", outward))
        else:
            lines.append(_path([(u - 0.7, v - 0.7), (u + 0.7, v + 0.7)], "open"))
            lines.append(_path([(u - 0.7, v + 0.7), (u + 0.7, v - 0.7)], "open"))
    return lines
