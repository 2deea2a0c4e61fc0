"""Neutral samples (``neutral``): the correction field on a grid and the 21 error curves, as CSV and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.controls.shared.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controls.shared.grids import ParameterGrid, grid_order, loss_setting, rounded, uneven_nodes_mm
from compgen.controls.shared.terms import error_terms
from compgen.data.csv_files import FloatArray, csv_table
from compgen.data.error_table import ERROR_COLUMNS, Curve, ErrorTable, errors_of_table
from compgen.data.lengths import Points
from compgen.data.names import AXES, ERROR_NAMES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.toml_files import setting, whole
from compgen.errors import InputError, doubled, nearest, one_line
from compgen.kinematics.many_points import full_grid, volumetric_error

# The neutral formats as data: the correction field on a grid, and the 21 error curves from which it is calculated.


POSITION_DIGITS = 6
FIELD_DIGITS = 6
CURVE_DIGITS = 9


@dataclass(frozen=True)
class FieldGrid:
    """Values to be added to the command at the vertices of a grid, for one tool offset.

    Parameters
    ----------
    nodes_mm : ascending positions of X, Y, Z, any spacing.
    correction_um : shape (nx, ny, nz, 3).
    """

    nodes_mm: tuple[FloatArray, FloatArray, FloatArray]
    correction_um: FloatArray

    def at(self, position_mm: FloatArray) -> FloatArray:
        """Trilinear correction at positions (n, 3), boundary values outside: shape (n, 3), mm."""
        parts = [ParameterGrid((0, 1, 2), self.nodes_mm, self.correction_um[..., k]).at(position_mm) for k in range(3)]
        return np.column_stack(parts) * MM_PER_UM

    def same_as(self, other: FieldGrid) -> bool:
        """Whether another grid has the same numbers at the same positions."""
        pairs = [(self.correction_um, other.correction_um), *zip(self.nodes_mm, other.nodes_mm, strict=True)]
        return all(np.array_equal(mine, theirs) for mine, theirs in pairs)


@dataclass(frozen=True)
class NeutralTables:
    """The field, the curves (mm and rad, squareness reference X), or both; ``conflicts``: contradictions, in words."""

    field: FieldGrid | None
    curves: ErrorTable | None
    conflicts: tuple[str, ...] = ()


def same_curves(one: ErrorTable, other: ErrorTable) -> bool:
    """Whether two tables contain the same errors at the same positions."""
    if one.names != other.names or any(one.squareness[name][0] != other.squareness[name][0] for name in one.squareness):
        return False
    pairs = [(one.curves[name], other.curves[name]) for name in one.curves]
    return all(np.array_equal(a.position_mm, b.position_mm) and np.array_equal(a.value, b.value) for a, b in pairs)


def curves_from(basis: Sequence[Term], values: Mapping[str, FloatArray]) -> ErrorTable:
    """Return the errors of all terms, rounded as written to the file."""
    curves, squareness = {}, {}
    terms = {term.name: term for term in basis}
    for name in (name for name in ERROR_NAMES if name in terms):
        unit = error_named(name).si_per_unit
        value = rounded(np.asarray(values[name]) / unit, CURVE_DIGITS) * unit
        if name in SQUARENESS_NAMES:
            squareness[name] = (float(value[0]), math.nan)
        else:
            nodes = rounded(terms[name].nodes_mm, POSITION_DIGITS)
            curves[name] = Curve(nodes, value, np.full(len(nodes), np.nan))
    return ErrorTable(curves, squareness)


# Strict reader of the neutral files: CSV and JSON of the correction field and of the error curves.
#
# Schemas: see ``docs/files.md``, "Neutral formats". The kind of file is detected from its contents, not from its name.


FIELD_SCHEMA, CURVE_SCHEMA = "compgen-correction-field", "compgen-error-curves"
POSITION_COLUMNS, VALUE_COLUMNS = ("x_mm", "y_mm", "z_mm"), ("cx_um", "cy_um", "cz_um")
MOST_CHARACTERS = 20_000_000


def parse_neutral(files: Sequence[SourceFile]) -> NeutralTables:
    """Return the contents of the files; the same data given twice must agree."""
    if not files:
        raise InputError("no file was given; give a file such as neutral.field.csv")
    fields: list[tuple[SourceFile, FieldGrid]] = []
    curves: list[tuple[SourceFile, ErrorTable]] = []
    for source in files:
        found = _read(source)
        if isinstance(found, FieldGrid):
            fields.append((source, found))
        else:
            curves.append((source, found))
    conflicts = [
        f"{source.path.name} differs from {fields[0][0].path.name}"
        for source, item in fields[1:]
        if not item.same_as(fields[0][1])
    ]
    conflicts += [
        f"{source.path.name} differs from {curves[0][0].path.name}"
        for source, item in curves[1:]
        if not same_curves(item, curves[0][1])
    ]
    return NeutralTables(fields[0][1] if fields else None, curves[0][1] if curves else None, tuple(conflicts))


def _read(source: SourceFile) -> FieldGrid | ErrorTable:
    text = source.text
    if len(text) > MOST_CHARACTERS:
        line = text.count("\n", 0, MOST_CHARACTERS) + 1
        raise source.fail(f"has {len(text)} characters; at most {MOST_CHARACTERS} are read", line)
    if text.lstrip()[:1] in ("{", "["):
        try:
            data = json.loads(source.text, parse_constant=_refused, object_pairs_hook=_pairs)
        except json.JSONDecodeError as error:
            raise source.fail(f"is not valid JSON: {error.msg}; is it truncated?", error.lineno) from None
        except (ValueError, RecursionError) as error:
            raise source.fail(f"is not usable JSON: {one_line(error)[:200]}", 1) from None
        if (
            not isinstance(data, dict)
            or data.get("schema") not in (FIELD_SCHEMA, CURVE_SCHEMA)
            or data.get("version") != 1
        ):
            raise source.fail(f'"schema" must be "{FIELD_SCHEMA}" or "{CURVE_SCHEMA}", and "version" must be 1', 1)
        if data["schema"] == CURVE_SCHEMA:
            return _curves_json(source, data)
        lines = _object(source, data, "nodes_mm", "nodes_mm")
        x, y, z = (_ascending(source, lines.get(letter), f"nodes_mm.{letter}") for letter in ("x", "y", "z"))
        values = _array(source, data.get("correction_um"), "correction_um", columns=3)
        if len(values) != len(x) * len(y) * len(z):
            expected = f"expected {len(x)} x {len(y)} x {len(z)} vertices"
            raise _fail(source, "correction_um", f"has {len(values)} entries; {expected}")
        return FieldGrid((x, y, z), values.reshape(len(x), len(y), len(z), 3))
    header = next((line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")), "")
    if "error" in [name.strip() for name in header[:1000].split(",")]:
        return errors_of_table(csv_table(source.path, text, ERROR_COLUMNS, ("u_value",)))
    table = csv_table(source.path, source.text, (*POSITION_COLUMNS, *VALUE_COLUMNS))
    places = [table.numbers(name) for name in POSITION_COLUMNS]
    values = np.column_stack([table.numbers(name) for name in VALUE_COLUMNS])
    nodes, order = grid_order(source, list(table.lines), places)
    shape = tuple(len(line) for line in nodes)
    return FieldGrid((nodes[0], nodes[1], nodes[2]), values[order].reshape(*shape, 3))


def _refused(word: str) -> float:
    raise ValueError(f"{word} is not a finite number")


def _pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(items)
    if len(found) != len(items):
        raise ValueError(f"the key {one_line(doubled(name for name, _ in items))[:40]!r} is given twice in one object")
    return found


def _fail(source: SourceFile, key: str, message: str) -> InputError:
    """Return the error that points at the first line containing the last part of a key."""
    place = source.text.find(f'"{key.rpartition(".")[2]}"')
    return source.fail(f"{key}: {message}", source.text.count("\n", 0, max(place, 0)) + 1)


def _array(source: SourceFile, value: Any, key: str, *, columns: int | None = None) -> FloatArray:
    """Return a list of numbers (n,), or of lists of ``columns`` numbers (n, columns)."""
    rows = value if isinstance(value, list) and value else None
    if rows is None:
        raise _fail(source, key, "expected a list of numbers")
    for number, row in enumerate(rows):
        cells = row if columns and isinstance(row, list) else [row]
        if len(cells) != (columns or 1) or not all(_is_number(cell) for cell in cells):
            expected = f"{columns} finite numbers" if columns else "a finite number"
            raise _fail(source, key, f"entry {number} is {one_line(json.dumps(row))[:40]}; expected {expected}")
    return np.array(rows, dtype=np.float64)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300 and math.isfinite(value)


def _ascending(source: SourceFile, value: Any, key: str) -> FloatArray:
    nodes = _array(source, value, key)
    if np.any(np.diff(nodes) <= 0):
        raise _fail(source, key, "positions must be in ascending order")
    return nodes


def _object(source: SourceFile, data: Mapping[str, Any], key: str, path: str) -> dict[str, Any]:
    value = data.get(key)
    if not isinstance(value, dict):
        raise _fail(source, path, "is missing or not an object")
    return value


def _curves_json(source: SourceFile, data: Mapping[str, Any]) -> ErrorTable:
    curves: dict[str, Curve] = {}
    squareness: dict[str, tuple[float, float]] = {}
    for name in (entries := _object(source, data, "errors", "errors")):
        if name not in ERROR_NAMES:
            raise _fail(source, f"errors.{one_line(name)[:40]}", nearest(name[:20], ERROR_NAMES))
        entry = _object(source, entries, name, f"errors.{name}")
        error = error_named(name)
        key = f"value_{error.unit}"
        label = f"errors.{name}"
        if name in SQUARENESS_NAMES:
            if not _is_number(entry.get(key)):
                raise _fail(source, label, f'expected "{key}" with one number')
            squareness[name] = (entry[key] * error.si_per_unit, math.nan)
            continue
        if set(entry) != {"position_mm", key}:
            raise _fail(source, label, f'expected the keys "position_mm" and "{key}"')
        nodes = _ascending(source, entry["position_mm"], label)
        values = _array(source, entry[key], label)
        if len(nodes) != len(values):
            raise _fail(source, label, f"has {len(nodes)} positions but {len(values)} values")
        curves[name] = Curve(nodes, values * error.si_per_unit, np.full(len(nodes), np.nan))
    if not curves and not squareness:
        raise _fail(source, "errors", "contains no error")
    return ErrorTable(curves, squareness)


# ``neutral``: the correction field on a grid and the 21 error curves, as CSV and JSON, for every other control.
#
# The formats are specific to this program; their schemas are in ``docs/files.md``. The field must be ADDED to the
# command; the curves are the ERRORS (ISO 230-1) that it corrects.


#: Difference between field and curves at the vertices, in addition to rounding, above which it is reported.
AGREEMENT_MM = 1e-6
_TOOL_DIFFERENCE_MM = 1e-6


@dataclass(frozen=True)
class NeutralSettings:
    """Settings ``[controllers.neutral]``."""

    max_nodes: int = setting(whole(2, 200), 61, meaning="largest number of grid nodes per axis")
    loss_mm: float = loss_setting()


class Neutral(Controller[NeutralSettings, NeutralTables]):
    """Neutral CSV and JSON: field on a grid, and curves."""

    name = "neutral"
    settings_class = NeutralSettings

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them."""
        nodes = [
            uneven_nodes_mm(self.machine, errors, axis, loss_mm=self.settings.loss_mm, most=self.settings.max_nodes)
            for axis in range(3)
        ]
        return error_terms(self.machine, errors, nodes)

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> NeutralTables:
        """Return the curves, and the field that they give with the machine's tool offset, rounded as written."""
        curves = curves_from(basis, values)
        x, y, z = (self._nodes_mm(curves, axis) for axis in range(3))
        position_mm = full_grid((x, y, z))
        added = self._curve_correction(curves, position_mm.reshape(-1, 3), None) / MM_PER_UM
        return NeutralTables(FieldGrid((x, y, z), rounded(added, FIELD_DIGITS).reshape(position_mm.shape)), curves)

    def context(self, tables: NeutralTables) -> dict[str, Any]:
        """Return field and curves in the units of the files, and the sign conventions with worked examples."""
        field, errors = None, []
        if tables.field is not None:
            lines = tables.field.nodes_mm
            field = {
                "nodes": [line.tolist() for line in lines],
                "positions": full_grid(lines).reshape(-1, 3).tolist(),
                "corrections": tables.field.correction_um.reshape(-1, 3).tolist(),
                "rows": math.prod(map(len, lines)),
            }
        curves = ErrorTable({}) if tables.curves is None else tables.curves
        for name in curves.names:
            error, curve = error_named(name), curves.curves.get(name)
            values = curves.squareness[name][:1] if curve is None else curve.value
            positions = [] if curve is None else curve.position_mm.tolist()
            scaled = (np.array(values) / error.si_per_unit).tolist()
            errors.append({"name": name, "unit": error.unit, "positions": positions, "values": scaled})
        return {
            "sign_statement": (
                "The field (cx_um, cy_um, cz_um) is what must be ADDED to the command at the commanded machine position: "
                "cx_um = -5 at X = 100 mm means that X = 99.995 mm must be commanded. The curves are ERRORS as ISO 230-1 "
                "defines them (actual minus commanded tool position relative to the workpiece): the same error is EXX = +5 um."
            ),
            "parameters": [],
            "warnings": [],
            "position_digits": POSITION_DIGITS,
            "field_digits": FIELD_DIGITS,
            "curve_digits": CURVE_DIGITS,
            "field": field,
            "errors": errors,
        }

    def parse(self, files: Sequence[SourceFile]) -> NeutralTables:
        """Read any of the four files."""
        return parse_neutral(files)

    def emulate(self, tables: NeutralTables, points: Points) -> FloatArray:
        """Return the trilinear field; use the curves (E = C P) if there is no field or the points have another tool."""
        position = np.asarray(points.position_mm, dtype=np.float64)
        other_tool = points.tool_mm is not None and bool(
            np.any(np.abs(points.tool_mm - np.array(self.machine.tool_offset_mm)) > _TOOL_DIFFERENCE_MM)
        )
        if tables.curves is not None and (tables.field is None or other_tool):
            return self._curve_correction(tables.curves, position, points.tool_mm)
        assert tables.field is not None  # parse and build give at least one of the two
        return tables.field.at(position)

    def violations(self, tables: NeutralTables) -> list[str]:
        """Return contradictions between files, and travel that the field or a curve does not cover."""
        found = list(tables.conflicts)
        if tables.field is not None:
            for axis, nodes in enumerate(tables.field.nodes_mm):
                found += coverage_violations(self.machine, axis, float(nodes[0]), float(nodes[-1]), "the field")
        if tables.curves is not None:
            for name, curve in tables.curves.curves.items():
                first, last = float(curve.position_mm[0]), float(curve.position_mm[-1])
                found += coverage_violations(self.machine, error_named(name).axis, first, last, name)
        if tables.field is not None and tables.curves is not None:
            lines = tables.field.nodes_mm
            vertices = full_grid(lines).reshape(-1, 3)
            of_curves = self._curve_correction(tables.curves, vertices, None)
            miss = np.abs(of_curves - tables.field.correction_um.reshape(-1, 3) * MM_PER_UM)
            if np.max(miss) > AGREEMENT_MM:
                worst = vertices[int(np.argmax(np.max(miss, axis=1)))]
                place = ", ".join(f"{letter} {value:g}" for letter, value in zip(AXES, worst, strict=True))
                found.append(
                    f"field and curves differ by {np.max(miss) / MM_PER_UM:.3f} um at {place} mm: they come from "
                    "different exports, or the machine file has another chain or tool offset"
                )
        return found

    def usage(self, tables: NeutralTables) -> list[Usage]:
        """Return the nodes of the field per axis against ``max_nodes``."""
        nodes = () if tables.field is None else tables.field.nodes_mm
        return [
            Usage(f"nodes of {letter}", len(line), self.settings.max_nodes, "nodes", stated=False)
            for letter, line in zip(AXES, nodes, strict=False)
        ]

    def resolution_mm(self) -> float:
        """Half of the last digit of the field."""
        return 0.5 * 10.0**-FIELD_DIGITS * MM_PER_UM

    def table_nodes_mm(self, tables: NeutralTables) -> tuple[FloatArray, ...]:
        """Return the nodes of field and curves."""
        pairs = list(enumerate(tables.field.nodes_mm)) if tables.field is not None else []
        if tables.curves is not None:
            pairs += [(error_named(name).axis, curve.position_mm) for name, curve in tables.curves.curves.items()]
        return nodes_by_axis(pairs)

    def _curve_correction(self, curves: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None) -> FloatArray:
        """Return minus E = C P of the curves (squareness reference X) at positions (n, 3): shape (n, 3), mm."""
        return -volumetric_error(replace(self.machine, squareness_reference="X"), curves, position_mm, tool_mm) + 0.0

    def _nodes_mm(self, curves: ErrorTable, axis: int) -> FloatArray:
        """Nodes of the curves of an axis, subdivided where an angle acts with its own travel as lever (parabola)."""
        along = [curve for name, curve in curves.curves.items() if error_named(name).axis == axis]
        nodes = np.unique(
            np.concatenate([np.array(self.machine.axes[axis].range_mm), *(curve.position_mm for curve in along)])
        )
        if axis not in self.machine.chain.lever_axes(axis):
            return nodes
        bent = np.zeros(len(nodes) - 1)
        for name, curve in curves.curves.items():
            error = error_named(name)
            if error.axis == axis and error.kind == "angular" and error.direction != axis:
                bent = np.maximum(bent, 0.25 * np.abs(np.diff(curve.at(nodes))) * np.diff(nodes))
        loss = self.settings.loss_mm
        while True:
            parts = np.maximum(1, np.ceil(np.sqrt(bent / loss))).astype(int)
            if np.sum(parts) < self.settings.max_nodes or np.all(parts == 1):
                break
            loss *= 2.0
        pieces = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], parts, strict=True)]
        return np.unique(np.round(np.concatenate([*pieces, nodes[-1:]]), POSITION_DIGITS))
