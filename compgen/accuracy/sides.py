"""The two sides of a comparison: what each file contains, and which comparison applies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.accuracy.compare import (
    CompareOptions,
    Comparison,
    MeasuredField,
    agreement,
    check_same_positions,
    compare_diagonals,
    compare_errors,
    compare_fields,
    compare_runs,
    measured_field,
    paired_figures,
)
from compgen.accuracy.evaluate import (
    KnownReversal,
    identified_reversal,
    reversal_beside,
    reversal_figures,
    volume_fields,
)
from compgen.accuracy.field import Alignment, ErrorField, ErrorSource, aligned, error_source
from compgen.accuracy.positioning import DiagonalRun, RunStatistics, axis_statistics, diagonal_runs
from compgen.controls.isg_kernel import is_exchange_text, read_error_file
from compgen.data.axis_runs import AxisRuns, read_diagonals
from compgen.data.circles import Circles
from compgen.data.csv_files import FloatArray, names_in_header, read_csv
from compgen.data.deviations import Deviations
from compgen.data.error_table import ERROR_COLUMNS, ErrorTable
from compgen.data.files import read_bytes
from compgen.data.lengths import POSITION_COLUMNS, Lengths, Points
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError, Message, UndeterminedError
from compgen.identification import (
    Identification,
    IdentifyOptions,
    identify_measurement,
    joint_covariance,
    read_measurement,
)
from compgen.identification.covariance import covariance_named_by
from compgen.identification.kinds import Measurement
from compgen.tables import ReadTables

# What the two sides of a comparison can be: error files, measurements of any kind, predictions.


#: Bytes that identify the kind of a file.
_LOOKED_AT = 1_000_000
#: Reads the files of one measurement, with the constants of a six-DOF instrument.
Reader = Callable[[Sequence[str | Path], Path | None], "Measurement | ErrorTable"]
PREDICTED_COLUMNS = ("ex_um", "ey_um", "ez_um")


NOT_KNOWN = KnownReversal(None, "reversal: unknown: errors are means of both directions")


@dataclass(frozen=True)
class Side:
    """One side as read: ``kind`` in words, and the data of that kind.

    ``deviations`` and ``lengths`` are identified when errors are requested (:meth:`errors`); ``readings`` are those of
    ``runs``; ``predicted`` is a field at points. ``source`` has the errors that were measured, ``whole`` makes one that
    also has what is assumed of all others.
    """

    machine: Machine
    path: Path
    kind: str
    source: ErrorSource | None = None
    deviations: Deviations | None = None
    lengths: Lengths | None = None
    runs: dict[str, RunStatistics] | None = None
    readings: AxisRuns | None = None
    diagonals: dict[str, DiagonalRun] | None = None
    circles: Circles | None = None
    predicted: ErrorField | None = None
    reversal: KnownReversal = NOT_KNOWN
    u_um: float | None = None
    whole: Callable[[], ErrorSource] | None = None

    def errors(self) -> Side:
        """Return the side with a source of errors: identified if it is a measurement, with its warnings."""
        if self.source is not None:
            return self
        measurement = self.lengths or self.deviations or self.circles
        if measurement is None:
            raise InputError(
                Message(
                    "kind-without-errors",
                    "contains {kind}, which do not determine the errors of the machine",
                    kind=self.kind,
                ),
                file=self.path,
            )
        chosen = IdentifyOptions(u_deviation_um=self.u_um if self.lengths is None else None)
        found = identify_measurement(self.machine, measurement, chosen)
        return replace(
            self,
            source=_source_of(self.machine, found),
            reversal=identified_reversal(found),
            whole=lambda: _source_of(self.machine, found, prior=True),
        )

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
    path : the file; its columns identify its kind. For a folder: the errors identified there.
    instrument : constants of a six-DOF instrument, for ``*.sixdof.csv``.
    u_um : standard uncertainty of measured deviations, um; default: that of the file.
    reader : of measurements; that of :mod:`compgen.foreign` reads foreign files, too.
    """
    source = Path(path)
    if source.is_dir():  # of a command that wrote its errors
        source = source / "identified.errors.csv"
        if not source.is_file():
            raise InputError(
                Message("folder-without-errors", "is a folder without identified.errors.csv; give a file"),
                file=source.parent,
            )
    text = read_bytes(source, _LOOKED_AT).decode(
        "utf-8-sig", errors="replace"
    )  # only to detect the kind; the readers are strict
    header = names_in_header(text)
    if is_exchange_text(text) or set(ERROR_COLUMNS) <= header:
        errors = read_error_file(source)
        covariance = covariance_named_by(source, errors)
        return Side(
            machine,
            source,
            "errors",
            source=error_source(machine, errors, covariance, prior=False),
            reversal=reversal_beside(source),
            whole=lambda: error_source(machine, errors, covariance),
        )
    if set(PREDICTED_COLUMNS) <= header:
        return Side(machine, source, "predicted errors at points", predicted=_read_predicted(machine, source))
    if {"diagonal", "deviation_um"} <= header or source.name.lower().endswith(".diagonals.csv"):
        return Side(machine, source, "measured diagonals", diagonals=diagonal_runs(machine, read_diagonals(source)))
    holds_sixdof = "y_qd1_mm" in header
    measurement = reader([source], instrument if holds_sixdof else None)
    if isinstance(measurement, ErrorTable):
        return Side(
            machine,
            source,
            "errors",
            source=error_source(machine, measurement, prior=False),
            whole=lambda: error_source(machine, measurement),
        )
    if isinstance(measurement, AxisRuns):
        return Side(machine, source, "axis runs", runs=axis_statistics(measurement), readings=measurement)
    if isinstance(measurement, Circles):
        return Side(machine, source, "circles", circles=measurement)
    if isinstance(measurement, Deviations):
        return Side(machine, source, "measured positions", deviations=measurement, u_um=u_um)
    if isinstance(measurement, Lengths):
        return Side(machine, source, "tracer lengths", lengths=measurement)
    found = identify_measurement(machine, measurement)
    return Side(
        machine,
        source,
        "six-DOF readings",
        source=_source_of(machine, found),
        reversal=identified_reversal(found),
        whole=lambda: _source_of(machine, found, prior=True),
    )


