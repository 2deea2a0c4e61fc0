"""Raw readings of the six-DOF instrument: ``*.sixdof.csv`` of the contract."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import CsvTable, FloatArray, format_csv, header_columns, read_csv
from compgen.core.lengths import check_distinct, check_repeats, common_metadata, origins
from compgen.core.names import AXES
from compgen.errors import InputError

SPOTS = ("y_qd1_mm", "z_qd1_mm", "z_qd2_mm", "y_psd1_mm", "z_psd1_mm", "y_psd2_mm", "z_psd2_mm")
REQUIRED = ("axis", "position_mm", "run", *SPOTS)
#: Air and time, kept as covariates beside the temperatures.
COVARIATES = ("time_s", "pressure_hpa", "humidity_percent")
OPTIONAL = ("displacement_mm", "phase_rad", "y_qd2_mm", "distance_mm", "direction", *COVARIATES)


@dataclass(frozen=True)
class SixDof:
    """Readings of runs along axes, n rows, one a target position.

    Parameters
    ----------
    axis : 0, 1, 2 of each row, (n,).
    position_mm : commanded position of that axis, (n,).
    run : number of the run, (n,).
    signals_mm : by column name, each (n,): spots, angles times focal length, interferometer; ``y_qd2_mm`` if it is there.
    distance_mm : absolute optical distance L of each row, nan where it is not given, (n,).
    direction : sign of travel, 0 where it is not given, (n,).
    covariates : ``time_s``, air and temperatures by column name, each (n,); ``phase_rad`` where the interferometer's
        phase was given in place of its displacement, which then is nan until :func:`compensated` has made it.
    metadata : comments ``key = value``.
    origin : (file, line) of each row.
    """

    axis: NDArray[np.int64]
    position_mm: FloatArray
    run: NDArray[np.int64]
    signals_mm: Mapping[str, FloatArray]
    distance_mm: FloatArray
    direction: FloatArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.position_mm)

    def runs(self) -> list[tuple[int, int, NDArray[np.int64]]]:
        """Return (axis, run, rows in their order) of every run, in the order of their first rows."""
        keys = list(dict.fromkeys(zip(self.axis.tolist(), self.run.tolist(), strict=True)))
        return [(axis, run, np.flatnonzero((self.axis == axis) & (self.run == run))) for axis, run in keys]


def holds_sixdof(path: str | Path) -> bool:
    """Whether the header of a file is that of six-DOF readings."""
    names = header_columns(path)
    return "y_psd1_mm" in names or {"axis", "displacement_mm"} <= names or "y_qd1_mm" in names


def read_sixdof(paths: str | Path | Sequence[str | Path]) -> SixDof:
    """Read one or more ``*.sixdof.csv`` files strictly; the same run in two files is an error."""
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [_read_table(path) for path in files]
    check_distinct(tables)
    _check_runs(tables)

    def numbers(name: str, empty: float) -> FloatArray:
        return np.concatenate(
            [table.numbers(name) if name in table.columns else np.full(len(table), empty) for table in tables]
        )

    _check_alike(tables)
    signals = {name: numbers(name, np.nan) for name in (*SPOTS, "displacement_mm")}
    if all("y_qd2_mm" in table.columns for table in tables):
        signals["y_qd2_mm"] = numbers("y_qd2_mm", np.nan)
    kept = (*COVARIATES, "phase_rad")
    extra = dict.fromkeys(n for table in tables for n in table.columns if n in kept or n.startswith("temp_"))
    return SixDof(
        axis=np.concatenate([_axes_of(table) for table in tables]),
        position_mm=numbers("position_mm", np.nan),
        run=np.concatenate([table.labels("run") for table in tables]),
        signals_mm=signals,
        distance_mm=numbers("distance_mm", np.nan),
        direction=np.concatenate(
            [table.signs("direction") if "direction" in table.columns else np.zeros(len(table)) for table in tables]
        ),
        covariates={name: numbers(name, np.nan) for name in extra},
        metadata=common_metadata(tables),
        origin=origins(tables),
    )


def _read_table(path: str | Path) -> CsvTable:
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL, prefixes=("temp_*_c",))
    check_repeats(table, ("axis", "position_mm", "run", *(("direction",) if "direction" in table.columns else ())))
    for name in SPOTS:
        values = table.numbers(name)
        for row in np.flatnonzero(np.abs(values) > 50.0)[:1]:
            raise table.fail(int(row), name, f"{values[row]:g} mm is beyond any detector; is the unit mm?")
    return table


def _check_alike(tables: Sequence[CsvTable]) -> None:
    """The interferometer's reading is there once, and of one kind in all files."""
    for table in tables:
        kinds = [name for name in ("displacement_mm", "phase_rad") if name in table.columns]
        if len(kinds) != 1:
            message = "holds both of them" if kinds else "holds neither of them"
            field = "columns displacement_mm, phase_rad"
            raise InputError(f"{message}; give the one that the interferometer read", file=table.path, field=field)
        if kinds[0] not in tables[0].columns:
            raise InputError(f"has {kinds[0]}, but {tables[0].path} has not; give all files alike", file=table.path)


def _axes_of(table: CsvTable) -> NDArray[np.int64]:
    cells = table.text("axis")
    for row, cell in enumerate(cells):
        if cell not in AXES:
            raise table.fail(row, "axis", f"{cell!r} is not an axis; X, Y or Z is due")
    return np.array([AXES.index(cell) for cell in cells], dtype=np.int64)


def _check_runs(tables: Sequence[CsvTable]) -> None:
    seen: dict[tuple[str, str], Path] = {}
    for table in tables:
        for key in dict.fromkeys(zip(table.columns["axis"], table.columns["run"], strict=True)):
            if key in seen:
                message = f"run {key[1]} of {key[0]} stands in {seen[key]} too; number the runs of all files"
                raise InputError(message, file=table.path, field="column run")
            seen[key] = table.path


def format_sixdof(readings: SixDof) -> str:
    """Return the text of a ``*.sixdof.csv`` file: signals and positions with 9 decimals of a mm."""
    columns: dict[str, Sequence[str] | FloatArray] = {
        "axis": [AXES[k] for k in readings.axis],
        "position_mm": readings.position_mm,
        "run": readings.run.astype(np.float64),
        **{name: values for name, values in readings.signals_mm.items() if not np.isnan(values).any()},
    }
    digits = dict.fromkeys(readings.signals_mm, 9) | {"run": 0, "direction": 0}
    if not np.isnan(readings.distance_mm).any():
        columns["distance_mm"] = readings.distance_mm
    if readings.direction.any():
        columns["direction"] = readings.direction
    for name, values in readings.covariates.items():
        columns[name] = values
        digits[name] = 6 if name == "phase_rad" else 3
    return format_csv(columns, readings.metadata, digits)
