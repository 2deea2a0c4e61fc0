"""Reading the neutral files strictly: CSV and JSON of the correction field and of the error curves.

Schemas: see ``docs/files.md``, "Neutral formats". What a file holds is told from its contents, not from its name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compgen.controllers.base import SourceFile
from compgen.controllers.isg.parameters import grid_order
from compgen.controllers.neutral.tables import FieldGrid, NeutralTables, same_curves
from compgen.core.csvio import FloatArray, csv_table
from compgen.core.error_table import ERROR_COLUMNS, Curve, ErrorTable, errors_of_table
from compgen.core.names import ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.core.text import doubled, nearest, one_line
from compgen.errors import InputError

FIELD_SCHEMA, CURVE_SCHEMA = "compgen-correction-field", "compgen-error-curves"
POSITION_COLUMNS, VALUE_COLUMNS = ("x_mm", "y_mm", "z_mm"), ("cx_um", "cy_um", "cz_um")
MOST_CHARACTERS = 20_000_000
_FIELD_KEYS = ("nodes_mm", "correction_um")


def parse_neutral(files: Sequence[SourceFile]) -> NeutralTables:
    """Return what the files hold; files that say the same twice must agree."""
    if not files:
        raise InputError("no file was given; neutral.field.csv is one")
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
        return _read_json(source)
    header = next((line for line in text.split("\n") if line.strip() and not line.lstrip().startswith("#")), "")
    if "error" in [name.strip() for name in header[:1000].split(",")]:
        return errors_of_table(csv_table(source.path, text, ERROR_COLUMNS, ("u_value",)))
    return _field_csv(source)


def _field_csv(source: SourceFile) -> FieldGrid:
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
        raise ValueError(f"the key {one_line(doubled(name for name, _ in items))[:40]!r} stands twice in one object")
    return found


def _read_json(source: SourceFile) -> FieldGrid | ErrorTable:
    try:
        data = json.loads(source.text, parse_constant=_refused, object_pairs_hook=_pairs)
    except json.JSONDecodeError as error:
        raise source.fail(f"is not valid JSON: {error.msg}; was it cut?", error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise source.fail(f"is not usable JSON: {one_line(error)[:200]}", 1) from None
    if not isinstance(data, dict) or data.get("schema") not in (FIELD_SCHEMA, CURVE_SCHEMA) or data.get("version") != 1:
        raise source.fail(f'"schema" must be "{FIELD_SCHEMA}" or "{CURVE_SCHEMA}", and "version" 1', 1)
    return _field_json(source, data) if data["schema"] == FIELD_SCHEMA else _curves_json(source, data)


def _fail(source: SourceFile, key: str, message: str) -> InputError:
    """Point at the first line that holds the last part of a key."""
    place = source.text.find(f'"{key.rpartition(".")[2]}"')
    return source.fail(f"{key}: {message}", source.text.count("\n", 0, max(place, 0)) + 1)


def _array(source: SourceFile, value: Any, key: str, *, columns: int | None = None) -> FloatArray:
    """Return a list of numbers (n,), or of lists of ``columns`` numbers (n, columns)."""
    rows = value if isinstance(value, list) and value else None
    if rows is None:
        raise _fail(source, key, "a list of numbers is due")
    for number, row in enumerate(rows):
        cells = row if columns and isinstance(row, list) else [row]
        if len(cells) != (columns or 1) or not all(_is_number(cell) for cell in cells):
            due = f"{columns} finite numbers" if columns else "a finite number"
            raise _fail(source, key, f"entry {number} is {one_line(json.dumps(row))[:40]}; {due} are due")
    return np.array(rows, dtype=np.float64)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < 1e300 and math.isfinite(value)


def _ascending(source: SourceFile, value: Any, key: str) -> FloatArray:
    nodes = _array(source, value, key)
    if np.any(np.diff(nodes) <= 0):
        raise _fail(source, key, "positions must ascend")
    return nodes


def _object(source: SourceFile, data: Mapping[str, Any], key: str, path: str) -> dict[str, Any]:
    value = data.get(key)
    if not isinstance(value, dict):
        raise _fail(source, path, "is missing or no object")
    return value


def _field_json(source: SourceFile, data: Mapping[str, Any]) -> FieldGrid:
    lines = _object(source, data, "nodes_mm", "nodes_mm")
    x, y, z = (_ascending(source, lines.get(letter), f"nodes_mm.{letter}") for letter in ("x", "y", "z"))
    values = _array(source, data.get("correction_um"), "correction_um", columns=3)
    if len(values) != len(x) * len(y) * len(z):
        due = f"{len(x)} x {len(y)} x {len(z)} vertices are due"
        raise _fail(source, "correction_um", f"has {len(values)} entries; {due}")
    return FieldGrid((x, y, z), values.reshape(len(x), len(y), len(z), 3))


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
                raise _fail(source, label, f'"{key}" with one number is due')
            squareness[name] = (entry[key] * error.si_per_unit, math.nan)
            continue
        if set(entry) != {"position_mm", key}:
            raise _fail(source, label, f'the keys "position_mm" and "{key}" are due')
        nodes = _ascending(source, entry["position_mm"], label)
        values = _array(source, entry[key], label)
        if len(nodes) != len(values):
            raise _fail(source, label, f"{len(nodes)} positions, {len(values)} values")
        curves[name] = Curve(nodes, values * error.si_per_unit, np.full(len(nodes), np.nan))
    if not curves and not squareness:
        raise _fail(source, "errors", "holds no error")
    return ErrorTable(curves, squareness)