def _source_of(machine: Machine, found: Identification, *, prior: bool = False) -> ErrorSource:
    known = joint_covariance(found) if found.has_covariance else None
    return error_source(machine, found.errors, known, prior=prior, posterior=found.posterior if prior else None)


def _read_predicted(machine: Machine, path: Path) -> ErrorField:
    """Predicted errors at points as a field without uncertainty."""
    table = read_csv(path, (*POSITION_COLUMNS, *PREDICTED_COLUMNS), ("tool_x_mm", "tool_y_mm", "tool_z_mm"))
    position = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    error = np.column_stack([table.numbers(name) for name in PREDICTED_COLUMNS]) * MM_PER_UM
    tool = np.array(machine.tool_offset_mm)
    if "tool_x_mm" in table.columns:
        tool = np.column_stack([table.numbers(f"tool_{k}_mm") for k in "xyz"])
        if np.max(np.abs(tool - np.array(machine.tool_offset_mm))) > 1e-6:
            raise InputError(
                Message(
                    "tool-offset-differs",
                    "has a tool offset that differs from the machine file; predict with that of the machine file",
                ),
                file=path,
            )
    return ErrorField(position, position + tool, error, lambda _: 0.0)


# Comparison of two sides: by their kind, or as prediction and measurement.


def compare_sides(before: Side, after: Side, options: CompareOptions) -> Comparison:
    """Compare two sides of the same kind: axis runs, diagonals, measured positions, or errors (given, or identified first).

    Raises
    ------
    InputError
        for kinds that cannot be compared, and for different points unless ``options.align`` says how to align them.
    """
    if before.runs is not None and after.runs is not None:
        return compare_runs(before.runs, after.runs, options)
    if before.diagonals is not None and after.diagonals is not None:
        return compare_diagonals(before.machine, before.diagonals, after.diagonals, options)
    if before.predicted is not None or after.predicted is not None:
        side = before if before.predicted is not None else after
        raise InputError(
            Message(
                "prediction-not-measured",
                "contains predicted errors at points; compare them with a measurement: --predicted",
            ),
            file=side.path,
        )
    for alone, name in (("runs", "axis runs"), ("diagonals", "measured diagonals")):
        if getattr(before, alone) is not None or getattr(after, alone) is not None:
            raise InputError(
                Message(
                    "compare-kinds-differ",
                    "BEFORE contains {before}, AFTER {after}; {name} can only be compared with {name2}",
                    before=before.kind,
                    after=after.kind,
                    name=name,
                    name2=name,
                )
            )
    if options.align != "model" and (before.deviations is not None or after.deviations is not None):
        return _at_positions(before, after, options)
    said = []
    if before.lengths is not None and after.lengths is not None:
        said.append(check_same_positions(before.lengths, after.lengths, options.align))
    first, second = before.errors(), after.errors()
    assert first.source is not None and second.source is not None
    own = replace(options, align=None if options.align == "model" else options.align)
    found = compare_errors(first.source, second.source, own)
    for side in (first, second):
        if side.kind not in ("errors",):
            said.append(f"{side.path.name}: errors identified from {side.kind}")
    groups = {name: dict(group) for name, group in found.groups.items()}
    both = [
        {"reversal": reversal_figures(side.source, side.reversal.curves)}
        for side in (first, second)
        if side.source is not None and side.reversal.curves is not None
    ]
    if len(both) == 2 and both[0]["reversal"] and both[1]["reversal"]:
        groups |= paired_figures(both[0], both[1])
    else:
        said += [f"{side.path.name}: {side.reversal.text}" for side in (first, second) if side.reversal.curves is None]
    return replace(found, groups=groups, statements=(*said, *found.statements))


