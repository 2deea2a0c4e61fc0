"""Measured positions must lie within the travel of the machine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import InputError


def check_travel(machine: Machine, position_mm: FloatArray, origin: Sequence[tuple[str, int]]) -> None:
    """Raise InputError, with file, line and column, for the first position (n, 3) outside the travel.

    ``origin`` is file and line of each row, or empty.
    """
    columns = [np.ascontiguousarray(column) for column in position_mm.T]
    low, high = np.array([column.min() for column in columns]), np.array([column.max() for column in columns])
    outside = (low < machine.lower_mm - 1e-3) | (high > machine.upper_mm + 1e-3)
    if outside.any():
        axis = int(np.flatnonzero(outside)[0])
        first, last = machine.axes[axis].range_mm
        along = position_mm[:, axis]
        row = int(np.flatnonzero((along < first - 1e-3) | (along > last + 1e-3))[0])
        file, line = origin[row] if origin else (None, None)
        raise InputError(
            f"{along[row]:g} mm lies outside the travel {first:g} ... {last:g} mm of {AXES[axis]} "
            f"of machine {machine.name!r}: wrong machine file, wrong axis order or wrong unit?",
            file=file,
            line=line,
            field=f"column {AXES[axis].lower()}_mm",
        )
