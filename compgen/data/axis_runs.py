"""Positioning runs along single axes (ISO 230-2) and along diagonals (ISO 230-6): records, readers, writers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.error_table import SIGNIFICANT, WORTH_MM, Curve
from compgen.data.names import AXES, BODY_DIAGONALS
from compgen.data.records import AXIS, DIRECTION, POSITION, RUN, RUN_DEVIATION, Field, Schema, fail_at
from compgen.drawing.display import Tabular
from compgen.errors import InputError, repeated

# Positioning runs along single axes (ISO 230-2): ``*.axis.csv``.


#: Targets closer than this are the same target, mm.
SAME_TARGET_MM = 1e-4
POSITIONING = ("EXX", "EYY", "EZZ")
#: Positions of the other axes, where a line was measured: columns, or comments of the file.
LINE_COLUMNS = ("line_x_mm", "line_y_mm", "line_z_mm")


@dataclass(frozen=True)
class AxisRuns(Tabular):
    """Actual minus target position along the moving axis, n readings.

    Parameters
    ----------
    axis : axis of each reading, 0, 1, 2 for X, Y, Z, shape (n,).
    position_mm : target positions, shape (n,).
    direction : direction of approach, +1 or -1, shape (n,).
    run : number of the run; both directions of a cycle may have the same, shape (n,).
    deviation_mm : actual minus target, shape (n,).
    covariates : other numbers by column name (time_s, temp_..._c), each of shape (n,); nan if a file lacks one.
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

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.axis.csv``, each (n,)."""
        return _AXIS_RUNS.cells(self)

    def line_mm(self) -> FloatArray:
        """Positions of all axes (n, 3): that of the moving axis, and of the others as stated, nan where they are not."""
        none = np.full(len(self), np.nan)
        found = np.column_stack([self.covariates.get(name, none) for name in LINE_COLUMNS])
        found[np.arange(len(self)), self.axis] = self.position_mm
        return found


_AXIS_RUNS = Schema(
    (
        AXIS,
        Field("position_mm", ("position_mm",)),
        DIRECTION,
        RUN,
        RUN_DEVIATION,
        # time, number of the reading in order of time, dwell before it, speed before it, positions of the other axes
        Field("covariates", ("time_s", "order", "dwell_s", "feed_mm_min", *LINE_COLUMNS), presence="covariates"),
    )
)


def two_way_mean(
    position_mm: FloatArray, direction: np.ndarray, value: FloatArray
) -> tuple[Curve, Curve | None, FloatArray]:
    """Return mean over both directions, reversal, and residuals of the readings along one axis.

    Parameters
    ----------
    position_mm, direction, value : targets, directions (+1, -1, or 0 where unknown) and readings, (n,), mm or rad.

    Returns
    -------
    mean : at each target the mean of the means of both directions (ISO 230-2), or the mean of the only direction.
    reversal : positive minus negative approach where both were measured; None if nowhere.
    residual : reading minus mean of its target and direction, (n,).

    Standard uncertainties come from the scatter within targets and directions, pooled over the axis, because a few
    runs tell little about a single target; nan where nothing was repeated.
    """
    keys = np.round(position_mm / SAME_TARGET_MM).astype(np.int64)
    _, first, target = np.unique(keys, return_index=True, return_inverse=True)
    cell = 2 * target.ravel() + (np.asarray(direction) < 0)
    count = np.bincount(cell, minlength=2 * len(first)).astype(np.float64)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(cell, value, minlength=2 * len(first)) / count
    residual = value - mean[cell]
    freedom = len(value) - int(np.count_nonzero(count))
    variance = float(residual @ residual) / freedom if freedom else np.nan
    both = mean.reshape(-1, 2)
    with np.errstate(divide="ignore"):
        square = np.where(np.isfinite(both), variance / count.reshape(-1, 2), 0.0)
    ways = np.isfinite(both).sum(axis=1)
    centre = Curve(position_mm[first], np.nansum(both, axis=1) / ways, np.sqrt(square.sum(axis=1)) / ways)
    pairs = np.flatnonzero(ways == 2)
    if not pairs.size:
        return centre, None, residual
    reversal = Curve(centre.position_mm[pairs], both[pairs, 0] - both[pairs, 1], np.sqrt(square[pairs].sum(axis=1)))
    return centre, reversal, residual


def worth_a_table(reversal: Curve) -> bool:
    """Whether a reversal is large enough, and exceeds its uncertainty somewhere."""
    size = np.abs(reversal.value)
    beyond = np.isnan(reversal.u) | (size > SIGNIFICANT * reversal.u)
    return bool(size.max() >= WORTH_MM and beyond.any())


def read_axis_runs(files: str | Path | Sequence[str | Path]) -> AxisRuns:
    """Read one or more ``*.axis.csv`` files into one :class:`AxisRuns`, um to mm.

    Raises
    ------
    InputError
        for an axis that is not X, Y, Z, a direction that is not 1 or -1, a duplicate reading.
    """
    tables = _AXIS_RUNS.read_tables(files)
    return join_axis_runs([_with_stated_line(AxisRuns(**_AXIS_RUNS.values(table))) for table in tables])


def _with_stated_line(runs: AxisRuns) -> AxisRuns:
    """Return runs of one file with the positions of the other axes that its comments state."""
    stated = {}
    for name in LINE_COLUMNS:
        if name in runs.metadata and name not in runs.covariates:
            text = runs.metadata[name]
            try:
                value = float(text)
            except ValueError:
                value = np.nan
            if not np.isfinite(value):
                message = f"{text[:40]!r} is not a position; expected a number in mm, e.g. # {name} = -250"
                raise InputError(message, file=runs.origin[0][0] if runs.origin else None, field=f"comment {name}")
            stated[name] = np.full(len(runs), value)
    return replace(runs, covariates={**runs.covariates, **stated}) if stated else runs


def join_axis_runs(parts: Sequence[AxisRuns]) -> AxisRuns:
    """Return several records as one; InputError for a duplicate reading."""
    runs = _AXIS_RUNS.joined(parts)
    check_single(runs)
    return runs


def check_single(runs: AxisRuns) -> None:
    """Check that there is one reading for each axis, target, direction and run; InputError at the second one."""
    keys = list(
        zip(runs.axis.tolist(), runs.position_mm.tolist(), runs.direction.tolist(), runs.run.tolist(), strict=True)
    )
    found = repeated(keys)
    if found is not None:
        axis, at, direction, run = keys[found[1]]
        raise _second(runs, found, f"{AXES[axis]} at {at:g} mm, direction {direction}, run {run}")


def _second(runs: AxisRuns | Diagonals, rows: tuple[int, int], what: str, field: str | None = None) -> InputError:
    """Return the error about a duplicate reading, with both places."""
    first, row = rows
    where = f"{runs.origin[first][0]}:{runs.origin[first][1]}" if runs.origin else "an earlier row"
    return fail_at(runs.origin, row, f"{what} already appears in {where}; number the runs", field)


def format_axis_runs(runs: AxisRuns) -> str:
    """Return the text of an ``*.axis.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4."""
    return _AXIS_RUNS.format(runs, runs.metadata)


# Measured diagonals of the working volume (ISO 230-6): ``*.diagonals.csv``.


#: Face diagonals, with 0 for the axis that does not move.
FACE_DIAGONALS = {
    "PP0": (1, 1, 0),
    "NP0": (-1, 1, 0),
    "P0P": (1, 0, 1),
    "N0P": (-1, 0, 1),
    "0PP": (0, 1, 1),
    "0NP": (0, -1, 1),
}
DIAGONALS = {**BODY_DIAGONALS, **FACE_DIAGONALS}
#: Largest distance of a commanded position from the line between the ends, mm.
OFF_LINE_MM = 0.01


@dataclass(frozen=True)
class Diagonals:
    """Measured minus commanded distance along diagonals, n readings.

    Parameters
    ----------
    name : diagonal of each reading (PPP ... NNP, PP0 ...), n long.
    position_mm : commanded positions, shape (n, 3).
    direction : +1 from the start of the diagonal to its end as in its name, -1 back, shape (n,).
    run : number of the run; both directions of a cycle may have the same, shape (n,).
    deviation_mm : measured minus commanded distance; a constant for each diagonal has no meaning, shape (n,).
    covariates : other numbers by column name (time_s, temp_..._c), each of shape (n,); nan if a file lacks one.
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each row, for messages.
    """

    name: tuple[str, ...]
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
    def names(self) -> tuple[str, ...]:
        """Measured diagonals, the body diagonals first."""
        return tuple(name for name in DIAGONALS if name in set(self.name))

    def rows(self, name: str) -> NDArray[np.int64]:
        """Return the rows of one diagonal."""
        return np.flatnonzero(np.array(self.name) == name)


def _names(table: CsvTable, column: str) -> list[str]:
    names = table.text(column)
    for row, name in enumerate(names):
        if name not in DIAGONALS:
            known = f"{', '.join(BODY_DIAGONALS)}; of faces {', '.join(FACE_DIAGONALS)}"
            raise table.fail(row, column, f"{name!r} is not a diagonal; use {known}")
    return names


_DIAGONALS = Schema(
    (
        Field("name", ("diagonal",), _names),
        POSITION,
        DIRECTION,
        RUN,
        RUN_DEVIATION,
        Field("covariates", ("time_s",), presence="covariates"),
    )
)


def read_diagonals(files: str | Path | Sequence[str | Path]) -> Diagonals:
    """Read one or more ``*.diagonals.csv`` files into one :class:`Diagonals`, um to mm.

    Raises
    ------
    InputError
        for an unknown diagonal, a direction that is not 1 or -1, a duplicate reading, positions that are not on a line
        in the direction in the name of the diagonal.
    """
    found = _DIAGONALS.joined([Diagonals(**_DIAGONALS.values(table)) for table in _DIAGONALS.read_tables(files)])
    found = replace(found, name=tuple(found.name))
    check_lines(found)
    places = map(tuple, np.round(found.position_mm, 3).tolist())
    twice = repeated(zip(found.name, places, found.direction.tolist(), found.run.tolist(), strict=True))
    if twice is not None:
        k = twice[1]
        what = f"{found.name[k]} at {_place(found.position_mm[k])}, direction {found.direction[k]}, run {found.run[k]}"
        raise _second(found, twice, what, "column diagonal")
    return found


def along_mm(position_mm: FloatArray, name: str) -> FloatArray:
    """Return the distance (n,) of positions (n, 3) on a diagonal from its start, the first in the direction of the name."""
    signs = np.array(DIAGONALS[name], dtype=np.float64)
    start = position_mm[int(np.argmin(position_mm @ signs))]
    return np.asarray(np.linalg.norm(position_mm - start, axis=1))


def check_lines(diagonals: Diagonals) -> None:
    """Check that every diagonal is a line in the direction of its name; InputError at the first position off it."""
    for name in diagonals.names:
        rows = diagonals.rows(name)
        points, signs = diagonals.position_mm[rows], np.array(DIAGONALS[name], dtype=np.float64)
        order = np.argsort(points @ signs, kind="stable")
        way = points[order[-1]] - points[order[0]]
        if np.any(np.sign(np.where(np.abs(way) <= OFF_LINE_MM, 0.0, way)) != signs):
            ends = " to ".join(_place(points[order[k]]) for k in (0, -1))
            text = f"{name} runs from {ends}; its letters are the directions of X, Y, Z (P positive, N negative, 0 no motion)"
            raise fail_at(diagonals.origin, int(rows[order[-1]]), text, "column diagonal")
        unit = way / np.linalg.norm(way)
        apart = points - points[order[0]]
        off = np.linalg.norm(apart - np.outer(apart @ unit, unit), axis=1)
        if off.max() > OFF_LINE_MM:
            row = int(np.argmax(off))
            text = f"{_place(points[row])} is {off[row]:.3g} mm off the line between the ends of {name}"
            raise fail_at(diagonals.origin, int(rows[row]), text, "column diagonal")


def _place(point: FloatArray) -> str:
    return f"({', '.join(f'{value:g}' for value in point)}) mm"


def format_diagonals(diagonals: Diagonals) -> str:
    """Return the text of a ``*.diagonals.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4."""
    return _DIAGONALS.format(diagonals, diagonals.metadata)
