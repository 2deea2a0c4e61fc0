"""Compensation tables of PMAC and Turbo PMAC as the control keeps them: whole 1/16 counts that roll over.

Source: PMAC User Manual p. 79-83, PMAC 2 Software Reference p. 207-211, Turbo PMAC Software Reference p. 301-306.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray

IntArray = NDArray[np.int64]

#: Entries are 1/16 count.
PER_COUNT = 16.0


@dataclass(frozen=True)
class Line:
    """``DEFINE COMP entries,#source,#target,length``: the table of motor ``motor``.

    ``entries`` (n,): the first stands at one spacing (length / n) from the source's zero, where the value is 0 by
    definition; the last stands at ``length``. ``desired``: over the commanded position of the source.
    """

    motor: int
    source: int
    target: int
    length: int
    entries: IntArray
    desired: bool = True

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Interpolated value in 1/16 count for positions of the motors in counts, each (n,)."""
        return rolled(counts[self.source], self.length, self.entries)


@dataclass(frozen=True)
class Sheet:
    """``DEFINE COMP rows.columns,#row,#column,#target,row span,column span``: the table of motor ``motor``.

    ``values`` (rows + 1, columns + 1): row i along the column motor, column j along the row motor, [0, 0] is 0.
    """

    motor: int
    row: int
    column: int
    target: int
    row_span: int
    column_span: int
    values: IntArray
    row_desired: bool = True
    column_desired: bool = True

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Bilinear value in 1/16 count for positions of the motors in counts, each (n,)."""
        rows, columns = (size - 1 for size in self.values.shape)
        j, u = _cell(counts[self.row], self.row_span, columns)
        i, v = _cell(counts[self.column], self.column_span, rows)
        low = (1.0 - u) * self.values[i, j] + u * self.values[i, j + 1]
        high = (1.0 - u) * self.values[i + 1, j] + u * self.values[i + 1, j + 1]
        return np.asarray((1.0 - v) * low + v * high)


@dataclass(frozen=True)
class Backlash:
    """``DEFINE BLCOMP entries,length`` of motor ``motor``: taken off after negative travel only, beside Ixx86."""

    motor: int
    length: int
    entries: IntArray

    def at(self, counts: Mapping[int, FloatArray]) -> FloatArray:
        """Interpolated value in 1/16 count, shape (n,)."""
        return rolled(counts[self.motor], self.length, self.entries)


def _cell(counts: FloatArray, span: int, cells: int) -> tuple[np.ndarray, FloatArray]:
    """Cell and share within it of positions (n,) that are rolled over into 0 ... span."""
    ratio = np.mod(counts, span) * (cells / span)
    cell = np.minimum(ratio.astype(np.intp), cells - 1)
    return cell, ratio - cell


def rolled(counts: FloatArray, length: int, entries: IntArray) -> FloatArray:
    """Interpolate entries (n,) that begin one spacing above zero, at positions in counts that roll over.

    >>> rolled(np.array([250.0, -250.0]), 4000, np.array([160, 80, 0, -80, -160, -80, 80, 0])) / 16
    array([5. , 2.5])
    """
    values = np.concatenate([[0.0], entries])
    cell, share = _cell(np.asarray(counts, dtype=np.float64), length, len(entries))
    return np.asarray((1.0 - share) * values[cell] + share * values[cell + 1])


@dataclass(frozen=True)
class PmacTables:
    """What the control has: tables in the order of the file, Ixx86 by motor in 1/16 count, I51 (None: no file says)."""

    tables: tuple[Line | Sheet, ...]
    backlash: tuple[Backlash, ...] = ()
    constants: Mapping[int, int] = field(default_factory=dict)
    enabled: bool | None = True
