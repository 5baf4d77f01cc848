# SPDX-License-Identifier: Apache-2.0
"""Schematics in the format of KiCad 6 (version 20211123), with their symbols inside: a label at each pin makes the nets.

The format is described at https://dev-docs.kicad.org/en/file-formats/sexpr-schematic/. Identifiers are derived
from the names, so that the same board always makes the same file.
"""

import json
from uuid import NAMESPACE_URL, UUID, uuid5

from boards import Part
from sheet import Placed, Sheet
from symbols import GRID, POWER_FLAG, Pin, Symbol

VERSION = 20211123
FONT = "(effects (font (size 1.27 1.27)))"
HIDDEN = "(effects (font (size 1.27 1.27)) hide)"
LINE = "(stroke (width 0.254) (type default) (color 0 0 0 0))"
FILL = "(fill (type none))"


def schematic(sheet: Sheet) -> str:
    """Write a sheet as the text of a .kicad_sch."""
    board = sheet.board
    root = uuid5(NAMESPACE_URL, f"starpos/{board.name}")
    flags = [
        Placed(Part(f"#FLG{i}", POWER_FLAG, "PWR_FLAG", "", "", {"1": net}), (10 + 12 * i) * GRID, 108 * GRID)
        for i, net in enumerate(board.powered, 1)
    ]
    placed = (*sheet.placed, *flags)
    symbols = {part.part.symbol.name: part.part.symbol for part in placed}
    lines = [
        f"(kicad_sch (version {VERSION}) (generator starpos)",
        f"  (uuid {root})",
        '  (paper "A3")',
        f'  (title_block (title "{board.title}") (comment 1 "Nobody has built this board."))',
        "  (lib_symbols",
        *(_symbol(symbol) for symbol in symbols.values()),
        "  )",
        *(
            f'  (text "{title.text}" (at {_mm(title.x)} {_mm(title.y)} 0) '
            f"(effects (font (size 1.8 1.8) bold) (justify left bottom)) (uuid {uuid5(root, title.text)}))"
            for title in sheet.titles
        ),
        *(_end(root, each, pin) for each in placed for pin in each.part.symbol.pins),
        *(_instance(root, each) for each in placed),
        '  (sheet_instances (path "/" (page "1")))',
        "  (symbol_instances",
        *(
            f'    (path "/{_uuid(root, each.part)}" (reference "{each.part.reference}") (unit 1) '
            f'(value "{each.part.value}") (footprint ""))'
            for each in placed
        ),
        "  )",
        ")",
    ]
    return "\n".join(lines) + "\n"


def project(sheet: Sheet) -> str:
    """Write the .kicad_pro. The symbols are in the schematic and in no library, which is no fault."""
    content = {
        "meta": {"filename": f"{sheet.board.name}.kicad_pro", "version": 1},
        "erc": {"meta": {"version": 0}, "rule_severities": {"lib_symbol_issues": "ignore"}},
        "schematic": {"meta": {"version": 1}},
    }
    return json.dumps(content, indent=2) + "\n"


