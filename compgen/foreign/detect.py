"""Detection of a file's format from its first bytes, and the import of each foreign format.

:func:`form_of` reads the beginning of a file; :func:`import_file` calls the reader of its format and converts units, sign
and axis to native ones. What the file leaves open becomes a doubt.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from compgen.controls.isg_kernel import errors_from_etalon, is_exchange_text
from compgen.data.axis_runs import AxisRuns
from compgen.data.deviations import Deviations
from compgen.data.error_table import ErrorTable
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.errors import CompgenError, InputError
from compgen.foreign.answers import TABLE_SIGNS, ImportOptions
from compgen.foreign.cells import CellGrid, chosen_sheet, grid_of_text, holds_readings, read_sheets
from compgen.foreign.column_names import MM_PER_LENGTH, RAD_PER_ANGLE, check_field
from compgen.foreign.coordinate_reports import (
    grid_of_phrases,
    imported_features,
    is_dmis,
    is_qif,
    merged_features,
    read_dmis,
    read_qif,
    read_report,
)
from compgen.foreign.covariates import surroundings_of
from compgen.foreign.dial_readings import dial_readings
from compgen.foreign.error_tables import squareness_in
from compgen.foreign.findings import (
    ABSURD_DECADES,
    USUAL_URAD,
    Imported,
    decades_off,
    unit_of_deviations,
    usual_deviation_mm,
)
from compgen.foreign.laser_files import (
    REFUSED,
    UNITS,
    Renishaw,
    is_capture,
    is_ecmc,
    is_renishaw_text,
    read_capture,
    read_ecmc,
    read_renishaw,
    without_runs,
)
from compgen.foreign.measuring_logs import grid_of_log
from compgen.foreign.one_axis import OneAxis, axis_in, check_error, cycles, errors_of, motion, remarks
from compgen.foreign.probe_logs import import_probe_log, import_sphere_log, is_probe_log, is_sphere_log
from compgen.foreign.questions import AXIS, Asking, Choice, Question, directions, errors_along, unit_choices
from compgen.foreign.source import (
    MOST_BYTES,
    MOST_CAPTURE_BYTES,
    check_size,
    decode_head,
    header_date,
    read_head,
    read_source,
    shown,
)
from compgen.foreign.table_kinds import check_largest, import_table, merged_sheets, runs_of

MOST_EXCHANGE_BYTES = 16_000_000
#: A slope of readings over targets further from 1 than this is not an error of a machine.
SLOPE_TOLERANCE = 0.01
_SIGN_NOTE = "deviations are measured minus target (errors), as in the maker's software"
_USER_TEXT = (
    "machine", "serial no", "date", "by", "axis", "location", "title", "owner", "version no", "filetype", "flags",
)  # fmt: skip


def import_renishaw(path: Path, options: ImportOptions) -> Imported:
    """Import .rtl, .rta or .rts: axis runs, or with ``options.error`` that error over the axis."""
    found = read_renishaw(path)
    angular = found.letter == "a"
    asking = Asking()
    notes = list(found.notes)
    if found.zero_runs and options.zero_runs != "keep":  # some programs pad a unidirectional test with such runs
        named = f"run{'s' if len(found.zero_runs) > 1 else ''} {', '.join(map(str, found.zero_runs[:8]))}"
        if found.one_way_test or options.zero_runs == "drop":
            found = without_runs(found, found.zero_runs)
            notes.append(f"{named}: zero at every target, excluded as not measured")
        else:
            asking.ask(
                f"{named}: zero at every target",
                "zero_runs",
                (Choice("drop", "not measured: leave these runs out"), Choice("keep", "measured: zero is the result")),
                "give --zero-runs drop if not measured, keep if measured",
            )
    temperatures, measured_at, about = surroundings_of(
        found.information.get("ENVIRONMENT", {}), found.keys.get("date", ""), options.dates
    )
    notes += [*about, _SIGN_NOTE]
    axis = options.axis or axis_in(found.keys.get("axis", "")) or _axis_of_name(path, notes)
    runs, unit = _in_si(found, options, asking, notes)
    notes += remarks(runs, axis or "", angular=angular)
    understood = {
        "axis": axis,
        **_facts(runs, angular=angular),
        "unit": f"{unit} (by the type of the file, which does not state it)" if "value" not in options.units else unit,
        "sign": "measured minus target" if options.sign != "correction" else "target minus measured, sign reversed",
        "directions_from": options.directions or "the order of the targets in each run",
        "instrument": found.keys.get("owner") or "Renishaw laser software",
        "encoding": found.encoding,
        **{key: found.keys[key] for key in _USER_TEXT if found.keys.get(key)},
        **{section.lower(): dict(values) for section, values in found.information.items()},
        "measured_at": measured_at,
        "temperatures_c": temperatures or None,
    }
    runs = replace(runs, covariates={k: np.full(len(runs.value), c) for k, c in temperatures.items()})
    error = None
    if found.letter != "l" or options.error is not None:
        error = _error_named(path, axis, options, asking, angular=angular)
    elif axis is None:
        named = f" ('{found.keys['axis']}')" if found.keys.get("axis") else ""
        asking.ask(f"the file does not state X, Y or Z{named}", "axis", AXIS, "give --axis")
    return _imported(path, "renishaw", runs, axis, error, understood, asking.questions, notes)


def _imported(
    path: Path,
    form: str,
    runs: OneAxis,
    axis: str | None,
    error: str | None,
    understood: dict[str, object],
    questions: Sequence[Question],
    notes: list[str],
) -> Imported:
    """Readings along an axis as runs, or as the error that they are, with its reversal."""
    at, metadata = understood.get("measured_at"), {"source": path.name}
    if at:
        metadata |= {"measured_at": str(at), "date": str(at)}
    said = (understood, tuple(questions), tuple(notes))
    if error is None:
        return Imported(path, form, "axis", runs_of({axis or "": runs}, str(path), metadata), *said)
    data, reversal = errors_of(runs, error, metadata)
    return Imported(path, form, "errors", data, *said, reversal)


def _axis_of_name(path: Path, notes: list[str]) -> str | None:
    """Return the axis that the name of a file says, with a note."""
    axis = axis_in(re.sub(r"[_\-.]", " ", path.stem))
    if axis:
        notes.append(f"axis {axis} by the name of the file")
    return axis


def _error_named(path: Path, axis: str | None, options: ImportOptions, asking: Asking, *, angular: bool) -> str:
    """Return the error given by the user; without one a placeholder, with the doubt that prevents its use."""
    if options.error is None:
        about = "EA?, EB? or EC? with the axis in place of ?" if angular else "the straightness error, for example EYX"
        asking.ask(
            "the file does not state which error it is",
            "error",
            errors_along(axis or "", angular=angular),
            f"give --error ({about})",
        )
        letter = axis or "X"
        return f"E{'B' if angular else AXES[(AXES.index(letter) + 1) % 3]}{letter}"
    try:
        return check_error(options.error, axis, angular=angular)
    except InputError as error:
        raise InputError(error.message, file=path, field="--error") from error


def _in_si(found: Renishaw, options: ImportOptions, asking: Asking, notes: list[str]) -> tuple[OneAxis, str]:
    """Errors in mm or rad with their directions, and the unit; that of the type is compared with the size of the numbers."""
    angular = found.letter == "a"
    units = RAD_PER_ANGLE if angular else MM_PER_LENGTH
    usual = 1e-5 if angular else usual_deviation_mm(float(np.ptp(found.runs.position_mm)))
    given = options.given_unit("value", "deviation", among=units, what="angle" if angular else "length")
    unit = given or UNITS[found.letter]
    weighed = {name: units[name] for name in (("urad", "mrad", "arcsec") if angular else ("um", "mm"))}
    judged = unit_of_deviations(found.runs.value, weighed, usual)
    if not given and abs(decades_off(found.runs.value, units[unit], usual)) > ABSURD_DECADES:
        asking.ask(
            f"such files are in {unit}, but the numbers look like {judged.best}",
            "units",
            unit_choices(judged.best, unit),
            f"give --unit value={judged.best} or {unit}",
            key="value",
            default=judged.best,
        )
    elif not given:
        notes.append(f"by the magnitude of the numbers {judged.text()}")
    runs = replace(found.runs, value=found.runs.value * units[unit])
    if options.directions == "alternate":
        _, order = np.unique(found.one_way, return_inverse=True)
        direction = np.where(order % 2 == 0, 1, -1).astype(np.int64)
        runs = replace(runs, direction=direction, run=cycles(direction, found.one_way), in_time=False)
    else:
        if found.sorted_rows and options.directions is None:
            asking.ask(
                "its flags indicate runs in both directions, but every run lists the targets in the same order",
                "directions",
                directions("alternate", "motion"),
                "give --directions alternate (odd runs up, even runs down) or motion",
            )
        if not runs.direction.all():
            asking.ask("a run has a single target: its direction is unknown")
    if options.sign == "correction":
        runs = runs.negated()
        notes.append("the values are corrections, as given by --sign: their sign was reversed")
    return runs, unit


def _facts(runs: OneAxis, *, angular: bool) -> dict[str, object]:
    facts = runs.summary()
    unit, scale = ("urad", 1e-6) if angular else ("um", MM_PER_UM)
    sizes = {f"{key}_{unit}": float(str(facts.pop(key))) / scale for key in ("rms", "largest")}
    return {**facts, **sizes}


def import_ecmc(path: Path, options: ImportOptions) -> Imported:
    """Import an ISO 230-2 input file of the ecmc tools; it does not state its axis."""
    found = read_ecmc(path)
    asking, notes = Asking(), ["deviations are reading minus target; nothing is removed from them"]
    if found.fitted:
        notes.append(
            "a gear ratio was already fitted to these readings: they do not contain the scale error of the axis"
        )
    axis = options.axis or _axis_of_name(path, notes)
    if axis is None and options.error is None:
        asking.ask("the file does not state X, Y or Z", "axis", AXIS, "give --axis")
    if abs(found.slope - 1.0) > SLOPE_TOLERANCE:
        asking.ask(
            f"the readings follow the targets with the slope {found.slope:.5g}, which no machine error explains: a gear ratio or "
            "a sign is missing",
            how="correct the readings first, and state it where the result is used",
        )
    runs = found.runs
    if options.directions == "motion":
        runs = replace(runs, direction=motion(runs.position_mm, 2 * runs.run + (runs.direction < 0)))
    if options.sign == "correction":
        runs = runs.negated()
    notes += remarks(runs, axis or "", angular=False)
    understood = {
        "axis": axis,
        **_facts(runs, angular=False),
        "unit": found.keys.get("UNIT", "mm (none stated)"),
        "sign": "reading minus target",
        "directions_from": "the order of the targets: FWD follows their numbers",
        "slope_of_readings": found.slope,
        "offset_mm": found.offset_mm,
        "instrument": found.keys.get("REF_PV"),
    }
    error = None if options.error is None else _error_named(path, axis, options, asking, angular=False)
    return _imported(path, "ecmc-iso230", runs, axis, error, understood, asking.questions, notes)


def import_exchange(path: Path, options: ImportOptions) -> Imported:
    """Import an Etalon exchange file, variant Vendor: errors in mm and rad, unchanged."""
    source = read_source(path, most=MOST_EXCHANGE_BYTES)
    table, units, scales = errors_from_etalon(source.text, path), {"linear": "mm", "angle": "rad"}, {}
    for kind, known in (("linear", MM_PER_LENGTH), ("angle", RAD_PER_ANGLE)):
        units[kind] = (
            options.given_unit(kind, among=known, what="angle" if kind == "angle" else "length") or units[kind]
        )
        scales[kind] = known[units[kind]]
    sign = -1.0 if options.sign == "correction" else 1.0
    curves = {
        name: replace(
            curve, value=sign * curve.value * scales["linear" if error_named(name).kind == "linear" else "angle"]
        )
        for name, curve in table.curves.items()
    }
    squareness = {name: (sign * value * scales["angle"], u) for name, (value, u) in table.squareness.items()}
    table = table.replace(curves=curves, squareness=squareness)
    notes = [
        f"lengths are {units['linear']} and angles {units['angle']}; squareness in the convention of ISO 230-1 (reference X)"
    ]
    if options.sign == "correction":
        notes.append("the values are corrections, as given by --sign: their sign was reversed")
    understood = {
        "errors": list(table.names),
        "ranges_mm": {name: [float(c.position_mm[0]), float(c.position_mm[-1])] for name, c in curves.items()},
        "points": {name: len(curve.position_mm) for name, curve in curves.items()},
        "largest_um_urad": {
            **{n: float(np.max(np.abs(c.value))) * (1e3 if n[1] in "XYZ" else 1e6) for n, c in curves.items()},
            **{name: abs(value) * 1e6 for name, (value, _) in table.squareness.items()},
        },
        "unit": f"{units['linear']}, {units['angle']}",
        "sign": "errors" if options.sign != "correction" else "corrections, sign reversed",
        "instrument": "laser tracer software (Etalon exchange)",
    }
    questions = tuple(_absurd(table, options))
    return Imported(path, "etalon-exchange", "errors", table, understood, questions, tuple(notes))


def _absurd(table: ErrorTable, options: ImportOptions) -> list[Question]:
    """Errors that are hundreds of times larger than usual are in another unit, unless given by the user."""
    found, lengths, angles = [], unit_choices("mm", "um", "in"), unit_choices("rad", "urad", "arcsec")
    for name, curve in table.curves.items():
        linear = error_named(name).kind == "linear"
        usual = usual_deviation_mm(float(np.ptp(curve.position_mm))) if linear else USUAL_URAD * 1e-6
        kind = "linear" if linear else "angle"
        if kind not in options.units and decades_off(curve.value, 1.0, usual) > ABSURD_DECADES:
            reach = f"{float(np.max(np.abs(curve.value))) * (1e3 if linear else 1e6):.4g} {'um' if linear else 'urad'}"
            found.append(
                Question(
                    f"{name} reaches {reach}: are the numbers mm and rad?",
                    "units",
                    lengths if linear else angles,
                    f"give --unit {kind}={'mm' if linear else 'rad'} or another",
                    kind,
                )
            )
    for name, (value, _) in table.squareness.items():
        if "angle" not in options.units and abs(value) > USUAL_URAD * 1e-6 * 10**ABSURD_DECADES:
            found.append(
                Question(
                    f"{name} reaches {1e6 * abs(value):.4g} urad: are the numbers mm and rad?",
                    "units",
                    angles,
                    "give --unit angle=rad or another",
                    "angle",
                )
            )
    return found


def import_capture(path: Path, options: ImportOptions) -> Imported:
    """Import a dynamic capture: displacement over time."""
    found = read_capture(path)
    understood = {**found.summary(), "axis": axis_in(found.keys.get("axis", "")), "instrument": found.keys.get("owner")}
    understood |= {key: found.keys[key] for key in ("machine", "serial no", "date", "velocity") if found.keys.get(key)}
    at, against = header_date(found.keys.get("date", ""), options.dates)
    understood["measured_at"] = at
    keys = {key: value for key, value in found.keys.items() if key != "date"}
    keys |= {"measured_at": at, "date": at} if at else {}
    notes = ("a capture over time has no targets: no other command uses it", *([against] if against else []))
    return Imported(path, "renishaw-capture", "capture", replace(found, keys=keys), understood, (), notes)


# What a file is, by its first bytes.


_FLAGS = {
    "columns": "--map",
    "units": "--unit",
    "axis": "--axis",
    "error": "--error",
    "sign": "--sign",
    "directions": "--directions",
    "sheet": "--sheet",
    "dates": "--dates",
    "decimal": "--decimal",
    "zero_runs": "--zero-runs",
    "ignore": "--ignore",
    "base_length_mm": "--base-length",
    "line": "--line",
}
_ONE_AXIS = ("axis", "error", "sign", "directions", "line", "dates")


def form_of(path: Path) -> str:
    """Return the name of a foreign file's format."""
    return _format_of(path).name


