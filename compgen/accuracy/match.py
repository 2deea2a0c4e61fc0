"""Two sides of a comparison brought together: by their kind, or as prediction and measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from compgen.accuracy.compare import (
    CompareOptions,
    Comparison,
    agreement,
    compare_errors,
    compare_fields,
    compare_runs,
    paired_figures,
)
from compgen.accuracy.compare_diagonals import compare_diagonals
from compgen.accuracy.evaluate import volume_fields
from compgen.accuracy.field import Alignment, Field, aligned
from compgen.accuracy.figure import Figure
from compgen.accuracy.pairing import MeasuredField, check_same_positions
from compgen.accuracy.reversal import reversal_figures
from compgen.accuracy.sides import Side
from compgen.accuracy.source import ErrorSource
from compgen.core.csvio import FloatArray
from compgen.core.points import Points
from compgen.errors import InputError, UndeterminedError
from compgen.verify import ReadTables


def compare_sides(before: Side, after: Side, options: CompareOptions) -> Comparison:
    """Compare two sides of like kind: axis runs, diagonals, measured positions, or errors (given, or identified first).

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
            "holds predicted errors at points; compare them with a measurement: --predicted", file=side.path
        )
    for alone, name in (("runs", "axis runs"), ("diagonals", "measured diagonals")):
        if getattr(before, alone) is not None or getattr(after, alone) is not None:
            raise InputError(f"BEFORE holds {before.kind}, AFTER {after.kind}; {name} compare with {name} only")
    if options.align != "model":
        if before.deviations is not None and after.deviations is not None:
            return _positions(before, after, options)
        if before.deviations is not None or after.deviations is not None:
            return _errors_at_positions(before, after, options)
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
    both = [_reversal_of(side) for side in (first, second)]
    if both[0] and both[1]:
        groups |= paired_figures({"reversal": both[0]}, {"reversal": both[1]})
    else:
        said += [f"{side.path.name}: {side.reversal.text}" for side in (first, second) if side.reversal.curves is None]
    return replace(found, groups=groups, statements=(*said, *found.statements))


def _reversal_of(side: Side) -> dict[str, Figure]:
    if side.source is None or side.reversal.curves is None:
        return {}
    return reversal_figures(side.source, side.reversal.curves)


def _positions(before: Side, after: Side, options: CompareOptions) -> Comparison:
    """Points against points; the errors identified from each side beside them, where they follow from the points."""
    found = compare_fields(before.machine, before.measured(), after.measured(), options)
    try:
        first, second = before.errors().source, after.errors().source
        assert first is not None and second is not None
        errors = compare_errors(first, second, replace(options, align=None, alignment=None))
    except (UndeterminedError, InputError) as error:
        text = f"single errors are not compared: they do not follow from these points ({str(error).partition(';')[0]})"
        return replace(found, statements=(*found.statements, text))
    rest = {name: group for name, group in errors.groups.items() if name != "volume"}
    text = "axes, diagonals and single errors: identified from the points of each side; " + errors.statements[-2]
    return replace(found, groups={**found.groups, **rest}, statements=(*found.statements, text))


def _errors_at_positions(before: Side, after: Side, options: CompareOptions) -> Comparison:
    """Errors on one side, taken at the positions that were measured on the other."""
    measured = _own_tool(after if before.deviations is None else before)
    other = before if before.deviations is None else after
    field = _predicted_at(other, measured.field)
    taken = MeasuredField(field, measured.keys, measured.measured)
    sides = (taken, measured) if other is before else (measured, taken)
    found = compare_fields(before.machine, *sides, options)
    text = f"{other.path.name}: errors, the exact model moved with them to the measured positions"
    return replace(found, statements=(text, *found.statements))


def compare_prediction(predicted: Side, measured: Side, options: CompareOptions) -> Comparison:
    """Compare a prediction (errors, or errors at points) with what was measured; verdict by the agreement."""
    first, second = _both_fields(predicted, measured, options)
    found = agreement(first, second)
    statements: tuple[str, ...] = (
        f"prediction {predicted.path.name} against {measured.kind}",
        f"{len(first)} points, {first.alignment}",
    )
    if predicted.predicted is not None:
        text = "a list of predicted points has no uncertainty: that of the measurement alone counts"
        statements = (*statements, f"{text}; where squareness is large, predict with --exact")
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


def _both_fields(predicted: Side, measured: Side, options: CompareOptions) -> tuple[Field, Field]:
    """Predicted and measured field at the same points, aligned alike."""
    machine = predicted.machine
    for side in (measured, predicted):
        if side.runs is not None or side.diagonals is not None:
            raise InputError(f"{side.kind} cannot be compared with a prediction of errors", file=side.path)
    if measured.predicted is not None:
        raise InputError("AFTER is a prediction itself; a measurement is due", file=measured.path)
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
        raise InputError("a prediction compares with dx, dy and dz; not all were measured", file=side.path)
    offset = found.field.tip_mm - found.field.position_mm - np.array(side.machine.tool_offset_mm)
    if float(np.max(np.abs(offset))) > 1e-6:
        raise InputError(
            "was measured with another tool offset than the machine's; the prediction has the machine's own",
            file=side.path,
        )
    return found


def _predicted_at(predicted: Side, measured: Field) -> Field:
    """Predicted field at the measured points; a list of points must hold every one of them."""
    if predicted.predicted is None:
        return _exact(predicted).field(measured.position_mm)
    given = predicted.predicted
    index = {key: k for k, key in enumerate(map(tuple, np.round(given.position_mm, 3).tolist()))}
    wanted = list(map(tuple, np.round(measured.position_mm, 3).tolist()))
    missing = [key for key in wanted if key not in index]
    if missing:
        raise InputError(
            f"predicts nothing at {len(missing)} of {len(wanted)} measured points, the first is {missing[0]} mm; "
            "predict at the measured points",
            file=predicted.path,
        )
    rows = np.array([index[key] for key in wanted])
    parts = {"position_mm": given.position_mm[rows], "tip_mm": given.tip_mm[rows], "error_mm": given.error_mm[rows]}
    return replace(given, **parts)
