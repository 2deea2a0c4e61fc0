"""Geometric errors as tables over the axis position: the object that identify, fit and export hand on."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compgen.core.csvio import CsvTable, FloatArray, format_csv, read_csv
from compgen.core.names import CURVE_NAMES, ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.core.text import nearest
from compgen.errors import CompgenWarning

#: Columns that an ``*.errors.csv`` file must have.
ERROR_COLUMNS = ("error", "position_mm", "value")


@dataclass(frozen=True)
class Curve:
    """One error over its axis: ``position_mm`` ascending, ``value`` and standard uncertainty ``u`` in mm or rad.

    All three have shape (n,); ``u`` is nan where it is not known. Linear between positions, constant outside.
    """

    position_mm: FloatArray
    value: FloatArray
    u: FloatArray

    def __post_init__(self) -> None:
        if not len(self.position_mm) == len(self.value) == len(self.u) > 0:
            raise ValueError(f"lengths differ: {len(self.position_mm)}, {len(self.value)}, {len(self.u)}")
        ascending = self.position_mm[1:] > self.position_mm[:-1]
        if not (ascending.all() and np.isfinite(self.position_mm).all()):
            raise ValueError("positions of a curve must be finite and ascend")

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Value at the given positions, same shape."""
        return np.interp(position_mm, self.position_mm, self.value)


