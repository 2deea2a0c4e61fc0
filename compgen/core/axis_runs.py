"""Positioning runs along single axes (ISO 230-2): ``*.axis.csv`` of the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import CsvTable, FloatArray, format_csv, header_columns, read_csv
from compgen.core.deviations import LARGEST_UM
from compgen.core.lengths import check_distinct, common_metadata, origins
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import InputError

AXIS_COLUMNS = ("axis", "position_mm", "direction", "run", "deviation_um")
#: Optional: time, number of the reading in the order of time, time at rest before it, speed on the way to it.
AXIS_COVARIATES = ("time_s", "order", "dwell_s", "feed_mm_min")


@dataclass(frozen=True)
class AxisRuns:
    """Actual minus target position along the axis that moves, n readings.

    Parameters
    ----------
    axis : axis of each reading, 0, 1, 2 for X, Y, Z, shape (n,).
    position_mm : target positions, shape (n,).
    direction : direction of approach, +1 or -1, shape (n,).
    run : number of the run; the two ways of a cycle may have the same, shape (n,).
    deviation_mm : actual minus target, shape (n,).
    covariates : further numbers by column name (time_s, temp_..._c), each of shape (n,); nan where a file lacks one.
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each row, for messages.
    """

    axis: NDArray[np.int64]
    position_mm: FloatArray
    direction: NDArray[np.int64]
    run: NDArray[np.int64]
    deviation_mm: FloatArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.position_mm)

    @property
    def axes(self) -> tuple[int, ...]:
        """Axes that were measured, ascending."""
        return tuple(int(axis) for axis in np.unique(self.axis))


def holds_axis_runs(path: str | Path) -> bool:
    """Tell by the columns of a measurement file whether it holds axis runs (``deviation_um`` over ``position_mm``)."""
    return {"axis", "position_mm", "deviation_um"} <= header_columns(path)


def read_axis_runs(paths: str | Path | Sequence[str | Path]) -> AxisRuns:
    """Read one or more ``*.axis.csv`` files into one :class:`AxisRuns`, um to mm.

    Raises
    ------
    InputError
        for an axis that is not X, Y, Z, a direction that is not 1 or -1, a reading that stands twice.
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [read_csv(path, AXIS_COLUMNS, AXIS_COVARIATES, ("temp_*_c",)) for path in files]
    check_distinct(tables)
    runs = AxisRuns(
        axis=np.concatenate([_axes(table) for table in tables]),
        position_mm=np.concatenate([table.numbers("position_mm") for table in tables]),
        direction=np.concatenate([directions_of(table) for table in tables]),
        run=np.concatenate([table.labels("run") for table in tables]),
        deviation_mm=np.concatenate([run_deviations_um(table) for table in tables]) * MM_PER_UM,
        covariates=covariates_beside(tables, AXIS_COLUMNS),
        metadata=common_metadata(tables),
        origin=origins(tables),
    )
    check_single(runs)
    return runs


def _axes(table: CsvTable) -> NDArray[np.int64]:
    letters = table.text("axis")
    for row, letter in enumerate(letters):
        if letter not in AXES:
            raise table.fail(row, "axis", f"{letter!r} is not an axis; X, Y or Z is due")
    return np.array([AXES.index(letter) for letter in letters], dtype=np.int64)


def directions_of(table: CsvTable) -> NDArray[np.int64]:
    """Return the column ``direction`` (rows,): 1 or -1, nothing else."""
    values = table.signs("direction")
    for row in np.flatnonzero(values == 0)[:1].tolist():
        raise table.fail(row, "direction", "0 is not a direction of approach; 1 or -1 is due")
    return values.astype(np.int64)


def run_deviations_um(table: CsvTable) -> FloatArray:
    """Return the column ``deviation_um`` (rows,); one beyond 100 mm is taken for a slip of unit."""
    values = table.numbers("deviation_um")
    for row in np.flatnonzero(np.abs(values) > LARGEST_UM)[:1].tolist():
        raise table.fail(row, "deviation_um", f"{values[row]:g} um is more than 100 mm; is the unit um?")
    return values


def covariates_beside(tables: Sequence[CsvTable], own: Sequence[str]) -> dict[str, FloatArray]:
    """Return all columns but ``own`` as numbers of all rows, nan where a file lacks one."""
    names = dict.fromkeys(name for table in tables for name in table.columns if name not in own)
    return {
        name: np.concatenate(
            [table.numbers(name) if name in table.columns else np.full(len(table), np.nan) for table in tables]
        )
        for name in names
    }


def check_single(runs: AxisRuns) -> None:
    """One axis has one reading for each target, direction and run; InputError that names the second one."""
    seen: dict[tuple[int, float, int, int], int] = {}
    keys = zip(runs.axis.tolist(), runs.position_mm.tolist(), runs.direction.tolist(), runs.run.tolist(), strict=True)
    for row, key in enumerate(keys):
        first = seen.setdefault(key, row)
        if first != row:
            file, line = runs.origin[row] if runs.origin else (None, None)
            where = f" already in {runs.origin[first][0]}:{runs.origin[first][1]}" if runs.origin else " twice"
            message = (
                f"{AXES[key[0]]} at {key[1]:g} mm, direction {key[2]}, run {key[3]} stands{where}; number the runs"
            )
            raise InputError(message, file=file, line=line)


def format_axis_runs(runs: AxisRuns) -> str:
    """Return the text of an ``*.axis.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4."""
    columns: dict[str, Sequence[str] | FloatArray] = {
        "axis": [AXES[k] for k in runs.axis],
        "position_mm": runs.position_mm,
        "direction": runs.direction.astype(np.float64),
        "run": runs.run.astype(np.float64),
        "deviation_um": runs.deviation_mm / MM_PER_UM,
        **runs.covariates,
    }
    digits = {"position_mm": 6, "direction": 0, "run": 0, "deviation_um": 4}
    return format_csv(columns, runs.metadata, digits)