def _with_line(item: Imported, options: ImportOptions) -> Imported:
    """Return axis runs with where the other axes stood, as the user says; a note where that stays open."""
    given = options.line_mm()
    if not isinstance(item.data, AxisRuns):
        if given:
            raise InputError(
                "states where a positioning run was, and the file contains none", file=item.path, field="--line"
            )
        return item
    runs = item.data
    moved = {AXES[axis] for axis in runs.axes}
    if unused := set(given) & moved if len(moved) == 1 else set():
        raise InputError(
            f"{''.join(unused)} is the axis that moved; give where the others stood", file=item.path, field="--line"
        )
    stated = {f"line_{axis.lower()}_mm": np.full(len(runs), place) for axis, place in given.items()}
    if twice := stated.keys() & runs.covariates.keys():
        raise InputError(f"the file has {', '.join(sorted(twice))} already", file=item.path, field="--line")
    runs = replace(runs, covariates={**runs.covariates, **stated})
    open_ = [AXES[axis] for axis in np.flatnonzero(np.isnan(runs.line_mm()).any(axis=0)).tolist()]
    asked = Question(
        f"where {' and '.join(open_)} stood during the runs is not stated: the runs count as anywhere in the travel, and angles "
        "add to the uncertainty",
        "line",
        (),
        f"give --line {','.join(f'{axis}=MM' for axis in open_)}",
        ",".join(open_),
        picture="line",
        required=False,
    )
    return replace(item, data=runs, questions=(*item.questions, asked) if open_ else item.questions)


