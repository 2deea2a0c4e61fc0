"""Reversal of each axis over its position: ``*.reversal.csv``, what a control needs beside the two-way mean errors.

The reversal value B is that of ISO 230-2: the position reached moving in positive direction minus the one reached moving
in negative direction. The error curves are the means of both, so the tool stands at +B/2 after positive travel and at
-B/2 after negative travel, beside what the curves say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compgen.core.csvio import CsvTable, FloatArray, format_csv, read_csv
from compgen.core.error_table import Curve
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError

#: A reversal beyond this is taken for a slip of unit, um.
LARGEST_UM = 1000.0
#: A reversal whose largest value stays below this is not worth a table, mm.
WORTH_MM = 0.1 * MM_PER_UM


@dataclass(frozen=True)
class ReversalCurves:
    """Reversal values in mm by (axis that travels, component of the tip's displacement), both 0..2.

    A curve with one position is constant over the travel. What is absent is zero.
    """

    curves: Mapping[tuple[int, int], Curve]
    metadata: Mapping[str, str] = field(default_factory=dict)

    def displacement(self, position_mm: FloatArray, approach: FloatArray) -> FloatArray:
        """Displacement of the tip against the mean of both directions, shape (n, 3), mm.

        Parameters
        ----------
        position_mm : commanded positions, shape (n, 3).
        approach : last direction of travel of each axis, shape (n, 3): +1, -1, or 0 (unknown: the mean).
        """
        moved = np.zeros((len(position_mm), 3))
        for (axis, component), curve in self.curves.items():
            moved[:, component] += 0.5 * np.sign(approach[:, axis]) * curve.at(position_mm[:, axis])
        return moved

    def mean_mm(self, axis: int) -> float:
        """Mean over its positions of an axis' reversal along itself, 0 if there is none."""
        curve = self.curves.get((axis, axis))
        return 0.0 if curve is None else float(np.mean(curve.value))

    def without(self, other: ReversalCurves) -> ReversalCurves:
        """Return the curves that are not in ``other``."""
        return ReversalCurves({key: curve for key, curve in self.curves.items() if key not in other.curves})

    @property
    def largest_mm(self) -> dict[tuple[int, int], float]:
        """Largest reversal in size of each curve, with its sign."""
        return {key: float(curve.value[np.argmax(np.abs(curve.value))]) for key, curve in self.curves.items()}


def reversal_name(axis: int, component: int) -> str:
    """Name in messages, e.g. ``reversal X`` or ``reversal X in y`` for the displacement across.

    >>> reversal_name(0, 0), reversal_name(0, 1)
    ('reversal X', 'reversal X in Y')
    """
    return f"reversal {AXES[axis]}" + ("" if axis == component else f" in {AXES[component]}")


def read_reversal(path: str | Path) -> ReversalCurves:
    """Read a ``*.reversal.csv`` file (um) into :class:`ReversalCurves` (mm).

    Columns ``axis``, ``position_mm`` (empty: constant over the travel), ``value_um``; optional ``u_value_um`` and
    ``component`` (X, Y, Z; default the axis itself).
    """
    table = read_csv(path, ("axis", "position_mm", "value_um"), ("u_value_um", "component"))
    axes = _letters(table, "axis")
    components = _letters(table, "component") if "component" in table.columns else axes
    position_mm = table.numbers("position_mm", empty=np.nan)
    value_um = table.numbers("value_um")
    known = "u_value_um" in table.columns
    u_um = table.numbers("u_value_um", empty=np.nan) if known else np.full(len(table), np.nan)
    for row in np.flatnonzero(np.abs(value_um) > LARGEST_UM)[:1].tolist():
        message = f"{value_um[row]:g} um is no reversal of a machine tool; values are in um, at most {LARGEST_UM:g}"
        raise table.fail(row, "value_um", message)
    for row in np.flatnonzero(u_um < 0)[:1].tolist():
        raise table.fail(row, "u_value_um", f"{u_um[row]:g} is negative; a standard uncertainty is not")
    rows_of: dict[tuple[int, int], list[int]] = {}
    for row, key in enumerate(zip(axes, components, strict=True)):
        rows_of.setdefault(key, []).append(row)
    curves = {}
    for key, rows in rows_of.items():
        _check_positions(table, reversal_name(*key), rows, position_mm)
        picked = np.array(rows)[np.argsort(position_mm[rows])]
        where = np.nan_to_num(position_mm[picked])
        curves[key] = Curve(where, value_um[picked] * MM_PER_UM, u_um[picked] * MM_PER_UM)
    return ReversalCurves(curves, {key: value for key, value in table.metadata.items() if key != "rows"})


def _letters(table: CsvTable, column: str) -> list[int]:
    letters = table.text(column)
    for row, letter in enumerate(letters):
        if letter not in AXES:
            raise table.fail(row, column, f"{letter!r} is not an axis; X, Y or Z is due")
    return [AXES.index(letter) for letter in letters]


def _check_positions(table: CsvTable, name: str, rows: list[int], position_mm: FloatArray) -> None:
    seen: dict[float, int] = {}
    for row in rows:
        position = float(position_mm[row])
        if np.isnan(position) and len(rows) > 1:
            message = (
                f"is empty, and {name} has {len(rows)} rows; a constant has one row, a function a position in each"
            )
            raise table.fail(row, "position_mm", message)
        first = seen.setdefault(position, row)
        if first != row:
            message = f"{name} has a value at {position:g} mm already in line {table.lines[first]}"
            raise table.fail(row, "position_mm", message)


def format_reversal(reversal: ReversalCurves, metadata: Mapping[str, object] | None = None) -> str:
    """Return the text of a ``*.reversal.csv`` file; values in um with 6 decimals, constants without a position."""
    rows: list[tuple[int, int, float, float, float]] = []
    for (axis, component), curve in sorted(reversal.curves.items()):
        constant = len(curve.position_mm) == 1
        for position, value, u in zip(curve.position_mm, curve.value, curve.u, strict=True):
            rows.append((axis, component, np.nan if constant else position, value / MM_PER_UM, u / MM_PER_UM))
    if not rows:
        raise InputError("there is no reversal to write")
    axes, components, positions, values, u_values = zip(*rows, strict=True)
    columns: dict[str, Sequence[str] | FloatArray] = {
        "axis": [AXES[axis] for axis in axes],
        "component": [AXES[component] for component in components],
        "position_mm": np.array(positions),
        "value_um": np.array(values),
        "u_value_um": np.array(u_values),
    }
    return format_csv(columns, {**reversal.metadata, **(metadata or {})})
