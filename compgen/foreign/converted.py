"""Foreign files converted in memory, and what a native file holds.

A file that leaves something open is refused with what ``volcomp import`` needs. :func:`given_errors` makes the errors of
another program usable like an identification.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.axis_runs import AxisRuns, join_axis_runs, read_axis_runs, read_diagonals
from compgen.data.csv_files import CsvTable, read_csv
from compgen.data.deviations import Deviations, join_deviations, read_deviations, read_parts
from compgen.data.error_table import ErrorTable, read_errors
from compgen.data.lengths import Lengths, join_lengths, read_lengths
from compgen.data.machine import Machine
from compgen.errors import CompgenWarning, InputError
from compgen.fit import FitOptions, fit
from compgen.foreign.detect import import_file
from compgen.foreign.findings import Imported, ImportOptions
from compgen.foreign.laser_files import Capture
from compgen.identify import Identification
from compgen.identify.identification import metadata_of, without_adjustment
from compgen.identify.single_axes import positioning_errors
from compgen.instruments.sixdof_readings import read_sixdof

Plain = Lengths | Deviations | AxisRuns
#: So many labels of a column are shown.
_SHOWN_LABELS = 8
_NATIVE_READERS: dict[str | None, Callable[[Path], Plain]] = {
    "lengths": read_lengths,
    "deviations": read_deviations,
    "axis": read_axis_runs,
    "part": read_parts,
}


def converted_measurement(
    paths: Sequence[str | Path], kinds: Sequence[str | None], axis: str | None = None
) -> Plain | ErrorTable:
    """Return what measurement files of which some are foreign hold; ``kinds`` are those of the native ones."""
    if len(paths) == 1:
        data = _settled(Path(paths[0]), axis).data
        if isinstance(data, Capture):
            raise InputError("holds a capture over time, from which no errors are identified", file=Path(paths[0]))
        return data
    parts: list[Plain] = [_measured(Path(path), kind, axis) for path, kind in zip(paths, kinds, strict=True)]
    if len({type(part) for part in parts}) > 1:
        raise InputError("holds another kind of measurement than the first file; identify them one after the other",
                         file=paths[-1])  # fmt: skip
    # where all imported files say when they were measured, their times count from the earliest of them
    dated = all(part.metadata.get("measured_at") and "time_s" in part.covariates for part in parts)
    begun = [datetime.fromisoformat(part.metadata["measured_at"]) for part in parts if dated and not any(kinds)]
    if len({time.tzinfo is None for time in begun}) == 1:
        for k, part in enumerate(parts):
            later = part.covariates["time_s"] + (begun[k] - min(begun)).total_seconds()
            parts[k] = replace(part, covariates={**part.covariates, "time_s": later})
    return _joined(parts)


def describe_native(path: Path, kind: str) -> tuple[dict[str, Any], object]:
    """Return what a native file holds, in words and numbers, and its object.

    Raises
    ------
    InputError
        for a file that its reader refuses.
    """
    readers: dict[str, Callable[[Path], object]] = {
        "errors": read_errors, "diagonals": read_diagonals, "sixdof": read_sixdof,
        **{name: read for name, read in _NATIVE_READERS.items() if name},
    }  # fmt: skip
    data = readers[kind](path)
    table = read_csv(path, (), (), ("*",))
    columns = {name: _described(table, name) for name in table.columns}
    return {"rows": len(table), "columns": columns, "comments": dict(table.metadata)}, data


def _described(table: CsvTable, name: str) -> str:
    """Return the range of a column of numbers, or how many labels another one has and the first of them."""
    try:
        values = table.numbers(name, empty=float("nan"))
    except InputError:
        labels = list(dict.fromkeys(table.columns[name]))
        return ", ".join(labels[:_SHOWN_LABELS]) + (f" ... ({len(labels)})" if len(labels) > _SHOWN_LABELS else "")
    known = values[np.isfinite(values)]
    return f"{known.min():.6g} to {known.max():.6g}" if known.size else "empty"


def _measured(path: Path, kind: str | None, axis: str | None) -> Plain:
    if kind in _NATIVE_READERS:
        return _NATIVE_READERS[kind](path)
    item = _settled(path, axis)
    if not isinstance(item.data, Lengths | Deviations | AxisRuns):
        hint = "; errors go to fit, export and verify" if isinstance(item.data, ErrorTable) else ""
        raise InputError(f"holds {item.kind}, from which no errors are identified{hint}", file=path)
    return item.data


def _settled(path: Path, axis: str | None = None) -> Imported:
    item = import_file(path, ImportOptions(axis=axis))
    item.check_settled()
    facts = "; ".join([f"{item.format}, {item.kind}", *item.notes])
    warnings.warn(f"{path} was taken as: {facts} ('volcomp import' shows all)", CompgenWarning, stacklevel=3)
    return item


def converted_errors(source: Path, kind: str | None) -> ErrorTable:
    """Return the errors of a foreign file, or of axis runs, also native ones (``kind`` "axis"): their two-way means."""
    data = read_axis_runs(source) if kind == "axis" else _settled(source).data
    if isinstance(data, AxisRuns):
        table, reversal, _ = positioning_errors(data, data.metadata)
        if reversal is not None:
            text = "has a reversal, which the mean of both directions does not hold; identify and run take both"
            warnings.warn(f"{source}: {text}", CompgenWarning, stacklevel=3)
        return table
    if not isinstance(data, ErrorTable):
        raise InputError("holds a measurement, not errors; identify it first", file=source)
    return data


def _joined(parts: Sequence[Plain]) -> Plain:
    """Several measurements of one kind as one."""
    if isinstance(parts[0], AxisRuns):
        return join_axis_runs([part for part in parts if isinstance(part, AxisRuns)])
    if isinstance(parts[0], Lengths):
        return join_lengths([part for part in parts if isinstance(part, Lengths)])
    return join_deviations([part for part in parts if isinstance(part, Deviations)])


# Errors that another program identified, in place of an identification here.


def given_errors(machine: Machine, table: ErrorTable) -> Identification:
    """Return errors of a foreign file as what an identification hands on.

    They are brought to the zeros that every identification has (positioning and angles at the reference point, straightness
    at both ends; squareness takes up the lines), without smoothing; ``details`` says what that moved.

    Raises
    ------
    InputError
        for errors that the machine's travel or chain does not fit.
    """
    zeroed = fit(machine, table, FitOptions(smoothness=0.0))
    errors = zeroed.errors.replace(
        metadata={**metadata_of(machine, table.metadata), "source": "given by another program"}
    )
    values = sum(len(curve.value) for curve in errors.curves.values()) + len(errors.squareness)
    known = bool(errors.curves) and all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    return replace(
        without_adjustment(machine, errors, np.zeros(values), "given" if known else "unknown", "not in the file"),
        rank=values,
        unknowns=values,
        iterations=0,
        method="given",
        details={
            "file": table.metadata.get("source", ""),
            "values": values,
            "frame_change": zeroed.to_dict()["frame_change"],
        },
    )