def import_file(path: str | Path, options: ImportOptions | None = None) -> Imported:
    """Import any supported foreign file.

    Raises
    ------
    InputError
        with file, line and column for one that is damaged, truncated, too large or unknown.
    """
    source, chosen = Path(path), options or ImportOptions()
    reader = _format_of(source)
    form = reader.name
    # an option that is silently ignored would mislead
    for name, flag in _FLAGS.items():
        if getattr(chosen, name) and name not in reader.takes:
            taken = ", ".join(_FLAGS[key] for key in reader.takes) or "none"
            raise InputError(f"does not apply to a file of the format {form}; {taken} do", file=source, field=flag)
    for key in chosen.units:
        if form == "renishaw" and key not in reader.units:
            raise InputError("in this format only the unit of the values is open", file=source, field=f"--unit {key}")
        if reader.units and key not in reader.units:
            raise InputError("give linear= or angle= for this format", file=source, field=f"--unit {key}")
        if key not in ("value", "linear", "angle"):
            check_field(key, "--unit")
    item = reader.read(source, chosen)
    if chosen.sign not in (None, *TABLE_SIGNS) and "sign_of_squareness" not in str(item.understood):
        raise InputError(f"{chosen.sign} applies to squareness, and there is none", file=source, field="--sign")
    base_mm = chosen.base_length_mm
    if base_mm is not None and not (0 < base_mm < np.inf and "base_length_mm" in str(item.understood)):
        text = f"{base_mm:g} mm does not apply: expected a length above zero, and a column of straightness in words"
        raise InputError(f"{text} (Straightness Z [um/m]), or --map EZX=COLUMN", file=source, field="--base-length")
    item = _with_line(item, chosen)
    if not item.doubts and isinstance(item.data, AxisRuns | Deviations):
        check_largest(item.data.deviation_mm, item.data.origin)
    # refuse a name after --ignore that is neither a column nor a sheet: it would hide what the user meant
    text = f"{item.understood} {item.notes}"
    for name in chosen.ignore:
        if name not in text:
            raise InputError(f"there is no column or sheet {name!r}", file=source, field="--ignore")
    if chosen.kind is not None and item.kind != chosen.kind:
        raise InputError(f"contains {item.kind}, not {chosen.kind}", file=source, field="--kind")
    return item


