"""Raw readings of the six-DOF instrument: ``*.sixdof.csv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.records import AXIS, RUN, Field, Schema, within
from compgen.errors import InputError

SPOTS = ("y_qd1_mm", "z_qd1_mm", "z_qd2_mm", "y_psd1_mm", "z_psd1_mm", "y_psd2_mm", "z_psd2_mm")


@dataclass(frozen=True)
class SixDof:
    """Readings of runs along axes, n rows, one per target position.

    Parameters
    ----------
    axis : 0, 1, 2 of each row, (n,).
    position_mm : commanded position of that axis, (n,).
    run : number of the run, (n,).
    signals_mm : by column name, each (n,): spots, angles times focal length, interferometer; ``y_qd2_mm`` if present.
    distance_mm : absolute optical distance L of each row, nan if not given, (n,).
    direction : sign of travel, 0 if not given, (n,).
    covariates : ``time_s``, air and temperatures by column name, each (n,); ``phase_rad`` if the interferometer's
        phase was given instead of its displacement, which is then nan until :func:`compensated` computes it.
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


def _signal(table: CsvTable, column: str) -> FloatArray:
    """Read a signal; a spot farther out than any detector is wide indicates a wrong unit."""
    return (
        within(50.0, "mm", "exceeds the range of any detector; is the unit mm?")
        if column in SPOTS
        else CsvTable.numbers
    )(table, column)


_SIXDOF = Schema(
    (
        AXIS,
        Field("position_mm", ("position_mm",)),
        RUN,
        Field("signals_mm", (*SPOTS, "displacement_mm", "y_qd2_mm"), _signal, digits=9, presence="each"),
        Field("distance_mm", ("distance_mm",), presence="filled"),
        Field("direction", ("direction",), CsvTable.signs, digits=0, presence="filled", fill=0.0),
        # phase of an interferometer that does not output displacement; time, air and temperatures
        Field(
            "covariates", ("phase_rad", "time_s", "pressure_hpa", "humidity_percent"), digits=3, presence="covariates"
        ),
    ),
    keys=("axis", "position_mm", "run", "direction"),
    needed=SPOTS,
)


def read_sixdof(files: str | Path | Sequence[str | Path]) -> SixDof:
    """Read one or more ``*.sixdof.csv`` files strictly; the same run in two files is an error."""
    tables = _SIXDOF.read_tables(files)
    seen: dict[tuple[str, str], Path] = {}
    for table in tables:
        for key in dict.fromkeys(zip(table.columns["axis"], table.columns["run"], strict=True)):
            if key in seen:
                message = f"run {key[1]} of {key[0]} is also in {seen[key]}; number the runs of all files"
                raise InputError(message, file=table.path, field="column run")
            seen[key] = table.path
    for table in tables:  # each file needs exactly one kind of interferometer reading
        kinds = [name for name in ("displacement_mm", "phase_rad") if name in table.columns]
        if len(kinds) != 1:
            message = "contains both of them" if kinds else "contains neither of them"
            field = "columns displacement_mm, phase_rad"
            raise InputError(
                f"{message}; give the one that was read from the interferometer", file=table.path, field=field
            )
        if kinds[0] not in tables[0].columns:
            raise InputError(
                f"has {kinds[0]}, but {tables[0].path} does not; use the same column in all files", file=table.path
            )
    parts = [SixDof(**_SIXDOF.values(table)) for table in tables]
    # the displacement is nan if the phase was read; the second spot counts only if all files have it
    second = ("y_qd2_mm",) if all("y_qd2_mm" in part.signals_mm for part in parts) else ()
    names = (*SPOTS, "displacement_mm", *second)
    for k, part in enumerate(parts):
        unknown = np.full(len(part), np.nan)
        parts[k] = replace(part, signals_mm={name: part.signals_mm.get(name, unknown) for name in names})
    return _SIXDOF.joined(parts)


def format_sixdof(readings: SixDof) -> str:
    """Return the text of a ``*.sixdof.csv`` file: signals in mm, 9 decimals; without columns not known in all rows."""
    signals = {name: values for name, values in readings.signals_mm.items() if not np.isnan(values).any()}
    unknown = {"distance_mm"} if np.isnan(readings.distance_mm).any() else set()
    unknown |= set() if readings.direction.any() else {"direction"}
    schema = Schema(tuple(field for field in _SIXDOF.fields if field.name not in unknown))
    return schema.format(replace(readings, signals_mm=signals), readings.metadata, decimals={"phase_rad": 6})
