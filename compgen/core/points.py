"""Lists of commanded points: ``*.points.csv`` of the contract, with or without results beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compgen.core.csvio import FloatArray, format_csv, read_csv
from compgen.core.lengths import APPROACH_COLUMNS, POSITION_COLUMNS, TOOL_COLUMNS
from compgen.errors import InputError

#: Columns that effects of a machine may depend on, beside ``temp_<name>_c``.
COVARIATES = ("time_s", "feed_mm_min", "load_kg", "setup")


@dataclass(frozen=True)
class Points:
    """Commanded points, n of them.

    Parameters
    ----------
    position_mm : shape (n, 3).
    tool_mm : tool offset at each point, shape (n, 3), or None for the machine's own.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    covariates : further numbers by column name (time_s, feed_mm_min, load_kg, setup, temp_<name>_c), each (n,).
    """

    position_mm: FloatArray
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position_mm)


def read_points(path: str | Path) -> Points:
    """Read a ``*.points.csv`` file; tool and approach columns are optional, but each complete."""
    table = read_csv(
        path,
        required=POSITION_COLUMNS,
        optional=(*TOOL_COLUMNS, *APPROACH_COLUMNS, *COVARIATES),
        prefixes=("temp_*_c",),
    )
    groups: list[FloatArray | None] = []
    for names in (TOOL_COLUMNS, APPROACH_COLUMNS):
        present = [name for name in names if name in table.columns]
        if present and len(present) < 3:
            raise InputError(f"has {present[0]} but not all of {', '.join(names)}", file=table.path)
        read = table.signs if names is APPROACH_COLUMNS else table.numbers
        groups.append(np.column_stack([read(name) for name in names]) if present else None)
    position_mm = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    further = [name for name in table.columns if name in COVARIATES or name.startswith("temp_")]
    return Points(position_mm, groups[0], groups[1], {name: table.numbers(name) for name in further})


def format_points(
    points: Points, results: Mapping[str, FloatArray], metadata: Mapping[str, object] | None = None
) -> str:
    """Return CSV text of the points with result columns (each of shape (n,)) beside them, 6 decimals."""
    columns: dict[str, FloatArray] = dict(zip(POSITION_COLUMNS, points.position_mm.T, strict=True))
    if points.tool_mm is not None:
        columns |= dict(zip(TOOL_COLUMNS, points.tool_mm.T, strict=True))
    if points.approach is not None:
        columns |= dict(zip(APPROACH_COLUMNS, points.approach.T, strict=True))
    return format_csv({**columns, **points.covariates, **results}, metadata)