def _of_text(path: Path, options: ImportOptions) -> Imported:
    """Import a table, or a log whose lines name their numbers, which is none."""
    text = read_source(path)
    try:
        return _of_grid(grid_of_text(text), options, "table")
    except InputError:
        found = grid_of_log(text, options.ignore) or grid_of_phrases(text)
        if found is None:
            raise
    return _of_grid(found, options, "table")


def _import_workbook(path: Path, options: ImportOptions) -> Imported:
    sheets, hidden = read_sheets(path, options.sheet)
    aside = tuple(f"sheet {shown(name)} is hidden and was skipped; --sheet reads it" for name in hidden)
    left_out = [name for name, _ in sheets if name in options.ignore]
    aside += tuple(f"sheet {shown(name)} was excluded by --ignore" for name in left_out)
    sheets = [sheet for sheet in sheets if sheet[0] not in left_out]
    if not sheets:
        raise InputError("no sheet is left to read", file=path, field="--ignore")
    one = chosen_sheet(path, sheets, options.sheet)
    if one is not None:
        item = _of_sheet(_of_grid(one[1], options, "xlsx"), one[0])
        return replace(item, notes=(*item.notes, *aside))
    read, reasons, open_sheets = [], [], []
    for name, grid in sheets:
        try:
            read.append((name, _of_sheet(_of_grid(grid, options, "xlsx"), name)))
        except CompgenError as error:
            reason = f"sheet skipped: {shown(name)}: {error}"
            if holds_readings(grid):
                open_sheets.append(
                    Question(
                        f"sheet {shown(name)} contains numbers that are not understood ({error})",
                        "ignore",
                        (Choice(name, f"leave sheet {shown(name)} out"),),
                        f"choose one sheet with --sheet, or exclude it: --ignore {shown(name)}",
                    )
                )
            else:
                reasons.append(reason)
    if not read:
        why = "; ".join([*reasons, *(asked.text for asked in open_sheets)])
        raise InputError(f"no sheet contains a table that can be read: {why}"[:1000], file=path)
    features = [item for item in read if item[1].kind in ("part", "artefact")]
    if features and len(features) < len(read):
        raise InputError("has features of a part and other measurements; choose one sheet with --sheet", file=path)
    item = merged_features(read, options) if len(features) > 1 else merged_sheets(read)
    return replace(item, questions=(*item.questions, *open_sheets), notes=(*item.notes, *aside, *reasons))


