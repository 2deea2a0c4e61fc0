"""The door through which commands take files: the project's own as they are, foreign ones converted in memory."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.core.axis_runs import AxisRuns, check_single, read_axis_runs
from compgen.core.csvio import CsvTable, FloatArray, read_csv
from compgen.core.deviations import Deviations, read_deviations
from compgen.core.diagonals import read_diagonals
from compgen.core.error_table import ErrorTable, read_errors
from compgen.core.lengths import Lengths, read_lengths
from compgen.core.parts import read_parts
from compgen.errors import CompgenWarning, InputError
from compgen.identify.axis_runs import positioning_errors
from compgen.identify.measurement import Measurement, read_measurement
from compgen.imports.recognise import import_file, own_kind
from compgen.imports.result import Imported, ImportOptions
from compgen.sixdof.readings import read_sixdof

Plain = Lengths | Deviations | AxisRuns
#: So many labels of a column are shown.
_SHOWN_LABELS = 8
_OWN_READERS: dict[str | None, Callable[[Path], Plain]] = {
    "lengths": read_lengths,
    "deviations": read_deviations,
    "axis": read_axis_runs,
    "part": read_parts,
}


def open_measurement(
    paths: Sequence[str | Path], instrument: str | Path | None = None, axis: str | None = None
) -> Measurement | ErrorTable:
    """Read measurement files, the project's own and foreign ones; a foreign file of errors gives those.

    Parameters
    ----------
    paths : files of one kind (lengths, deviations, axis runs); six-DOF readings as ``read_measurement`` takes them.
    instrument : the instrument TOML of six-DOF readings.
    axis : the axis of foreign files that measure along one and do not say which; files of the project's own do.

    Raises
    ------
    InputError
        for a foreign file that leaves something open (unit, sign, axis, direction), with what ``volcomp import`` needs.
    """
    kinds = [own_kind(Path(path)) for path in paths]
    if axis is not None and any(kinds):
        known = paths[[kind is not None for kind in kinds].index(True)]
        raise InputError("says itself what it holds; --axis is for files of instruments", file=known, field="--axis")
    if not paths or all(kinds) or "sixdof" in kinds or instrument is not None:
        return read_measurement(paths, instrument)
    if len(paths) == 1 and kinds == [None] and _is_unknown_csv(Path(paths[0])):
        return read_measurement(paths, instrument)
    if len(paths) == 1:
        return _measured_or_errors(Path(paths[0]), axis)
    parts: list[Plain] = [_measured(Path(path), kind, axis) for path, kind in zip(paths, kinds, strict=True)]
    if len({type(part) for part in parts}) > 1:
        raise InputError("holds another kind of measurement than the first file; identify them one after the other",
                         file=paths[-1])  # fmt: skip
    return _joined(parts if any(kinds) else _on_one_clock(parts))


def describe_own(path: Path, kind: str) -> tuple[dict[str, Any], object]:
    """Return what a file of the project's own format holds, in words and numbers, and its object.

    Raises
    ------
    InputError
        for a file that its reader refuses.
    """
    readers: dict[str, Callable[[Path], object]] = {
        "errors": read_errors, "diagonals": read_diagonals, "sixdof": read_sixdof,
        **{name: read for name, read in _OWN_READERS.items() if name},
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


def _on_one_clock(parts: Sequence[Plain]) -> list[Plain]:
    """Let the times of several imported files count from the earliest of them, where all say when they were measured."""
    begun = [part.metadata.get("measured_at", "") for part in parts]
    if not all(begun) or not all("time_s" in part.covariates for part in parts):
        return list(parts)
    times = [datetime.fromisoformat(text) for text in begun]
    if len({time.tzinfo is None for time in times}) > 1:
        return list(parts)
    ahead = [(time - min(times)).total_seconds() for time in times]
    return [
        replace(part, covariates={**part.covariates, "time_s": part.covariates["time_s"] + later})
        for part, later in zip(parts, ahead, strict=True)
    ]


def _measured_or_errors(path: Path, axis: str | None) -> Plain | ErrorTable:
    data = _settled(path, axis).data
    if isinstance(data, Lengths | Deviations | AxisRuns | ErrorTable):
        return data
    raise InputError("holds a capture over time, from which no errors are identified", file=path)


def _is_unknown_csv(path: Path) -> bool:
    """Whether a file is meant to be one of the project's own, so that its own reader says best what is missing."""
    own = (".lengths.csv", ".deviations.csv", ".axis.csv", ".sixdof.csv", ".part.csv")
    return path.name.lower().endswith(own)


def _measured(path: Path, kind: str | None, axis: str | None) -> Plain:
    if kind in _OWN_READERS:
        return _OWN_READERS[kind](path)
    item = _settled(path, axis)
    if not isinstance(item.data, Lengths | Deviations | AxisRuns):
        hint = "; errors go to fit, export and verify" if isinstance(item.data, ErrorTable) else ""
        raise InputError(f"holds {item.kind}, no measurement that errors are identified from{hint}", file=path)
    return item.data


