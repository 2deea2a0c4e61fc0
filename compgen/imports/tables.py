"""From a foreign table to the objects of the project: what kind it is, and what each kind needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from compgen.core.axis_runs import AxisRuns, check_single
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.names import AXES, MM_PER_UM, RAD_PER_URAD
from compgen.core.reversal import ReversalCurves
from compgen.core.text import doubled
from compgen.errors import InputError
from compgen.identify.axis_runs import POSITIONING, two_way_mean
from compgen.imports.columns import error_columns, fields_of
from compgen.imports.findings import Findings
from compgen.imports.further import further_of, metadata_of
from compgen.imports.grid import Grid, find_table
from compgen.imports.one_axis import OneAxis, check_error, errors_of
from compgen.imports.result import Data, Imported, ImportOptions, Kind
from compgen.imports.source import shown
from compgen.imports.table_axis import axis_readings
from compgen.imports.table_errors import long_errors, squareness_in, wide_errors
from compgen.imports.table_points import deviations_of, lengths_of

#: So many lines above a table are shown.
_MOST_HEADER = 12


def import_table(grid: Grid, options: ImportOptions, form: str = "table") -> Imported:
    """Import one table, or a list of squareness errors; InputError if it is none or lacks what its kind needs."""
    try:
        return _import_table(grid, options, form)
    except InputError:
        found = squareness_in(grid)
        if found is None:
            raise
    errors, doubts = found
    understood = {"squareness_urad": {name: value / RAD_PER_URAD for name, (value, _) in errors.squareness.items()}}
    return Imported(grid.path, form, "errors", errors, understood, tuple(doubts), grid.notes)


def _import_table(grid: Grid, options: ImportOptions, form: str) -> Imported:
    table = find_table(grid, options.decimal)
    findings = Findings(table, fields_of(table.header, options.columns, options.ignore), options)
    findings.notes.extend(table.grid.notes)
    _along_one_axis(findings)
    kind = options.kind or _kind(findings)
    findings.understood["columns"] = {key: column.name for key, column in findings.fields.items()}
    if table.metadata:
        findings.understood["header"] = dict(list(table.metadata.items())[:_MOST_HEADER])
    reversal: ReversalCurves | None = None
    data: Data
    if kind == "lengths":
        _need(findings, "length")
        data = lengths_of(findings)
    elif kind == "deviations":
        data = deviations_of(findings)
    elif kind == "errors" and options.error is None:
        columns = error_columns(table.header)
        if not columns:
            _need(findings, "error", "position", "value")
        else:
            _need(findings, "position")
        data = wide_errors(findings, columns) if columns else long_errors(findings)
        data = data.replace(metadata=metadata_of(findings, further_of(findings, "errors")))
    else:
        _need(findings, "position")
        data, reversal, kind = _along_axes(findings)
    return Imported(
        grid.path,
        form,
        kind,
        data,
        findings.understood,
        tuple(dict.fromkeys(findings.doubts)),
        tuple(dict.fromkeys(findings.notes)),
        reversal,
    )


def _along_one_axis(findings: Findings) -> None:
    """Take the one coordinate that a table has as position, and its deviation with it: X [mm], dX [um]."""
    letters = [axis for axis in "xyz" if axis in findings.fields]
    own = [axis for axis in "xyz" if f"d{axis}" in findings.fields or f"{axis}a" in findings.fields]
    if "position" in findings.fields:
        letters = []
    if len(letters) > 1 or len({*letters, *own}) != 1 or findings.options.kind not in (None, "axis"):
        return
    (axis,) = {*letters, *own}
    names = {axis: "position"} if letters else {}
    findings.checked_sign = f"d{axis}" in findings.fields
    names |= {
        old: new for old, new in ((f"d{axis}", "deviation"), (f"{axis}a", "actual")) if new not in findings.fields
    }
    findings.fields = {names.get(key, key): column for key, column in findings.fields.items()}
    if "axis" not in findings.fields and findings.options.axis is None and findings.options.error is None:
        findings.letter = axis.upper()


def _kind(findings: Findings) -> Kind:
    fields = findings.fields
    space = {"x", "y", "z"} <= set(fields)
    if space and "length" in fields:
        return "lengths"
    if space and not {"dx", "dy", "dz", "xa", "ya", "za"}.isdisjoint(fields):
        return "deviations"
    if "position" in fields and (error_columns(findings.table.header) or {"error", "value"} <= set(fields)):
        return "errors"
    if "position" in fields:
        return "axis"
    header = ", ".join(findings.table.header)
    raise findings.table.grid.fail(
        f"its columns are not known: {shown(header)}; say what they are: --map position=COLUMN --map deviation=COLUMN (axis "
        "runs), x y z length (lengths), x y z dx dy dz (deviations), error position value (errors)",
        findings.table.header_line,
    )


def _need(findings: Findings, *keys: str) -> None:
    for key in keys:
        if key not in findings.fields:
            header = ", ".join(findings.table.header)
            raise findings.table.grid.fail(
                f"no column is known as {key}; the header has {shown(header)}; give --map {key}=COLUMN",
                findings.table.header_line,
            )


def _along_axes(findings: Findings) -> tuple[Data, ReversalCurves | None, Kind]:
    error = findings.options.error
    angular = error is not None and error[1:2] in ("A", "B", "C")
    found, further = axis_readings(findings, angular=angular)
    metadata = metadata_of(findings, further)
    path = findings.table.grid.path
    if error is not None:
        if len(found) > 1:
            raise InputError("holds several axes; --error names the error of one", file=path)
        ((letter, runs),) = found.items()
        check_error(error, letter or None, angular=angular)
        findings.understood |= _described(runs, 1e-6 if angular else MM_PER_UM)
        findings.doubts[:] = [text for text in findings.doubts if "--axis" not in text]
        table, reversal = errors_of(runs, error, metadata)
        return table, reversal, "errors"
    findings.understood["axes"] = {letter or "?": _described(runs, MM_PER_UM) for letter, runs in found.items()}
    return runs_of(found, str(path), metadata), None, "axis"


def _described(runs: OneAxis, unit: float) -> dict[str, object]:
    facts = runs.summary()
    name = "um" if unit == MM_PER_UM else "urad"
    return {
        **{key: value for key, value in facts.items() if key not in ("rms", "largest")},
        **{f"{key}_{name}": float(facts[key]) / unit for key in ("rms", "largest")},  # type: ignore[arg-type]
    }


def runs_of(found: dict[str, OneAxis], file: str, metadata: dict[str, str]) -> AxisRuns:
    """Return the readings of all axes as one object; an axis that is not known counts as X until the user has said it."""
    parts = [(letter, item.ordered()) for letter, item in found.items()]
    runs = AxisRuns(
        axis=np.concatenate([np.full(len(item.value), AXES.index(letter or "X")) for letter, item in parts]),
        position_mm=np.concatenate([item.position_mm for _, item in parts]),
        direction=np.concatenate([item.direction for _, item in parts]),
        run=np.concatenate([item.run for _, item in parts]),
        deviation_mm=np.concatenate([item.value for _, item in parts]),
        covariates=_together([item.covariates for _, item in parts]),
        metadata=metadata,
        origin=[(file, int(line)) for _, item in parts for line in item.line],
    )
    check_single(runs)
    return runs


def merged_sheets(parts: Sequence[tuple[str, Imported]]) -> Imported:
    """Return several sheets of one workbook, each the runs of another axis or other errors, as one."""
    first = parts[0][1]
    kinds = {item.kind for _, item in parts}
    names = ", ".join(shown(name) for name, _ in parts)
    if len(parts) == 1:
        return first
    doubts = [f"sheet {name}: {text}" for name, item in parts for text in item.doubts]
    errors = [item.data for _, item in parts if isinstance(item.data, ErrorTable)]
    beside = None
    if kinds == {"axis"} or kinds == {"axis", "errors"}:
        data: Data = _joined_runs([item.data for _, item in parts if isinstance(item.data, AxisRuns)])
        beside = _joined_errors(first, errors) if errors else None
        doubts += _measured_twice(data, beside) if isinstance(data, AxisRuns) and beside else []
    elif kinds == {"errors"}:
        data = _joined_errors(first, errors)
    else:
        raise InputError(f"has several tables ({names}); choose one with --sheet", file=first.path)
    understood = {f"sheet {name}": dict(item.understood) for name, item in parts}
    notes = tuple(dict.fromkeys(text for _, item in parts for text in item.notes))
    kind: Kind = "errors" if kinds == {"errors"} else "axis"
    return replace(first, kind=kind, data=data, understood=understood, doubts=tuple(doubts), notes=notes, beside=beside)


def _measured_twice(runs: AxisRuns, beside: ErrorTable) -> list[str]:
    """Ask about errors of another sheet that the runs give as well, with the largest difference."""
    doubts = []
    for axis in runs.axes:
        name = POSITIONING[axis]
        if name not in beside.curves:
            continue
        own = runs.axis == axis
        mean, _, _ = two_way_mean(runs.position_mm[own], runs.direction[own], runs.deviation_mm[own])
        away = mean.value - beside.curves[name].at(mean.position_mm)
        doubts.append(
            f"a sheet holds {name}, and the runs of {AXES[axis]} give it as well (their means differ by up to "
            f"{np.abs(away).max() / MM_PER_UM:.3g} um); leave out one sheet with --ignore SHEET"
        )
    return doubts


def _together(parts: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return the numbers beside the readings that every part has, one after the other."""
    common = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in common}


def _joined_runs(parts: Sequence[AxisRuns]) -> AxisRuns:
    runs = AxisRuns(
        axis=np.concatenate([item.axis for item in parts]),
        position_mm=np.concatenate([item.position_mm for item in parts]),
        direction=np.concatenate([item.direction for item in parts]),
        run=np.concatenate([item.run for item in parts]),
        deviation_mm=np.concatenate([item.deviation_mm for item in parts]),
        covariates=_together([item.covariates for item in parts]),
        metadata=parts[0].metadata,
        origin=[place for item in parts for place in item.origin],
    )
    check_single(runs)
    return runs


def _joined_errors(first: Imported, parts: Sequence[ErrorTable]) -> ErrorTable:
    twice = doubled(name for item in parts for name in item.names)
    if twice is not None:
        raise InputError(f"{twice} stands on two sheets; choose one with --sheet", file=first.path)
    curves = {name: curve for item in parts for name, curve in item.curves.items()}
    squareness = {name: value for item in parts for name, value in item.squareness.items()}
    return ErrorTable(curves, squareness, parts[0].metadata)
