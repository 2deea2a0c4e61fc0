"""Laser-tracer lengths: ``*.lengths.csv`` of the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import CsvTable, FloatArray, format_csv, read_csv
from compgen.errors import InputError

POSITION_COLUMNS = ("x_mm", "y_mm", "z_mm")
TOOL_COLUMNS = ("tool_x_mm", "tool_y_mm", "tool_z_mm")
APPROACH_COLUMNS = ("approach_x", "approach_y", "approach_z")
LABEL_COLUMNS = ("run", "line", "repeat", "block", "setup", "pose")
COVARIATE_COLUMNS = ("time_s", "feed_mm_min", "load_kg", "u_length_um")


@dataclass(frozen=True)
class Lengths:
    """Displacement readings of one or more tracer stations; n readings, S stations.

    Parameters
    ----------
    stations : names of the stations.
    station : index into ``stations`` of each reading, shape (n,).
    point : label of the target point of each reading.
    position_mm : commanded positions, shape (n, 3).
    length_mm : readings, the true distance minus an unknown constant per station and set-up, shape (n,).
    tool_mm : tool offset of each reading, shape (n, 3), or None for the machine's own.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    labels : whole-number labels by column name (run, line, repeat, block, setup, pose), each of shape (n,).
    covariates : further numbers by column name (time_s, temp_..., ...), each of shape (n,).
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each reading, for messages.
    """

    stations: tuple[str, ...]
    station: NDArray[np.int64]
    point: Sequence[str]
    position_mm: FloatArray
    length_mm: FloatArray
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.length_mm)


def read_lengths(paths: str | Path | Sequence[str | Path]) -> Lengths:
    """Read one or more ``*.lengths.csv`` files into one :class:`Lengths`.

    Labels that only some of the files carry are 0 in the others; the same station in two files is one station.
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [_read_table(path) for path in files]
    check_distinct(tables)
    labels = [table.names("station") for table in tables]
    names = tuple(dict.fromkeys(chain.from_iterable(labels)))
    index = {name: k for k, name in enumerate(names)}
    return Lengths(
        stations=names,
        station=np.array([index[name] for name in chain.from_iterable(labels)], dtype=np.int64),
        point=[point for table in tables for point in table.text("point")],
        position_mm=np.concatenate([vectors_of(table, POSITION_COLUMNS) for table in tables]),
        length_mm=np.concatenate([table.numbers("length_mm") for table in tables]),
        tool_mm=common_tool(tables),
        approach=common_approach(tables),
        labels=common_labels(tables),
        covariates=common_covariates(tables),
        metadata=common_metadata(tables),
        origin=origins(tables),
    )


def _read_table(path: str | Path) -> CsvTable:
    table = read_csv(
        path,
        required=("station", "point", *POSITION_COLUMNS, "length_mm"),
        optional=("approach", *TOOL_COLUMNS, *APPROACH_COLUMNS, *LABEL_COLUMNS, *COVARIATE_COLUMNS),
        prefixes=("temp_*_c",),
    )
    check_repeats(table, ("station", "point"))
    lengths = table.numbers("length_mm")
    for row in np.flatnonzero(np.abs(lengths) > 1e6)[:1]:
        raise table.fail(int(row), "length_mm", f"{lengths[row]:g} mm is more than a kilometre; is the unit mm?")
    return table


def check_repeats(table: CsvTable, keys: Sequence[str]) -> None:
    """Two rows that agree in ``keys`` must differ in a label, a direction, the tool or the time."""
    names = (*keys, "approach", *APPROACH_COLUMNS, *TOOL_COLUMNS, *LABEL_COLUMNS, "time_s")
    key_columns = [name for name in names if name in table.columns]
    seen: dict[tuple[str, ...], int] = {}
    for row, key in enumerate(zip(*(table.columns[name] for name in key_columns), strict=True)):
        first = seen.setdefault(key, row)
        if first != row:
            what = " and ".join(f"{name} {value!r}" for name, value in zip(keys, key, strict=False))
            message = f"{what} stand already in line {table.lines[first]}; give repeats a run or repeat column"
            raise table.fail(row, keys[-1], message)


def check_distinct(tables: list[CsvTable]) -> None:
    """The same readings may not come in twice, as one file given twice or as a copy of it."""
    for k, table in enumerate(tables):
        for earlier in tables[:k]:
            if table.columns == earlier.columns:
                raise InputError(f"holds the same rows as {earlier.path}; give each measurement once", file=table.path)


