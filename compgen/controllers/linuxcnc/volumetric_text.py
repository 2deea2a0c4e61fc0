"""How the numbers of a ``volkins`` table are written, their checksum, and the files that stand beside a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.controllers.linuxcnc.text import MM_PER_UNIT
from compgen.controllers.linuxcnc.volcomp import VolCurve, VolGrid, VolTable
from compgen.core.csvio import FloatArray, fixed
from compgen.core.names import ERROR_INDEX, error_named

#: Decimals of positions and of values in mm, and of angles in rad.
POSITION_DIGITS, LENGTH_DIGITS, ANGLE_DIGITS = 6, 9, 13
#: Decimals in inch: lengths no coarser, and after 400 rounded steps a curve still ends where the travel ends.
_INCH_POSITION_DIGITS, _INCH_LENGTH_DIGITS = 12, 11
#: Name and last line of the licence text that belongs to the sources.
LICENCE, _LICENCE_ENDS = "COPYING", "Public License instead of this License."
#: Suffixes of what else is exported beside the table; each ends with a line that holds ``end of`` and its name.
COMPANIONS = (".ini", ".hal", ".comp", ".h")


def position_digits(table: VolTable) -> int:
    """Return the decimals of positions in the unit of the table's file."""
    return POSITION_DIGITS if table.unit == "mm" else _INCH_POSITION_DIGITS


def length_digits(table: VolTable) -> int:
    """Return the decimals of lengths in the unit of the table's file."""
    return LENGTH_DIGITS if table.unit == "mm" else _INCH_LENGTH_DIGITS


def digits_of(table: VolTable, curve: VolCurve) -> int:
    """Return the decimals of a curve's values: lengths in the unit of the table's file, angles in rad."""
    linear = curve.name in ERROR_INDEX and error_named(curve.name).kind == "linear"
    return length_digits(table) if linear else ANGLE_DIGITS


def in_file_units(table: VolTable) -> VolTable:
    """Return the table with the numbers that its file has: lengths in mm or inch (the fields keep their names)."""
    return table.scaled(1.0 / MM_PER_UNIT[table.unit])


def _rounded(values: FloatArray, digits: int) -> FloatArray:
    flat = [float(fixed(value, digits)) for value in np.ravel(values).tolist()]
    return np.array(flat).reshape(np.shape(values))


def as_written(table: VolTable) -> VolTable:
    """Return the table as it is read back from its text, in mm."""
    inside, places = in_file_units(table), position_digits(table)
    curves = tuple(
        replace(
            curve,
            first_mm=float(fixed(curve.first_mm, places)),
            step_mm=float(fixed(curve.step_mm, places)),
            values=_rounded(curve.values, digits_of(table, curve)),
        )
        for curve in inside.curves
    )
    grid = inside.grid
    if grid is not None:
        x, y, z = (float(fixed(value, places)) for value in grid.first_mm)
        hx, hy, hz = (float(fixed(value, places)) for value in grid.step_mm)
        grid = VolGrid((x, y, z), (hx, hy, hz), _rounded(grid.vertices_mm, length_digits(table)))
    return replace(inside, curves=curves, grid=grid).scaled(MM_PER_UNIT[table.unit])


def words_of(table: VolTable) -> Iterator[str]:
    """Yield the words of the table from ``volcomp`` to ``end``, for its checksum."""
    inside, places = in_file_units(table), position_digits(table)
    yield from ("volcomp", "1", "unit", table.unit)
    for curve in inside.curves:
        yield from ("curve", curve.name, str(curve.axis), str(len(curve.values)))
        yield from (fixed(curve.first_mm, places), fixed(curve.step_mm, places))
        yield from (fixed(value, digits_of(table, curve)) for value in curve.values.tolist())
    for term in inside.terms:
        yield from ("term", str(term.output), term.curve, fixed(term.coefficient, 0), term.lever)
    if inside.grid is not None:
        yield from ("grid", *(str(count) for count in inside.grid.vertices_mm.shape[:3]))
        yield from (fixed(value, places) for value in (*inside.grid.first_mm, *inside.grid.step_mm))
        for row in grid_rows(inside.grid):
            yield from (fixed(value, length_digits(table)) for value in row)
    yield "end"


def grid_rows(grid: VolGrid) -> list[list[float]]:
    """Return ex, ey, ez of every vertex, x fastest."""
    rows: list[list[float]] = grid.vertices_mm.transpose(2, 1, 0, 3).reshape(-1, 3).tolist()
    return rows


def is_companion(source: SourceFile) -> bool:
    """Whether a file is one of those that are exported beside the table, by its name."""
    return source.path.suffix.lower() in COMPANIONS or source.path.name.endswith(LICENCE)


def check_companion(source: SourceFile) -> None:
    """Raise InputError if INI, HAL, C source or licence text does not end with its last line: it was cut."""
    last = source.text.rstrip().rpartition("\n")[2]
    whole = (
        last == _LICENCE_ENDS if source.path.name.endswith(LICENCE) else last.startswith(("# end of ", "// end of "))
    )
    if not whole or not source.text.endswith("\n"):
        raise source.fail(
            "does not end with its last line ('... end of ...'): the file was cut", source.text.count("\n") + 1
        )
