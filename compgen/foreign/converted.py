"""Foreign files converted in memory, and the contents of a native file.

A file with open questions is refused with what ``volcomp import`` needs. :func:`given_errors` makes the errors of
another program usable like an identification.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.axis_runs import AxisRuns, join_axis_runs, read_axis_runs, read_diagonals
from compgen.data.circles import Circles, join_circles, read_circles
from compgen.data.csv_files import CsvTable, read_csv
from compgen.data.deviations import (
    Artefact,
    Deviations,
    Part,
    join_artefacts,
    join_deviations,
    read_artefacts,
    read_deviations,
    read_parts,
)
from compgen.data.error_table import (
    ARMS,
    SQUARENESS_APART,
    Curve,
    ErrorTable,
    Lines,
    about_own_lines,
    is_apart,
    read_errors,
)
from compgen.data.lengths import Lengths, join_lengths, read_lengths
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.data.rotary import SphereCentres
from compgen.errors import CompgenWarning, InputError
from compgen.fitting import FitOptions, fit
from compgen.fitting.zeroing import zero_ends
from compgen.foreign.answers import ImportOptions
from compgen.foreign.detect import import_file
from compgen.foreign.findings import Imported
from compgen.foreign.laser_files import Capture
from compgen.identification import Identification
from compgen.identification.axis_tests import positioning_errors
from compgen.identification.result import metadata_of, without_adjustment
from compgen.identification.stated import factor_of_numbers, is_stated, over_travel
from compgen.instruments.sixdof_instrument import read_sixdof

Plain = Lengths | Deviations | AxisRuns | Artefact | Circles
#: Number of labels of a column that are shown.
_SHOWN_LABELS = 8
_NATIVE_READERS: dict[str | None, Callable[[Path], Plain]] = {
    "lengths": read_lengths,
    "deviations": read_deviations,
    "axis": read_axis_runs,
    "part": read_parts,
    "circle": read_circles,
    "artefact": read_artefacts,
}


def converted_parts(
    paths: Sequence[str | Path],
    kinds: Sequence[str | None],
    axis: str | None = None,
    answers: ImportOptions | None = None,
) -> list[tuple[str, Plain | ErrorTable]]:
    """Return what files of which some are foreign hold, one entry for each kind of measurement and each file of errors.

    ``kinds`` are those of the native ones. Where all imported files of a kind say when they were measured, their times count
    from the earliest of them.
    """
    given = answers or ImportOptions()
    given = given if axis is None else replace(given, axis=axis)
    each = _answers_of([Path(path) for path, kind in zip(paths, kinds, strict=True) if kind is None], given)
    read = [
        (Path(path).name, _measured(Path(path), kind, each.get(Path(path), given)))
        for path, kind in zip(paths, kinds, strict=True)
    ]
    found = [(name if k == 0 else f"{name} (errors)", data) for name, both in read for k, data in enumerate(both)]
    parts: list[tuple[str, Plain | ErrorTable]] = []
    for kind in dict.fromkeys(type(data) for _, data in found):
        own = [(name, data) for name, data in found if type(data) is kind]
        if kind is ErrorTable or len(own) == 1:
            parts += own
            continue
        if kind is Artefact or kind is Circles:
            parts.append(
                (
                    ", ".join(name for name, _ in own),
                    _joined([data for _, data in own if isinstance(data, Artefact | Circles)]),
                )
            )
            continue
        measured = [data for _, data in own if not isinstance(data, ErrorTable | Artefact | Circles)]
        dated = all(data.metadata.get("measured_at") and "time_s" in data.covariates for data in measured)
        begun = [datetime.fromisoformat(data.metadata["measured_at"]) for data in measured if dated and not any(kinds)]
        if len({time.tzinfo is None for time in begun}) == 1:
            for k, data in enumerate(measured):
                later = data.covariates["time_s"] + (begun[k] - min(begun)).total_seconds()
                measured[k] = replace(data, covariates={**data.covariates, "time_s": later})
        parts.append((", ".join(name for name, _ in own), _joined(measured)))
    return parts


def describe_native(path: Path, kind: str) -> tuple[dict[str, Any], object]:
    """Return the contents of a native file, in words and numbers, and its object.

    Raises
    ------
    InputError
        for a file that its reader refuses.
    """
    readers: dict[str, Callable[[Path], object]] = {
        "errors": read_errors, "diagonals": read_diagonals, "sixdof": read_sixdof, "circle": read_circles,
        "artefact": read_artefacts,
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


def _answers_of(paths: Sequence[Path], given: ImportOptions) -> dict[Path, ImportOptions]:
    """Return what of the answers each of several foreign files asks; of a single one all, also against what it states.

    So the plane of one circle, or the axis of one run, is never put in place of what another file states.

    Raises
    ------
    InputError
        for an answer that no file asks.
    """
    if len(paths) < 2 or not given.given():
        return dict.fromkeys(paths, given)
    found = {path: _asked(path, given) for path in paths}
    unused = [name for name in given.given() if not any(name in answers.given() for answers in found.values())]
    if unused:
        text = "no file asks this; to change what a file states, convert that one with 'volcomp import FILE --out DIR'"
        raise InputError(text, field=ImportOptions.flag(unused[0]))
    return found


def _asked(path: Path, given: ImportOptions) -> ImportOptions:
    """Return the answers that a file asks, one question after the other: an answer may raise another one."""
    answers = ImportOptions()
    while True:
        try:
            text = " ".join(question.text for question in import_file(path, answers).questions)
        except InputError as error:
            text = str(error)
        new = [name for name in given.given() if name not in answers.given() and ImportOptions.flag(name) in text]
        if not new:
            return answers
        answers = replace(answers, **{name: getattr(given, name) for name in new})


def _measured(path: Path, kind: str | None, answers: ImportOptions) -> Sequence[Plain | ErrorTable]:
    """Return what a file contains: one measurement, and the errors on other sheets of a workbook."""
    if kind in _NATIVE_READERS:
        return [_NATIVE_READERS[kind](path)]
    item = _settled(path, answers)
    if isinstance(item.data, Capture):
        raise InputError("contains a capture over time, from which no errors are identified", file=path)
    if isinstance(item.data, SphereCentres):
        raise InputError(
            f"is the log of a sphere program; 'volcomp import FILE --out DIR' writes {item.file_name}, for identify and run",
            file=path,
        )
    data = item.data.deviations() if isinstance(item.data, Part) else item.data
    return [data] if item.other_errors is None else [data, item.other_errors]


def _settled(path: Path, answers: ImportOptions | None = None) -> Imported:
    item = import_file(path, answers)
    item.check_settled()
    facts = "; ".join([f"{item.format}, {item.kind}", *item.notes, *item.offers])
    warnings.warn(f"{path} was read as: {facts} ('volcomp import' shows all)", CompgenWarning, stacklevel=3)
    return item


def converted_errors(source: Path, kind: str | None) -> ErrorTable:
    """Return the errors of a foreign file, or of axis runs, also native ones (``kind`` "axis"): their bidirectional means."""
    item = None if kind == "axis" else _settled(source)
    if item is not None and item.other_errors is not None:
        names = ", ".join(item.other_errors.names)
        raise InputError(
            f"contains runs of axes and errors as well ({names}): 'volcomp import --out DIR' writes a file for each; or read "
            "one of them, with --ignore SHEET for the other",
            file=source,
        )
    data = read_axis_runs(source) if item is None else item.data
    if isinstance(data, AxisRuns):
        table, reversal, _ = positioning_errors(data, data.metadata)
        if reversal is not None:
            text = "has a reversal, which the mean of both directions does not contain; identify and run use both"
            warnings.warn(f"{source}: {text}", CompgenWarning, stacklevel=3)
        return table
    if not isinstance(data, ErrorTable):
        raise InputError("contains a measurement, not errors; identify it first", file=source)
    return data


def _joined(parts: Sequence[Plain]) -> Plain:
    """Join several measurements of one kind."""
    if isinstance(parts[0], AxisRuns):
        return join_axis_runs([part for part in parts if isinstance(part, AxisRuns)])
    if isinstance(parts[0], Lengths):
        return join_lengths([part for part in parts if isinstance(part, Lengths)])
    if isinstance(parts[0], Artefact):
        first, renumbered = 0, []
        for part in parts:
            if isinstance(part, Artefact):
                _, setup = np.unique(part.setup, return_inverse=True)
                renumbered.append(replace(part, setup=setup.ravel() + first))
                first += int(setup.max()) + 1
        return join_artefacts(renumbered)
    if isinstance(parts[0], Circles):
        return join_circles([part for part in parts if isinstance(part, Circles)])
    return join_deviations([part for part in parts if isinstance(part, Deviations)])


# Errors identified by another program, instead of an identification here.


#: Lines that raise an end of a straightness by less than this are not worth a word, mm.
_LINE_MM = 0.1 * MM_PER_UM


def given_errors(machine: Machine, table: ErrorTable, *, whole: bool = True) -> Identification:
    """Return errors of a foreign file as the result of an identification.

    They are brought to the gauge of every identification (positioning and angles zero at the reference point,
    straightness at both ends), without smoothing; ``details`` says what that changed.

    How a straightedge lay, and where an angle was set to zero, says nothing about the machine: squareness absorbs lines and
    constants only in a table that contains squareness, which was not measured apart. In a table without it that is the
    ``whole`` of what is known of it, the lines of both curves of a pair of axes are those of the arms of one square; the
    line of a single one is never squareness. The uncertainty of a straightness is that about its own line.

    Raises
    ------
    InputError
        for errors that do not match the machine's travel or chain.
    """
    table = over_travel(machine, table)
    model = bool(table.squareness) and not is_apart(table)
    own, lines = about_own_lines(table)
    own = table if model else own
    arms = _arms(lines) if whole and not model and not is_apart(table) else {}
    # constants of angles become squareness that is not kept: so a model without it has room for it
    room = {} if model else dict.fromkeys(SQUARENESS_NAMES, (0.0, 0.0))
    zeroed = fit(machine, own.replace(squareness={**room, **table.squareness}), FitOptions(smoothness=0.0))
    squareness = zeroed.errors.squareness if model else {**_of_arms(machine, lines, arms), **table.squareness}
    comments = {**metadata_of(machine, table.metadata), "source": "given by another program"}
    errors = zeroed.errors.replace(squareness=squareness, metadata=comments)
    for text in _said_of_lines(table, errors, lines, arms) if whole or model else ():
        warnings.warn(text, CompgenWarning, stacklevel=3)
    values = sum(len(curve.value) for curve in errors.curves.values()) + len(errors.squareness)
    known = bool(errors.curves) and all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    return replace(
        without_adjustment(machine, errors, np.zeros(values), "given" if known else "unknown", "not in the file"),
        rank=values,
        unknowns=values,
        iterations=0,
        values_factor=factor_of_numbers(errors) if known and is_stated(table) else None,
        method="given",
        details={
            "file": table.metadata.get("source", ""),
            "values": values,
            "frame_change": zeroed.to_dict()["frame_change"],
            "own_lines_urad": {name: slope / RAD_PER_URAD for name, (slope, _) in lines.items()},
        },
    )


def _arms(lines: Lines) -> dict[str, tuple[str, str]]:
    """Return the pairs of curves of which at least one has a line, as of a square whose other arm was aligned."""
    return {name: pair for name, pair in ARMS.items() if set(pair) <= set(lines) and any(lines[arm][0] for arm in pair)}


def _of_arms(machine: Machine, lines: Lines, arms: Mapping[str, tuple[str, str]]) -> dict[str, tuple[float, float]]:
    """Return squareness errors by the lines of the arms of squares, which may be shorter than the travel."""
    curves = {}
    for name in (arm for pair in arms.values() for arm in pair):
        (slope, u), ends = lines[name], np.array(machine.axes[error_named(name).axis].range_mm)
        span_mm = float(np.ptp(ends))
        # 1 mm above zero, which is no error of the machine: a value of zero would count as one by definition
        curves[name] = Curve(ends, 1.0 + slope * (ends - ends[0]), np.full(2, u * span_mm / np.sqrt(2.0)))
    found = zero_ends(machine, ErrorTable(curves, dict.fromkeys(arms, (0.0, 0.0)))).squareness
    return {name: found[name] for name in arms}


def _said_of_lines(
    table: ErrorTable, errors: ErrorTable, lines: Lines, arms: Mapping[str, tuple[str, str]]
) -> Iterator[str]:
    """Say what became of the lines of straightness curves."""
    pairs = [pair for pair in ARMS.values() if set(pair) <= set(table.curves)]
    model = table.squareness and not is_apart(table)
    for name, (slope, _) in lines.items():
        rise_mm = slope * float(np.ptp(table.curves[name].position_mm))
        square, pair = next(item for item in ARMS.items() if name in item[1])
        if square in arms or (model and pair in pairs) or abs(rise_mm) < _LINE_MM:
            continue
        rises = f"{name} rises by {rise_mm / MM_PER_UM:.4g} um from end to end ({slope / RAD_PER_URAD:.4g} urad): "
        if model:
            yield (
                f"{rises}this line counts as a part of the squareness, which the same table contains; if it is how a "
                f"straightedge lay, write the comment # squareness = {SQUARENESS_APART} into the file"
            )
        else:
            yield (
                f"{rises}how the straightedge lay; this line was removed and is no squareness. Give {square} by both arms of a "
                f"square in one file ({' and '.join(pair)}), or as a number: --squareness {square}=..."
            )
    for name, (one, other) in arms.items():
        value, u = errors.squareness[name]
        stated = "" if np.isnan(u) else f" +- {2 * u / RAD_PER_URAD:.3g} (k = 2)"
        yield (
            f"{name} = {value / RAD_PER_URAD:.4g}{stated} urad by the lines of {one} and {other}, read as the arms of one "
            "square that is exact; if they are two straightedges, each with its own lay, write the comment "
            f"# squareness = {SQUARENESS_APART} into the file"
        )
