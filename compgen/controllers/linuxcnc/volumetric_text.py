"""How the numbers of a ``volkins`` table are written, their checksum, and the files that stand beside a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.controllers.linuxcnc.volcomp import VolCurve, VolGrid, VolTable
from compgen.core.csvio import FloatArray, fixed
from compgen.core.names import ERROR_INDEX, error_named

POSITION_DIGITS, LENGTH_DIGITS, ANGLE_DIGITS = 6, 9, 13
#: Suffixes of what is exported beside the table; each ends with a line that holds ``end of`` and its name.
COMPANIONS = (".ini", ".hal", ".comp", ".h")


def digits_of(curve: VolCurve) -> int:
    """Return the decimals of a curve's values: lengths in mm, angles in rad."""
    linear = curve.name in ERROR_INDEX and error_named(curve.name).kind == "linear"
    return LENGTH_DIGITS if linear else ANGLE_DIGITS


def _rounded(values: FloatArray, digits: int) -> FloatArray:
    flat = [float(fixed(value, digits)) for value in np.ravel(values).tolist()]
    return np.array(flat).reshape(np.shape(values))


def _position(value: float) -> float:
    return float(fixed(value, POSITION_DIGITS))


def as_written(table: VolTable) -> VolTable:
    """Return the table as it is read back from its text."""
    curves = tuple(
        replace(
            curve,
            first_mm=_position(curve.first_mm),
            step_mm=_position(curve.step_mm),
            values=_rounded(curve.values, digits_of(curve)),
        )
        for curve in table.curves
    )
    return replace(table, curves=curves, grid=None if table.grid is None else _grid_as_written(table.grid))


def _grid_as_written(grid: VolGrid) -> VolGrid:
    x, y, z = (_position(value) for value in grid.first_mm)
    hx, hy, hz = (_position(value) for value in grid.step_mm)
    return VolGrid((x, y, z), (hx, hy, hz), _rounded(grid.vertices_mm, LENGTH_DIGITS))


def words_of(table: VolTable) -> Iterator[str]:
    """Yield the words of the table from ``volcomp`` to ``end``, for its checksum."""
    yield from ("volcomp", "1")
    for curve in table.curves:
        yield from ("curve", curve.name, str(curve.axis), str(len(curve.values)))
        yield from (fixed(curve.first_mm, POSITION_DIGITS), fixed(curve.step_mm, POSITION_DIGITS))
        yield from (fixed(value, digits_of(curve)) for value in curve.values.tolist())
    for term in table.terms:
        yield from ("term", str(term.output), term.curve, fixed(term.coefficient, 0), term.lever)
    if table.grid is not None:
        yield from ("grid", *(str(count) for count in table.grid.vertices_mm.shape[:3]))
        yield from (fixed(value, POSITION_DIGITS) for value in (*table.grid.first_mm, *table.grid.step_mm))
        for row in grid_rows(table.grid):
            yield from (fixed(value, LENGTH_DIGITS) for value in row)
    yield "end"


def grid_rows(grid: VolGrid) -> list[list[float]]:
    """Return ex, ey, ez of every vertex, x fastest."""
    rows: list[list[float]] = grid.vertices_mm.transpose(2, 1, 0, 3).reshape(-1, 3).tolist()
    return rows


def is_companion(source: SourceFile) -> bool:
    """Whether a file is one of those that are exported beside the table, by its suffix."""
    return source.path.suffix.lower() in COMPANIONS


def check_companion(source: SourceFile) -> None:
    """Raise InputError if INI, HAL or C source does not end with its last line: it was cut."""
    last = source.text.rstrip().rpartition("\n")[2]
    if not last.startswith(("# end of ", "// end of ")) or not source.text.endswith("\n"):
        raise source.fail("does not end with its line '... end of ...': the file was cut", source.text.count("\n") + 1)