def _of_grid(grid: CellGrid, options: ImportOptions, form: str) -> Imported:
    """Import one table, or a list of squareness errors."""
    report = read_report(grid, options)
    if report is not None:
        return imported_features(report, form, options)
    dials = dial_readings(grid, options, form)
    if dials is not None:
        return dials
    plain = options if options.sign in TABLE_SIGNS else replace(options, sign=None)
    try:
        return import_table(grid, plain, form)
    except InputError as error:
        if error.field in ("--plane", "--origin"):  # an answer that contradicts the file
            raise
        found = squareness_in(grid, options, form)
        if found is None:
            raise
    return found


def _of_sheet(item: Imported, name: str) -> Imported:
    return replace(item, understood={"sheet": name, **item.understood})


def _import_dmis(path: Path, options: ImportOptions) -> Imported:
    return imported_features(read_dmis(read_source(path), options), "dmis", options)


def _import_qif(path: Path, options: ImportOptions) -> Imported:
    return imported_features(read_qif(path, options), "qif", options)


@dataclass(frozen=True)
class Head:
    """The first bytes of a file, and their text."""

    path: Path
    content: bytes

    @cached_property
    def text(self) -> str:
        """The bytes as text."""
        return decode_head(self.content)


@dataclass(frozen=True)
class Format:
    """One kind of foreign file: how it is recognised, who reads it, and what it leaves open to the user.

    ``takes`` are the options (names of :data:`_FLAGS`) that a file of the format may need, ``units`` the quantities whose
    unit may be given; none: those of all columns.
    """

    name: str
    recognised: Callable[[Head], bool]
    read: Callable[[Path, ImportOptions], Imported]
    takes: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