def _at_positions(before: Side, after: Side, options: CompareOptions) -> Comparison:
    """Compare points with points or errors; also the errors identified from each side, if the points determine them."""
    if before.deviations is None or after.deviations is None:
        # errors on one side, evaluated at the positions measured on the other
        measured = _own_tool(after if before.deviations is None else before)
        other = before if before.deviations is None else after
        taken = replace(measured, field=_predicted_at(other, measured.field))
        sides = (taken, measured) if other is before else (measured, taken)
        found = compare_fields(before.machine, *sides, options)
        text = f"{other.path.name}: errors, evaluated with the exact model at the measured positions"
        return replace(found, statements=(text, *found.statements))
    found = compare_fields(before.machine, before.measured(), after.measured(), options)
    try:
        first, second = before.errors().source, after.errors().source
        assert first is not None and second is not None
        errors = compare_errors(first, second, replace(options, align=None, alignment=None))
    except (UndeterminedError, InputError) as error:
        text = f"single errors are not compared: these points do not determine them ({str(error).partition(';')[0]})"
        return replace(found, statements=(*found.statements, text))
    rest = {name: group for name, group in errors.groups.items() if name != "volume"}
    text = "axes, diagonals and single errors: identified from the points of each side; " + errors.statements[-2]
    return replace(found, groups={**found.groups, **rest}, statements=(*found.statements, text))


def compare_prediction(predicted: Side, measured: Side, options: CompareOptions) -> Comparison:
    """Compare a prediction (errors, or errors at points) with a measurement; the verdict is their agreement."""
    first, second = _both_fields(predicted, measured, options)
    found = agreement(first, second)
    statements: tuple[str, ...] = (
        f"prediction {predicted.path.name} and {measured.kind}",
        f"{len(first)} points, {first.alignment}",
    )
    if predicted.predicted is not None:
        text = "a list of predicted points has no uncertainty: only that of the measurement is used"
        statements = (*statements, f"{text}; if squareness errors are large, predict with --exact")
    return Comparison("prediction", {"volume": dict(found.figures)}, (), statements, found)


