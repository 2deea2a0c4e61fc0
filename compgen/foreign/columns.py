"""The first rows of a table and what its columns seem to be, for a person who says which column is what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from compgen.errors import InputError
from compgen.foreign.cells import CellGrid, find_table
from compgen.foreign.column_names import FIELDS, error_columns, split_name
from compgen.foreign.source import parse_number

#: Rows and columns of a preview.
SHOWN_ROWS, SHOWN_COLUMNS = 6, 24


@dataclass(frozen=True)
class Preview:
    """Header and first rows of a table, with their line numbers."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]


def preview_of(grid: CellGrid) -> Preview | None:
    """Return the header and the first rows of numbers of a grid; None where nothing looks like a table.

    >>> from pathlib import Path
    >>> rows = [["Laser"], ["Ort", "Wert"], ["0", "1.5"], ["100", "2"]]
    >>> preview_of(CellGrid(Path("a.csv"), rows, [1, 2, 3, 4])).header
    ('Ort', 'Wert')
    """
    try:
        table = find_table(grid)
    except InputError:
        return _roughly(grid)
    return Preview(
        table.header[:SHOWN_COLUMNS], [row[:SHOWN_COLUMNS] for row in table.rows[:SHOWN_ROWS]], table.lines[:SHOWN_ROWS]
    )


def _roughly(grid: CellGrid) -> Preview | None:
    """Return the row of names above the first two rows of numbers."""
    for k, row in enumerate(grid.rows[:-1]):
        numbers = [sum(parse_number(cell) is not None for cell in other) for other in grid.rows[k : k + 2]]
        filled = [cell for cell in row if cell]
        if numbers[0] == 0 and numbers[1] and len(filled) > 1:
            end = k + 1 + SHOWN_ROWS
            return Preview(
                tuple(row[:SHOWN_COLUMNS]), [r[:SHOWN_COLUMNS] for r in grid.rows[k + 1 : end]], grid.lines[k + 1 : end]
            )
    return None


def guessed_field(name: str) -> str:
    """Return the field that the name of a column says, "" for none.

    >>> guessed_field("Sollposition [mm]"), guessed_field("EYX [um]"), guessed_field("Foo")
    ('position', 'EYX', '')
    """
    exact = error_columns([name])
    if exact:
        return next(iter(exact))
    word = split_name(name).word
    return next((field for field, words in FIELDS.items() if word in words), "")