def _mm(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _uuid(root: UUID, part: Part) -> UUID:
    return uuid5(root, part.reference)


def _symbol(symbol: Symbol) -> str:
    hidden = "" if symbol.shape == "box" else " (pin_numbers hide)"
    names = " (pin_names (offset 0.762))" if symbol.shape == "box" else " (pin_names (offset 0) hide)"
    power = " (power)" if symbol is POWER_FLAG else ""
    return "\n".join(
        (
            f'    (symbol "starpos:{symbol.name}"{power}{hidden}{names} (in_bom yes) (on_board yes)',
            f'      (property "Reference" "{symbol.prefix}" (id 0) (at 0 {_mm(symbol.height_mm)} 0) {FONT})',
            f'      (property "Value" "{symbol.name}" (id 1) (at 0 {_mm(-symbol.height_mm)} 0) {FONT})',
            f'      (property "Footprint" "" (id 2) (at 0 0 0) {HIDDEN})',
            f'      (property "Datasheet" "" (id 3) (at 0 0 0) {HIDDEN})',
            f'      (symbol "{symbol.name}_0_1"',
            *(f"        {line}" for line in _body(symbol)),
            "      )",
            f'      (symbol "{symbol.name}_1_1"',
            *(_pin(pin) for pin in symbol.pins),
            "      )",
            "    )",
        )
    )


def strokes(symbol: Symbol) -> list[list[tuple[float, float]]]:
    """Lines of a symbol's body (mm from its middle, y down)."""
    w, h = symbol.width_mm / 2, symbol.height_mm / 2
    box = [(-w, -h), (w, -h), (w, h), (-w, h), (-w, -h)]
    wires = [[(-w, 0.0), (-0.6, 0.0)], [(0.6, 0.0), (w, 0.0)]]
    plates = [[(-0.6, -1.5), (-0.6, 1.5)], [(0.6, -1.5), (0.6, 1.5)]]
    if symbol.shape == "capacitor":
        return [*wires, *plates]
    if symbol.shape == "crystal":
        return [
            [(-w, 0.0), (-1.3, 0.0)],
            [(1.3, 0.0), (w, 0.0)],
            [(-1.3, -1.2), (-1.3, 1.2)],
            [(1.3, -1.2), (1.3, 1.2)],
            [(-0.7, -1.5), (0.7, -1.5), (0.7, 1.5), (-0.7, 1.5), (-0.7, -1.5)],
        ]
    if symbol.shape == "diode":
        return [
            [(-w, 0.0), (w, 0.0)],
            [(-1.2, -1.2), (-1.2, 1.2)],
            [(1.2, -1.2), (1.2, 1.2), (-1.2, 0.0), (1.2, -1.2)],
        ]
    if symbol.shape == "flag":
        return [[(0.0, 0.0), (0.0, -1.3), (-1.0, -2.0), (0.0, -2.7), (1.0, -2.0), (0.0, -1.3)]]
    return [box]


def _body(symbol: Symbol) -> list[str]:
    return [
        f"(polyline (pts {' '.join(f'(xy {_mm(x)} {_mm(-y)})' for x, y in line)}) {LINE} {FILL})"
        for line in strokes(symbol)
    ]


def _pin(pin: Pin) -> str:
    angle = 0 if pin.inward > 0 else 180
    if not pin.length:
        angle = 90
    return (
        f"        (pin {pin.kind} line (at {_mm(pin.x)} {_mm(-pin.y)} {angle}) (length {_mm(pin.length)}) "
        f'(name "{_overbar(pin.name)}" {FONT}) (number "{pin.number}" {FONT}))'
    )


def _overbar(name: str) -> str:
    """Write a name that is active low, `~CS`, as KiCad 6 does."""
    head, bar, tail = name.partition("~")
    return f"{head}~{{{tail}}}" if bar else name


def _end(root: UUID, placed: Placed, pin: Pin) -> str:
    x, y = placed.x + pin.x, placed.y + pin.y
    identity = uuid5(root, f"{placed.part.reference}/{pin.number}/end")
    net = placed.part.nets.get(pin.number)
    if net is None:
        return f"  (no_connect (at {_mm(x)} {_mm(y)}) (uuid {identity}))"
    angle, side = (180, "right") if pin.inward > 0 else (0, "left")
    return (
        f'  (label "{net}" (at {_mm(x)} {_mm(y)} {angle}) '
        f"(effects (font (size 1.27 1.27)) (justify {side} bottom)) (uuid {identity}))"
    )


def _instance(root: UUID, placed: Placed) -> str:
    part, x, y = placed.part, placed.x, placed.y
    above, below = _texts_mm(part.symbol)
    flag = part.symbol is POWER_FLAG
    hide = HIDDEN if flag else FONT
    in_bom = "no" if flag else "yes"
    fields = (
        ("Reference", part.reference, y - above, hide),
        ("Value", part.value, y - above if flag else y + below, FONT),
        ("Footprint", "", y, HIDDEN),
        ("Datasheet", "", y, HIDDEN),
        ("Manufacturer", part.manufacturer, y, HIDDEN),
        ("MPN", part.number, y, HIDDEN),
    )
    return "\n".join(
        (
            f'  (symbol (lib_id "starpos:{part.symbol.name}") (at {_mm(x)} {_mm(y)} 0) (unit 1) '
            f"(in_bom {in_bom}) (on_board yes)",
            f"    (uuid {_uuid(root, part)})",
            *(
                f'    (property "{name}" "{text}" (id {i}) (at {_mm(x)} {_mm(at)} 0) {effects})'
                for i, (name, text, at, effects) in enumerate(fields)
            ),
            *(
                f'    (pin "{pin.number}" (uuid {uuid5(root, f"{part.reference}/{pin.number}")}))'
                for pin in part.symbol.pins
            ),
            "  )",
        )
    )


def _texts_mm(symbol: Symbol) -> tuple[float, float]:
    """Distance of the reference above, and of the value below, a symbol's middle."""
    half = max(symbol.height_mm / 2, 1.5)
    return half + 1.4, half + 1.6