def vectors_of(table: CsvTable, names: Sequence[str]) -> FloatArray:
    """Return the columns ``names`` side by side, shape (rows, columns)."""
    return np.column_stack([table.numbers(name) for name in names])


def labels_of(table: CsvTable, name: str) -> NDArray[np.int64]:
    """Return a column of labels (rows,); zeros if the file lacks it."""
    return table.labels(name) if name in table.columns else np.zeros(len(table), dtype=np.int64)


def common_labels(tables: Sequence[CsvTable]) -> dict[str, NDArray[np.int64]]:
    """Return the label columns that any of the tables has; 0 in the others."""
    return {
        name: np.concatenate([labels_of(table, name) for table in tables])
        for name in LABEL_COLUMNS
        if any(name in table.columns for table in tables)
    }


def common_metadata(tables: Sequence[CsvTable]) -> dict[str, str]:
    """Return the comments of all tables; where they differ, that of the first one counts."""
    return {key: value for table in reversed(tables) for key, value in table.metadata.items() if key != "rows"}


def origins(tables: Sequence[CsvTable]) -> list[tuple[str, int]]:
    """Return file and line of every row."""
    return [(str(table.path), line) for table in tables for line in table.lines]


def common_tool(tables: list[CsvTable]) -> FloatArray | None:
    """Return the tool offsets of all rows (n, 3), or None if no file has them."""
    having = [all(name in table.columns for name in TOOL_COLUMNS) for table in tables]
    for table in tables:
        present = [name for name in TOOL_COLUMNS if name in table.columns]
        if present and len(present) < 3:
            raise InputError(f"has {present[0]} but not all of {', '.join(TOOL_COLUMNS)}", file=table.path)
    if not any(having):
        return None
    if not all(having):
        table = tables[having.index(False)]
        raise InputError(
            f"lacks {', '.join(TOOL_COLUMNS)}, which another file has; give them in every file", file=table.path
        )
    return np.concatenate([vectors_of(table, TOOL_COLUMNS) for table in tables])


def common_approach(tables: list[CsvTable]) -> FloatArray | None:
    """Return the last directions of travel (n, 3), 0 where unknown, or None if no file has them."""
    if not any(name in table.columns for table in tables for name in APPROACH_COLUMNS):
        return None
    blocks = []
    for table in tables:
        block = [table.signs(n) if n in table.columns else np.zeros(len(table)) for n in APPROACH_COLUMNS]
        blocks.append(np.column_stack(block))
    return np.concatenate(blocks)


def common_covariates(tables: list[CsvTable]) -> dict[str, FloatArray]:
    """Return times, temperatures and the like by name, each (n,), nan where a file lacks the column."""
    names = [
        name
        for name in dict.fromkeys(name for table in tables for name in table.columns)
        if name in (*COVARIATE_COLUMNS, "approach") or name.startswith("temp_")
    ]
    for table in tables:
        if "approach" in table.columns:
            table.signs("approach")
    return {
        name: np.concatenate(
            [table.numbers(name) if name in table.columns else np.full(len(table), np.nan) for table in tables]
        )
        for name in names
    }


def format_lengths(lengths: Lengths) -> str:
    """Return the text of a ``*.lengths.csv`` file: positions with 6 decimals (1 nm), lengths with 7."""
    columns: dict[str, Sequence[str] | FloatArray] = {
        "station": [lengths.stations[k] for k in lengths.station],
        "point": list(lengths.point),
    }
    digits = {"length_mm": 7}
    _add_vectors(columns, digits, POSITION_COLUMNS, lengths.position_mm, 6)
    columns["length_mm"] = lengths.length_mm
    for name, labels in lengths.labels.items():
        columns[name] = labels.astype(np.float64)
        digits[name] = 0
    if lengths.approach is not None:
        _add_vectors(columns, digits, APPROACH_COLUMNS, lengths.approach, 0)
    if lengths.tool_mm is not None:
        _add_vectors(columns, digits, TOOL_COLUMNS, lengths.tool_mm, 6)
    for name, values in lengths.covariates.items():
        columns[name] = values
        digits[name] = 3
    return format_csv(columns, lengths.metadata, digits)


def _add_vectors(
    columns: dict[str, Sequence[str] | FloatArray],
    digits: dict[str, int],
    names: Sequence[str],
    values: FloatArray,
    places: int,
) -> None:
    for k, name in enumerate(names):
        columns[name] = values[:, k]
        digits[name] = places