def with_prediction(
    found: Comparison, before: Side, after: Side, tables: ReadTables, options: CompareOptions
) -> Comparison:
    """Add to a comparison what the emulated control with its tables predicted for AFTER, from the errors BEFORE."""
    known = before.errors()
    assert known.source is not None
    machine = before.machine

    def correction(points: Points) -> FloatArray:
        return tables.mean_correction(machine, points.position_mm)

    predicted = replace(known, source=replace(known.source, correction=correction), deviations=None, lengths=None)
    own = replace(options, align=None if options.align == "model" else options.align)
    first, second = _both_fields(predicted, after, own)
    text = (
        f"prediction: {tables.controller.name} emulated with its tables on the errors BEFORE, mean of both directions"
    )
    return replace(found, prediction=agreement(first, second), statements=(*found.statements, text))


def _both_fields(predicted: Side, measured: Side, options: CompareOptions) -> tuple[ErrorField, ErrorField]:
    """Return the predicted and the measured field at the same points, in the same alignment."""
    machine = predicted.machine
    for side in (measured, predicted):
        if side.runs is not None or side.diagonals is not None:
            raise InputError(
                Message("kind-not-predicted", "{kind} cannot be compared with a prediction of errors", kind=side.kind),
                file=side.path,
            )
    if measured.predicted is not None:
        raise InputError(
            Message("prediction-twice", "AFTER is also a prediction; expected a measurement"), file=measured.path
        )
    alignment: Alignment = options.alignment or ("as-given" if measured.deviations is not None else "axes")
    if predicted.predicted is not None:
        alignment = options.alignment or "as-given"
    if measured.deviations is not None:
        second = _own_tool(measured).field
        first = _predicted_at(predicted, second)
    elif predicted.predicted is not None:
        first, second = predicted.predicted, _exact(measured).field(predicted.predicted.position_mm)
    else:
        (first, _), (second, _) = volume_fields(machine, (_exact(predicted), _exact(measured)), alignment)
        return first, second
    return aligned(machine, first, alignment), aligned(machine, second, alignment)


def _exact(side: Side) -> ErrorSource:
    """Errors of a side as a source that moves the exact model."""
    source = side.errors().source
    assert source is not None
    return replace(source, exact=True)


def _own_tool(side: Side) -> MeasuredField:
    found = side.measured()
    if not all(found.measured):
        raise InputError(
            Message(
                "prediction-needs-all", "a comparison with a prediction needs dx, dy and dz; not all were measured"
            ),
            file=side.path,
        )
    offset = found.field.tip_mm - found.field.position_mm - np.array(side.machine.tool_offset_mm)
    if float(np.max(np.abs(offset))) > 1e-6:
        raise InputError(
            Message(
                "prediction-other-tool",
                "was measured with a tool offset other than that of the machine file, which the prediction uses",
            ),
            file=side.path,
        )
    return found


def _predicted_at(predicted: Side, measured: ErrorField) -> ErrorField:
    """Return the predicted field at the measured points; a list of points must contain all of them."""
    if predicted.predicted is None:
        return _exact(predicted).field(measured.position_mm)
    given = predicted.predicted
    index = {key: k for k, key in enumerate(map(tuple, np.round(given.position_mm, 3).tolist()))}
    points = list(map(tuple, np.round(measured.position_mm, 3).tolist()))
    missing = [key for key in points if key not in index]
    if missing:
        raise InputError(
            Message(
                "points-not-predicted",
                "has no prediction for {missing} of {points} measured points, the first is "
                "{first} mm; predict at the measured points",
                missing=len(missing),
                points=len(points),
                first=missing[0],
            ),
            file=predicted.path,
        )
    return given.at_rows(np.array([index[key] for key in points], dtype=np.int64))
