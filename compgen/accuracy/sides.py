"""What stands on the two sides of a comparison: error files, measurements of any kind, predictions."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.accuracy.diagonals import DiagonalRun, diagonal_runs
from compgen.accuracy.field import Field
from compgen.accuracy.pairing import MeasuredField, measured_field
from compgen.accuracy.reversal import KnownReversal, identified_reversal, reversal_beside
from compgen.accuracy.runs import RunStatistics, axis_statistics
from compgen.accuracy.source import ErrorSource, error_source
from compgen.controllers.isg.error_files import read_error_file
from compgen.controllers.isg.etalon_exchange import is_exchange_text
from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import names_in_header, read_csv
from compgen.core.deviations import Deviations
from compgen.core.diagonals import read_diagonals
from compgen.core.error_table import ERROR_COLUMNS, ErrorTable
from compgen.core.files import read_bytes, sha256_of
from compgen.core.lengths import POSITION_COLUMNS, Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.errors import CompgenWarning, InputError
from compgen.identify import Identification, IdentifyOptions, identify_measurement, joint_covariance, read_measurement
from compgen.identify.covariance import Covariance, read_covariance
from compgen.identify.measurement import Measurement

#: Bytes that tell what a file is.
_LOOKED_AT = 1_000_000
#: Reads the files of one measurement, with the constants of a six-DOF instrument.
Reader = Callable[[Sequence[str | Path], Path | None], Measurement | ErrorTable]
PREDICTED_COLUMNS = ("ex_um", "ey_um", "ez_um")


NOT_KNOWN = KnownReversal(None, "reversal: not known: errors are means of both directions")


@dataclass(frozen=True)
class Side:
    """One side as it was read: ``kind`` in words, and of the rest what that kind has.

    ``deviations`` and ``lengths`` are identified when errors are asked for (:meth:`errors`); ``predicted`` is a field at
    points.
    """

    machine: Machine
    path: Path
    kind: str
    source: ErrorSource | None = None
    deviations: Deviations | None = None
    lengths: Lengths | None = None
    runs: dict[str, RunStatistics] | None = None
    diagonals: dict[str, DiagonalRun] | None = None
    predicted: Field | None = None
    reversal: KnownReversal = NOT_KNOWN
    u_um: float | None = None

    def errors(self) -> Side:
        """Return the side with a source of errors: identified if it is a measurement, with its warnings."""
        if self.source is not None:
            return self
        measurement = self.lengths or self.deviations
        if measurement is None:
            raise InputError(f"holds {self.kind}, from which the errors of the machine do not follow", file=self.path)
        chosen = IdentifyOptions(u_deviation_um=self.u_um if self.lengths is None else None)
        found = identify_measurement(self.machine, measurement, chosen)
        return replace(self, source=_source_of(self.machine, found), reversal=identified_reversal(found))

    def measured(self) -> MeasuredField:
        """Return measured positions as a field."""
        assert self.deviations is not None
        return measured_field(self.machine, self.deviations, self.u_um)


def read_side(
    machine: Machine,
    path: str | Path,
    instrument: Path | None = None,
    u_um: float | None = None,
    reader: Reader = read_measurement,
) -> Side:
    """Read an error file, a measurement, or predicted errors at points (the output of ``volcomp predict``).

    Parameters
    ----------
    machine : the machine.
    path : the file; its columns tell what it is. A folder stands for the errors that were identified there.
    instrument : constants of a six-DOF instrument, for ``*.sixdof.csv``.
    u_um : standard uncertainty of measured deviations, um; default the file's own.
    reader : of measurements; that of :mod:`compgen.imports` takes foreign files as well.
    """
    source = _errors_in(Path(path))
    text = read_bytes(source, _LOOKED_AT).decode("utf-8-sig", errors="replace")  # to tell the kind; readers are strict
    header = names_in_header(text)
    if is_exchange_text(text) or set(ERROR_COLUMNS) <= header:
        errors = read_error_file(source)
        known = error_source(machine, errors, covariance_beside(source, errors))
        return Side(machine, source, "errors", source=known, reversal=reversal_beside(source))
    if set(PREDICTED_COLUMNS) <= header:
        return Side(machine, source, "predicted errors at points", predicted=_read_predicted(machine, source))
    if {"diagonal", "deviation_um"} <= header or source.name.lower().endswith(".diagonals.csv"):
        return Side(machine, source, "measured diagonals", diagonals=diagonal_runs(machine, read_diagonals(source)))
    holds_sixdof = "y_qd1_mm" in header
    measurement = reader([source], instrument if holds_sixdof else None)
    if isinstance(measurement, ErrorTable):
        return Side(machine, source, "errors", source=error_source(machine, measurement))
    if isinstance(measurement, AxisRuns):
        return Side(machine, source, "axis runs", runs=axis_statistics(measurement))
    if isinstance(measurement, Deviations):
        return Side(machine, source, "measured positions", deviations=measurement, u_um=u_um)
    if isinstance(measurement, Lengths):
        return Side(machine, source, "tracer lengths", lengths=measurement)
    found = identify_measurement(machine, measurement)
    known = _source_of(machine, found)
    return Side(machine, source, "six-DOF readings", source=known, reversal=identified_reversal(found))


def _errors_in(path: Path) -> Path:
    """Return the file of a folder that a command wrote; a file as it is."""
    if not path.is_dir():
        return path
    found = path / "identified.errors.csv"
    if not found.is_file():
        raise InputError("is a folder without identified.errors.csv; give the file that is meant", file=path)
    return found


def covariance_beside(path: Path, errors: ErrorTable) -> Covariance | None:
    """Return the covariance file that an errors file names, if it lies beside it and belongs to it; warn if it does not."""
    name = errors.metadata.get("covariance")
    beside = path.parent / name if name else None
    if beside is None or not beside.is_file():
        return None
    found = read_covariance(beside)
    if found.errors_sha256 == sha256_of(read_bytes(path)):
        return found
    message = f"{beside} belongs to another version of {path.name}; u_value counts, independent from node to node"
    warnings.warn(message, CompgenWarning, stacklevel=2)
    return None


def _source_of(machine: Machine, found: Identification) -> ErrorSource:
    return error_source(machine, found.errors, joint_covariance(found) if found.has_covariance else None)


def _read_predicted(machine: Machine, path: Path) -> Field:
    """Predicted errors at points as a field without uncertainty of its own."""
    table = read_csv(path, (*POSITION_COLUMNS, *PREDICTED_COLUMNS), ("tool_x_mm", "tool_y_mm", "tool_z_mm"))
    position = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    error = np.column_stack([table.numbers(name) for name in PREDICTED_COLUMNS]) * MM_PER_UM
    tool = np.array(machine.tool_offset_mm)
    if "tool_x_mm" in table.columns:
        tool = np.column_stack([table.numbers(f"tool_{k}_mm") for k in "xyz"])
        if np.max(np.abs(tool - np.array(machine.tool_offset_mm))) > 1e-6:
            raise InputError("has another tool offset than the machine; predict with the machine's own", file=path)
    return Field(position, position + tool, error, lambda _: 0.0)
