"""Measured diagonals of the working volume (ISO 230-6): ``*.diagonals.csv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.axis_runs import covariates_beside, directions_of, run_deviations_um
from compgen.core.csvio import CsvTable, FloatArray, format_csv, header_columns, read_csv
from compgen.core.lengths import POSITION_COLUMNS, check_distinct, common_metadata, origins, vectors_of
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError

DIAGONAL_COLUMNS = ("diagonal", *POSITION_COLUMNS, "direction", "run", "deviation_um")
#: Body diagonals, and face diagonals with 0 for the axis that stands: directions of X, Y, Z from start to end.
BODY_DIAGONALS = {"PPP": (1, 1, 1), "NPP": (-1, 1, 1), "PNP": (1, -1, 1), "NNP": (-1, -1, 1)}
FACE_DIAGONALS = {
    "PP0": (1, 1, 0),
    "NP0": (-1, 1, 0),
    "P0P": (1, 0, 1),
    "N0P": (-1, 0, 1),
    "0PP": (0, 1, 1),
    "0NP": (0, -1, 1),
}
DIAGONALS = {**BODY_DIAGONALS, **FACE_DIAGONALS}
#: How far from the line between its ends a commanded position may lie, mm.
OFF_LINE_MM = 0.01


@dataclass(frozen=True)
class Diagonals:
    """Measured minus commanded distance along diagonals, n readings.

    Parameters
    ----------
    name : diagonal of each reading (PPP ... NNP, PP0 ...), n long.
    position_mm : commanded positions, shape (n, 3).
    direction : +1 from the start of the diagonal to its end as its name says, -1 back, shape (n,).
    run : number of the run; the two ways of a cycle may have the same, shape (n,).
    deviation_mm : measured minus commanded distance; a constant for each diagonal does not count, shape (n,).
    covariates : further numbers by column name (time_s, temp_..._c), each of shape (n,); nan where a file lacks one.
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
        """Diagonals that were measured, the body diagonals first."""
        return tuple(name for name in DIAGONALS if name in set(self.name))

    def rows(self, name: str) -> NDArray[np.int64]:
        """Return the rows of one diagonal."""
        return np.flatnonzero(np.array(self.name) == name)


def holds_diagonals(path: str | Path) -> bool:
    """Tell by the columns of a measurement file whether it holds measured diagonals."""
    return {"diagonal", "deviation_um"} <= header_columns(path)


def read_diagonals(paths: str | Path | Sequence[str | Path]) -> Diagonals:
    """Read one or more ``*.diagonals.csv`` files into one :class:`Diagonals`, um to mm.

    Raises
    ------
    InputError
        for an unknown diagonal, a direction that is not 1 or -1, a reading that stands twice, positions that do not lie on
        a line in the direction that the name of the diagonal says.
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [read_csv(path, DIAGONAL_COLUMNS, ("time_s",), ("temp_*_c",)) for path in files]
    check_distinct(tables)
    found = Diagonals(
        name=tuple(name for table in tables for name in _names(table)),
        position_mm=np.concatenate([vectors_of(table, POSITION_COLUMNS) for table in tables]),
        direction=np.concatenate([directions_of(table) for table in tables]),
        run=np.concatenate([table.labels("run") for table in tables]),
        deviation_mm=np.concatenate([run_deviations_um(table) for table in tables]) * MM_PER_UM,
        covariates=covariates_beside(tables, DIAGONAL_COLUMNS),
        metadata=common_metadata(tables),
        origin=origins(tables),
    )
    check_lines(found)
    _check_single(found)
    return found


def _names(table: CsvTable) -> list[str]:
    names = table.text("diagonal")
    for row, name in enumerate(names):
        if name not in DIAGONALS:
            known = f"{', '.join(BODY_DIAGONALS)}; of faces {', '.join(FACE_DIAGONALS)}"
            raise table.fail(row, "diagonal", f"{name!r} is no diagonal; {known} are")
    return names


def along_mm(position_mm: FloatArray, name: str) -> FloatArray:
    """Distance (n,) of positions (n, 3) on a diagonal from its start: the one that comes first in the name's direction."""
    signs = np.array(DIAGONALS[name], dtype=np.float64)
    start = position_mm[int(np.argmin(position_mm @ signs))]
    return np.asarray(np.linalg.norm(position_mm - start, axis=1))


def edges_mm(position_mm: FloatArray) -> FloatArray:
    """Extent (3,) of the positions of a diagonal in X, Y, Z: the edges of its box."""
    return np.asarray(np.ptp(position_mm, axis=0))


def check_lines(diagonals: Diagonals) -> None:
    """Every diagonal lies on a line in the direction of its name; InputError that names the first position that does not."""
    for name in diagonals.names:
        rows = diagonals.rows(name)
        points, signs = diagonals.position_mm[rows], np.array(DIAGONALS[name], dtype=np.float64)
        order = np.argsort(points @ signs, kind="stable")
        way = points[order[-1]] - points[order[0]]
        if np.any(np.sign(np.where(np.abs(way) <= OFF_LINE_MM, 0.0, way)) != signs):
            ends = " to ".join(_place(points[order[k]]) for k in (0, -1))
            text = f"{name} goes from {ends}; its letters say the directions of X, Y, Z (P up, N down, 0 stands)"
            raise _fail(diagonals, int(rows[order[-1]]), text)
        unit = way / np.linalg.norm(way)
        apart = points - points[order[0]]
        off = np.linalg.norm(apart - np.outer(apart @ unit, unit), axis=1)
        if off.max() > OFF_LINE_MM:
            row = int(np.argmax(off))
            text = f"{_place(points[row])} lies {off[row]:.3g} mm beside the line between the ends of {name}"
            raise _fail(diagonals, int(rows[row]), text)


def _place(point: FloatArray) -> str:
    return f"({', '.join(f'{value:g}' for value in point)}) mm"


def _fail(diagonals: Diagonals, row: int, text: str) -> InputError:
    file, line = diagonals.origin[row] if diagonals.origin else (None, None)
    return InputError(text, file=file, line=line, field="column diagonal")


def _check_single(diagonals: Diagonals) -> None:
    """One diagonal has one reading for each position, direction and run; InputError that names the second one."""
    seen: dict[tuple[object, ...], int] = {}
    places = np.round(diagonals.position_mm, 3).tolist()
    keys = zip(diagonals.name, map(tuple, places), diagonals.direction.tolist(), diagonals.run.tolist(), strict=True)
    for row, key in enumerate(keys):
        first = seen.setdefault(key, row)
        if first != row:
            where = (
                f"{diagonals.origin[first][0]}:{diagonals.origin[first][1]}" if diagonals.origin else "an earlier row"
            )
            place = _place(diagonals.position_mm[row])
            text = f"{key[0]} at {place}, direction {key[2]}, run {key[3]} stands already in {where}; number the runs"
            raise _fail(diagonals, row, text)


def format_diagonals(diagonals: Diagonals) -> str:
    """Return the text of a ``*.diagonals.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4."""
    columns: dict[str, Sequence[str] | FloatArray] = {
        "diagonal": diagonals.name,
        **dict(zip(POSITION_COLUMNS, diagonals.position_mm.T, strict=True)),
        "direction": diagonals.direction.astype(np.float64),
        "run": diagonals.run.astype(np.float64),
        "deviation_um": diagonals.deviation_mm / MM_PER_UM,
        **diagonals.covariates,
    }
    return format_csv(columns, diagonals.metadata, {"direction": 0, "run": 0, "deviation_um": 4})