def _settled(path: Path, axis: str | None = None) -> Imported:
    item = import_file(path, ImportOptions(axis=axis))
    item.check_settled()
    facts = "; ".join([f"{item.format}, {item.kind}", *item.notes])
    warnings.warn(f"{path} was taken as: {facts} ('volcomp import' shows all)", CompgenWarning, stacklevel=3)
    return item


def open_errors(path: str | Path) -> ErrorTable:
    """Read errors: ``*.errors.csv``, or a foreign file with errors, or with axis runs (their two-way means).

    Raises
    ------
    InputError
        for a foreign file that leaves something open, or holds neither.
    """
    source = Path(path)
    kind = own_kind(source)
    if kind == "errors" or (kind is None and source.name.lower().endswith(".errors.csv")):
        return read_errors(source)
    if kind not in (None, "axis"):
        raise InputError(f"holds {kind}, not errors; identify them first", file=source)
    data = read_axis_runs(source) if kind == "axis" else _settled(source).data
    if isinstance(data, AxisRuns):
        table, reversal, _ = positioning_errors(data, data.metadata)
        if reversal is not None:
            text = "has a reversal, which the mean of both directions does not hold; identify and run take both"
            warnings.warn(f"{source}: {text}", CompgenWarning, stacklevel=2)
        return table
    if not isinstance(data, ErrorTable):
        raise InputError("holds a measurement, not errors; identify it first", file=source)
    return data


def _joined(parts: Sequence[Plain]) -> Plain:
    """Return several measurements of one kind as one."""
    first = parts[0]
    if isinstance(first, AxisRuns):
        return _joined_runs([part for part in parts if isinstance(part, AxisRuns)])
    points = [part for part in parts if isinstance(part, Lengths | Deviations)]
    common: dict[str, Any] = {
        "position_mm": np.concatenate([part.position_mm for part in points]),
        "tool_mm": _tools(points),
        "approach": _approaches(points),
        "labels": _labels(points),
        "covariates": _covariates(parts),
        "origin": [place for part in parts for place in part.origin],
    }
    if isinstance(first, Lengths):
        lengths = [part for part in parts if isinstance(part, Lengths)]
        stations = tuple(dict.fromkeys(name for part in lengths for name in part.stations))
        number = [[stations.index(part.stations[k]) for k in part.station] for part in lengths]
        return replace(
            first,
            stations=stations,
            station=np.concatenate(number).astype(np.int64),
            point=[point for part in lengths for point in part.point],
            length_mm=np.concatenate([part.length_mm for part in lengths]),
            **common,
        )
    moved = [part for part in parts if isinstance(part, Deviations)]
    if any((part.u_mm is None) != (moved[0].u_mm is None) for part in moved):
        raise InputError("some files state uncertainties and some do not; give them in every file")
    u_mm = None if moved[0].u_mm is None else np.concatenate([part.u_mm for part in moved if part.u_mm is not None])
    return replace(first, deviation_mm=np.concatenate([part.deviation_mm for part in moved]), u_mm=u_mm, **common)


def _joined_runs(parts: Sequence[AxisRuns]) -> AxisRuns:
    runs = AxisRuns(
        **{
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("axis", "position_mm", "direction", "run", "deviation_mm")
        },
        covariates=_covariates(parts),
        metadata={key: value for part in reversed(parts) for key, value in part.metadata.items()},
        origin=[place for part in parts for place in part.origin],
    )
    check_single(runs)
    return runs


def _tools(parts: Sequence[Lengths | Deviations]) -> FloatArray | None:
    known = [part.tool_mm for part in parts if part.tool_mm is not None]
    if known and len(known) < len(parts):
        raise InputError("some files state the tool (tool_x_mm ...) and some do not; give it in every file")
    return np.concatenate(known) if known else None


def _approaches(parts: Sequence[Lengths | Deviations]) -> FloatArray | None:
    if all(part.approach is None for part in parts):
        return None
    return np.concatenate(
        [np.zeros_like(part.position_mm) if part.approach is None else part.approach for part in parts]
    )


def _labels(parts: Sequence[Lengths | Deviations]) -> dict[str, NDArray[np.int64]]:
    names = dict.fromkeys(name for part in parts for name in part.labels)
    return {
        name: np.concatenate([part.labels.get(name, np.zeros(len(part), dtype=np.int64)) for part in parts])
        for name in names
    }


def _covariates(parts: Sequence[Plain]) -> dict[str, FloatArray]:
    names = dict.fromkeys(name for part in parts for name in part.covariates)
    return {
        name: np.concatenate([part.covariates.get(name, np.full(len(part), np.nan)) for part in parts])
        for name in names
    }
