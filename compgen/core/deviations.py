"""Positions measured against commanded ones: ``*.deviations.csv`` of the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import CsvTable, FloatArray, format_csv, header_columns, read_csv
from compgen.core.lengths import (
    APPROACH_COLUMNS,
    COVARIATE_COLUMNS,
    LABEL_COLUMNS,
    POSITION_COLUMNS,
    TOOL_COLUMNS,
    check_distinct,
    check_repeats,
    common_approach,
    common_covariates,
    common_labels,
    common_metadata,
    common_tool,
    origins,
    vectors_of,
)
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError

DEVIATION_COLUMNS = ("dx_um", "dy_um", "dz_um")
UNCERTAINTY_COLUMNS = ("u_dx_um", "u_dy_um", "u_dz_um")
#: A deviation beyond this is taken for a slip of unit, um.
LARGEST_UM = 1e5


@dataclass(frozen=True)
class RoughPose:
    """Where a frame lies in another: measured - ``measured_mm`` = ``rotation`` (nominal - ``nominal_mm``), (3,), (3, 3)."""

    nominal_mm: FloatArray
    measured_mm: FloatArray
    rotation: FloatArray


@dataclass(frozen=True)
class Deviations:
    """Actual minus commanded position of the tool tip, at n positions.

    Parameters
    ----------
    position_mm : commanded positions, shape (n, 3).
    deviation_mm : actual tip minus (position + tool offset), shape (n, 3); nan for a component that was not measured.
    u_mm : standard uncertainty of each component, shape (n, 3), or None if it is not known.
    tool_mm : tool offset of each row, shape (n, 3), or None for the machine's own.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    labels : whole-number labels by column name (run, line, repeat, block, setup, pose), each of shape (n,).
    covariates : further numbers by column name (time_s, temp_..., ...), each of shape (n,).
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each row, for messages.
    poses : by set-up, the pose that was taken out of the coordinates of a part; empty for deviations as they were measured.
    """

    position_mm: FloatArray
    deviation_mm: FloatArray
    u_mm: FloatArray | None = None
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()
    poses: Mapping[int, RoughPose] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of positions."""
        return len(self.position_mm)


def holds_deviations(path: str | Path) -> bool:
    """Tell by the columns of a measurement file whether it holds deviations (``dx_um`` ...) and not lengths."""
    columns = header_columns(path)
    return "length_mm" not in columns and not columns.isdisjoint(DEVIATION_COLUMNS)


def read_deviations(paths: str | Path | Sequence[str | Path]) -> Deviations:
    """Read one or more ``*.deviations.csv`` files into one :class:`Deviations`, um to mm.

    Files may measure different components; labels that only some of the files carry are 0 in the others.
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [_read_table(path) for path in files]
    check_distinct(tables)
    _check_uncertainties(tables)
    u_mm = _components(tables, UNCERTAINTY_COLUMNS)
    return Deviations(
        position_mm=np.concatenate([vectors_of(table, POSITION_COLUMNS) for table in tables]),
        deviation_mm=_components(tables, DEVIATION_COLUMNS),
        u_mm=None if np.isnan(u_mm).all() else u_mm,
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
        required=POSITION_COLUMNS,
        optional=(
            *DEVIATION_COLUMNS,
            *UNCERTAINTY_COLUMNS,
            "approach",
            *TOOL_COLUMNS,
            *APPROACH_COLUMNS,
            *LABEL_COLUMNS,
            *COVARIATE_COLUMNS,
        ),
        prefixes=("temp_*_c",),
    )
    measured = [name for name in DEVIATION_COLUMNS if name in table.columns]
    if not measured:
        raise InputError(f"has none of {', '.join(DEVIATION_COLUMNS)}; at least one is needed", file=table.path)
    given = [name for name in UNCERTAINTY_COLUMNS if name in table.columns]
    if given and given != [f"u_{name}" for name in measured]:
        needed = ", ".join(f"u_{name}" for name in measured)
        raise InputError(f"has {', '.join(given)}; give an uncertainty for each of {needed}", file=table.path)
    check_repeats(table, POSITION_COLUMNS)
    for name in measured:
        values = table.numbers(name)
        for row in np.flatnonzero(np.abs(values) > LARGEST_UM)[:1]:
            raise table.fail(int(row), name, f"{values[row]:g} um is more than 100 mm; is the unit um?")
    for name in given:
        values = table.numbers(name)
        for row in np.flatnonzero(values <= 0)[:1]:
            raise table.fail(int(row), name, f"{values[row]:g} is no standard uncertainty; it must be above zero")
    return table


def _check_uncertainties(tables: Sequence[CsvTable]) -> None:
    having = [any(name in table.columns for name in UNCERTAINTY_COLUMNS) for table in tables]
    if any(having) and not all(having):
        table = tables[having.index(False)]
        raise InputError(
            "lacks the uncertainties (u_dx_um ...) that another file has; give them in every file", file=table.path
        )


def _components(tables: Sequence[CsvTable], names: Sequence[str]) -> FloatArray:
    """Columns ``names`` in mm (n, 3), nan where a file lacks one."""
    blocks = []
    for table in tables:
        columns = [table.numbers(n) if n in table.columns else np.full(len(table), np.nan) for n in names]
        blocks.append(np.column_stack(columns) * MM_PER_UM)
    return np.concatenate(blocks)


def format_deviations(deviations: Deviations) -> str:
    """Return the text of a ``*.deviations.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4.

    A component must be measured everywhere or nowhere.
    """
    columns: dict[str, FloatArray] = dict(zip(POSITION_COLUMNS, deviations.position_mm.T, strict=True))
    digits: dict[str, int] = {}
    for names, values in ((DEVIATION_COLUMNS, deviations.deviation_mm), (UNCERTAINTY_COLUMNS, deviations.u_mm)):
        for k, name in enumerate(names):
            if values is not None and not np.isnan(values[:, k]).all():
                columns[name] = values[:, k] / MM_PER_UM
                digits[name] = 4
    for name, labels in deviations.labels.items():
        columns[name] = labels.astype(np.float64)
        digits[name] = 0
    if deviations.approach is not None:
        columns |= dict(zip(APPROACH_COLUMNS, deviations.approach.T, strict=True))
        digits |= dict.fromkeys(APPROACH_COLUMNS, 0)
    if deviations.tool_mm is not None:
        columns |= dict(zip(TOOL_COLUMNS, deviations.tool_mm.T, strict=True))
    columns |= dict(deviations.covariates)
    return format_csv(columns, deviations.metadata, digits)