#: In the order in which they are tried, those that are recognised by their first bytes before those by their text; what is none
#: of them is a table.
FORMATS = (
    Format(
        "xlsx",
        lambda head: head.content.startswith(b"PK\x03\x04"),
        _import_workbook,
        tuple(name for name in _FLAGS if name != "zero_runs"),
    ),
    Format(
        "renishaw-capture",
        lambda head: is_capture(head.content) or head.path.suffix.lower() == ".rtx",
        import_capture,
        ("dates",),
    ),
    Format(
        "renishaw",
        lambda head: is_renishaw_text(head.text) or head.path.suffix.lower() in REFUSED,
        import_renishaw,
        ("units", *_ONE_AXIS, "zero_runs"),
        ("value", "deviation"),
    ),
    Format("ecmc-iso230", lambda head: is_ecmc(head.text), import_ecmc, _ONE_AXIS[:-1]),
    Format(
        "etalon-exchange",
        lambda head: is_exchange_text(head.text.lstrip("\ufeff")),
        import_exchange,
        ("sign", "units"),
        ("linear", "angle"),
    ),
    Format("probe-log", lambda head: is_probe_log(head.text), import_probe_log),
    Format("sphere-log", lambda head: is_sphere_log(head.text), import_sphere_log),
    Format("qif", lambda head: is_qif(head.text), _import_qif, ("units", "ignore")),
    Format("dmis", lambda head: is_dmis(head.text), _import_dmis, ("units", "ignore")),
    Format("table", lambda _: True, _of_text, tuple(name for name in _FLAGS if name not in ("sheet", "zero_runs"))),
)


def _format_of(path: Path) -> Format:
    check_size(path, MOST_CAPTURE_BYTES)
    head = Head(path, read_head(path))
    found = next(item for item in FORMATS if item.recognised(head))
    if found.name == "table":
        check_size(path, MOST_BYTES)
    return found
