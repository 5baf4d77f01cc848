# SPDX-License-Identifier: Apache-2.0
"""Place of each part of a board on its sheet: groups in columns, large parts in rows of their own, small ones paired."""

from dataclasses import dataclass

from boards import Board, Group, Part
from symbols import GRID

# An A3 sheet (mm).
WIDTH_MM, HEIGHT_MM = 420.0, 297.0
# Left and upper edge of the first column, and the columns' distance, in grid steps.
LEFT, TOP, COLUMN = 6, 8, 31
# Distances in grid steps: from a group's sentence to its first part, between parts, between groups.
AFTER_TITLE, BETWEEN, BETWEEN_GROUPS = 3, 3, 3
# A part lower than this many grid steps shares its row.
LOW = 6


@dataclass(frozen=True)
class Placed:
    """A part and its middle (mm)."""

    part: Part
    x: float
    y: float


@dataclass(frozen=True)
class Title:
    """Sentence of a group and its lower left corner (mm)."""

    text: str
    x: float
    y: float


@dataclass(frozen=True)
class Sheet:
    """A drawn board."""

    board: Board
    placed: tuple[Placed, ...]
    titles: tuple[Title, ...]


def lay_out(board: Board) -> Sheet:
    """Place all parts; ValueError if a column is longer than the sheet."""
    placed: list[Placed] = []
    titles: list[Title] = []
    for number, column in enumerate(board.columns):
        row = TOP
        for group in column:
            titles.append(Title(group.says, (LEFT + COLUMN * number) * GRID, row * GRID))
            row = _place(group, LEFT + COLUMN * number, row + AFTER_TITLE, placed) + BETWEEN_GROUPS
        if row * GRID > HEIGHT_MM - 20:
            raise ValueError(f"{board.name}: column {number + 1} is longer than the sheet.")
    return Sheet(board, tuple(placed), tuple(titles))


def _place(group: Group, left: int, row: int, placed: list[Placed]) -> int:
    """Place a group's parts from a row on, in grid steps; return the first free row."""
    waiting: list[tuple[Part, int]] = []
    for part in sorted(group.parts, key=lambda part: -part.symbol.height_mm):
        height = max(1, round(part.symbol.height_mm / GRID))
        if height < LOW:
            waiting.append((part, height))
        else:
            placed.append(Placed(part, (left + COLUMN // 2 - 1) * GRID, (row + height // 2) * GRID))
            row += height + BETWEEN
    for pair in (waiting[i : i + 2] for i in range(0, len(waiting), 2)):
        tallest = max(height for _, height in pair)
        for (part, _), x in zip(pair, (6, 22), strict=False):
            placed.append(Placed(part, (left + x) * GRID, (row + tallest // 2) * GRID))
        row += tallest + BETWEEN
    return row