@dataclass(frozen=True)
class ErrorTable:
    """Some or all of the 21 errors of a machine, in mm and rad; an error that is absent is zero.

    ``curves`` holds the 18 functions by name, ``squareness`` the constants by name as (value, uncertainty).
    """

    curves: Mapping[str, Curve] = field(default_factory=dict)
    squareness: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for names, allowed, what in (
            (self.curves, CURVE_NAMES, "18 errors that are functions"),
            (self.squareness, SQUARENESS_NAMES, "3 squareness errors"),
        ):
            for name in names:
                if name not in allowed:
                    raise ValueError(f"{name!r} is not one of the {what}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors that are present, in the order of the columns of C."""
        return tuple(name for name in ERROR_NAMES if name in self.curves or name in self.squareness)

    def at(self, position_mm: FloatArray) -> FloatArray:
        """All 21 errors P at axis positions of shape (n, 3): shape (n, 21), mm and rad, absent ones zero."""
        position_mm = np.asarray(position_mm, dtype=np.float64)
        values = np.zeros((len(position_mm), len(ERROR_NAMES)))
        for name, curve in self.curves.items():
            values[:, ERROR_INDEX[name]] = curve.at(position_mm[:, error_named(name).axis])
        for name, (value, _) in self.squareness.items():
            values[:, ERROR_INDEX[name]] = value
        return values

    def warn_outside(self, position_mm: FloatArray) -> None:
        """Warn when positions of shape (n, 3) leave the range of a curve, whose end value is then used."""
        for name, curve in self.curves.items():
            along = position_mm[:, error_named(name).axis]
            low, high = curve.position_mm[0], curve.position_mm[-1]
            if len(curve.position_mm) > 1 and (along.min() < low - 1e-6 or along.max() > high + 1e-6):
                warnings.warn(
                    f"{name} is known from {low:g} to {high:g} mm, but positions go from {along.min():g} to "
                    f"{along.max():g} mm; its end values are used outside",
                    CompgenWarning,
                    stacklevel=3,
                )
                return

    def only(self, *names: str) -> ErrorTable:
        """Return a table with just the errors ``names``; the others are zero."""
        return ErrorTable(
            {name: curve for name, curve in self.curves.items() if name in names},
            {name: value for name, value in self.squareness.items() if name in names},
            self.metadata,
        )

    def replace(self, **parts: Mapping[str, object]) -> ErrorTable:
        """Return a copy with some of ``curves``, ``squareness``, ``metadata`` replaced."""
        fields = {"curves": self.curves, "squareness": self.squareness, "metadata": self.metadata, **parts}
        return ErrorTable(**fields)  # type: ignore[arg-type]


def read_errors(path: str | Path) -> ErrorTable:
    """Read an ``*.errors.csv`` file of the contract (um and urad) into an :class:`ErrorTable` (mm and rad)."""
    return errors_of_table(read_csv(path, required=ERROR_COLUMNS, optional=("u_value",)))


def errors_of_table(table: CsvTable) -> ErrorTable:
    """Return the errors (mm and rad) of a CSV table with the columns of an ``*.errors.csv`` file (um and urad)."""
    names = table.text("error")
    values = table.numbers("value")
    u_values = _uncertainties(table)
    positions_mm = table.numbers("position_mm", empty=np.nan)
    curves: dict[str, Curve] = {}
    squareness: dict[str, tuple[float, float]] = {}
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        if name not in ERROR_INDEX:
            raise table.fail(row, "error", f"{name!r} is not an error of ISO 230-1 here; {nearest(name, ERROR_NAMES)}")
        rows_of.setdefault(name, []).append(row)
    for name, rows in rows_of.items():
        unit = error_named(name).si_per_unit
        if name in SQUARENESS_NAMES:
            _check_constant(table, name, rows)
            squareness[name] = (float(values[rows[0]]) * unit, float(u_values[rows[0]]) * unit)
        else:
            _check_positions(table, name, rows, positions_mm)
            position_mm = positions_mm[rows]
            order = np.argsort(position_mm)
            picked = np.array(rows)[order]
            curves[name] = Curve(position_mm[order], values[picked] * unit, u_values[picked] * unit)
    return ErrorTable(curves, squareness, {key: value for key, value in table.metadata.items() if key != "rows"})


def _check_constant(table: CsvTable, name: str, rows: list[int]) -> None:
    if len(rows) > 1:
        raise table.fail(rows[1], "error", f"{name} stands here a second time (first in line {table.lines[rows[0]]})")
    if table.columns["position_mm"][rows[0]]:
        raise table.fail(rows[0], "position_mm", f"{name} is a constant; leave its position empty")


def _check_positions(table: CsvTable, name: str, rows: list[int], positions_mm: FloatArray) -> None:
    seen: dict[float, int] = {}
    for row in rows:
        position = float(positions_mm[row])
        if np.isnan(position):
            raise table.fail(row, "position_mm", f"is empty; {name} is a function and needs a position in mm")
        first = seen.setdefault(position, row)
        if first != row:
            message = f"{name} has a value at {position:g} mm already in line {table.lines[first]}"
            raise table.fail(row, "position_mm", message)


def _uncertainties(table: CsvTable) -> FloatArray:
    if "u_value" not in table.columns:
        return np.full(len(table), np.nan)
    u_values = table.numbers("u_value", empty=np.nan)
    for row in np.flatnonzero(u_values < 0)[:1]:
        raise table.fail(int(row), "u_value", f"{u_values[row]:g} is negative; a standard uncertainty is not")
    return u_values


def format_errors(errors: ErrorTable, metadata: Mapping[str, object] | None = None) -> str:
    """Return the text of an ``*.errors.csv`` file; values in um and urad with 9 decimals."""
    names: list[str] = []
    positions: list[float] = []
    values: list[float] = []
    u_values: list[float] = []
    for name in errors.names:
        unit = error_named(name).si_per_unit
        if name in errors.squareness:
            rows: Iterable[tuple[float, float, float]] = [(np.nan, *errors.squareness[name])]
        else:
            curve = errors.curves[name]
            rows = zip(curve.position_mm, curve.value, curve.u, strict=True)
        for position, value, u_value in rows:
            names.append(name)
            positions.append(position)
            values.append(value / unit)
            u_values.append(u_value / unit)
    columns: dict[str, Sequence[str] | FloatArray] = {
        "error": names,
        "position_mm": np.array(positions),
        "value": np.array(values),
        "u_value": np.array(u_values),
    }
    digits = {"position_mm": 6, "value": 9, "u_value": 9}
    return format_csv(columns, {**errors.metadata, **(metadata or {})}, digits)


__all__ = ["CURVE_NAMES", "Curve", "ErrorTable", "format_errors", "read_errors"]
