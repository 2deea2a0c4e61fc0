"""What the templates of machine error compensation show: rows of the set sheet, plan, worked numbers, warnings."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from typing import Any

from compgen.controllers.base import SourceFile
from compgen.controllers.mitsubishi.records import BASE, FIRST_NUMBER, SET_STEP, SYSTEM, ControlSet
from compgen.controllers.mitsubishi.settings import HIGHEST_VALUE, MitsubishiSettings
from compgen.controllers.mitsubishi.tables import MitsubishiTables, SetTable, shortfall_text
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM

#: Name and meaning of the seven parameters of a set, in the order of their numbers.
MEANINGS = (
    ("cmpax", "base axis"),
    ("drcax", "axis that is compensated"),
    ("rdvno", "number at the reference point"),
    ("mdvno", "farthest number on the negative side"),
    ("pdvno", "farthest number on the positive side"),
    ("sc", "compensation scale factor"),
    ("spcdv", "division interval in mm"),
)


def sheet_context(machine: Machine, settings: MitsubishiSettings, tables: MitsubishiTables) -> dict[str, Any]:
    """Return the context beyond the common one; ``rows`` are the sheet's, ``plan`` holds number -> value."""
    absolute = tables.sets[0].absolute
    parameters = [_row(SYSTEM, str(int(not absolute)), _system(settings, absolute))]
    values: list[dict[str, str]] = []
    for table in tables.sets:
        parameters += _set_rows(settings, table.index, table)
        values += _value_rows(machine, table)
    for item in _no_longer_used(settings, tables):
        parameters += [
            _row(BASE + k + SET_STEP * item.index, "", f"set {item.index + 1} is no longer used") for k in (0, 1)
        ]
    return {
        "sign_statement": _sign_statement(settings, tables),
        "parameters": [
            {"name": f"#{row['number']}", "value": row["value"], "meaning": row["meaning"]} for row in parameters
        ],
        "warnings": _warnings(settings, tables),
        "rows": parameters + values,
        "plan": {
            "parameters": {row["number"]: row["value"] for row in parameters},
            "values": {row["number"]: int(row["value"]) for row in values},
            "setting_unit_um": settings.setting_unit_um,
            "stores": "correction" if settings.adds else "error",
        },
        "tables": [_summary(machine, table) for table in tables.sets],
        "check": _check(machine, settings, tables.sets[0]),
        "stores": "correction" if settings.adds else "error",
        "count_um": settings.half_unit_mm / MM_PER_UM,
        "absolute": absolute,
        "has_sample": settings.sample.file is not None,
        "container": "control's file" if settings.sample.file is not None else "sheet",
        "control_file": _control_file(settings, {row["number"]: row["value"] for row in parameters + values}),
        "overwrites": _overwrites(settings, tables, parameters + values),
    }


def _system(settings: MitsubishiSettings, absolute: bool) -> str:
    known = "as the control has it" if settings.sample.file is not None else "must be the control's own value"
    return f"Pinc: {'absolute values' if absolute else 'increments'}; holds for the sets of ALL axes and {known}"


def _control_file(settings: MitsubishiSettings, rows: dict[str, str]) -> SourceFile | None:
    """The control's own parameter file with the rows put in, every other line byte for byte as it was."""
    if settings.sample.file is None:
        return None
    lines = settings.sample.file.text.split("\n")
    new = dict(rows)
    for number, entry in settings.sample.entries.items():
        value = new.pop(str(number), None)
        if value is not None and number != SYSTEM:
            line = lines[entry.line - 1]
            behind = "\r" if line.endswith("\r") else ""
            lines[entry.line - 1] = f"N{number}P{value}{behind}"
    if new:
        raise settings.sample.file.fail(
            f"has no #{next(iter(new))}, which the tables need; state last_number or first_set"
        )
    return SourceFile(settings.sample.file.path, "\n".join(lines))


def _overwrites(settings: MitsubishiSettings, tables: MitsubishiTables, rows: list[dict[str, str]]) -> list[str]:
    """Say what sheet and file overwrite, other axes first."""
    sample = settings.sample
    others = [
        f"set {item.index + 1} ({item.output} over {item.base}, numbers {item.span[0]} to {item.span[1]})"
        for item in sample.others(settings.axis_names)
    ]
    if sample.file is None:
        found = [
            "Of other axes: NOT KNOWN, the control's own file was not given (`--style-from ALL.PRM`). Sets and numbers below "
            f"that another axis uses are lost, and #{SYSTEM} changes how the values of every axis are read."
        ]
    else:
        found = [f"Of other axes: nothing. {'; '.join(others) + ' stay' if others else 'No other axis has a set'}."]
    for table in tables.sets:
        first = BASE + SET_STEP * table.index
        numbers = f"#{table.first} to #{table.last}"
        pair = f"{AXES[table.output]}({AXES[table.base].lower()})"
        found.append(f"Set {table.index + 1} (#{first} to #{first + 6}) and numbers {numbers}: {pair}")
    changed = [
        row for row in rows if (old := sample.entries.get(int(row["number"]))) and not _same(old.value, row["value"])
    ]
    if sample.file is not None:
        parameters = [
            f"#{row['number']} = {row['value']} (was {sample.entries[int(row['number'])].value or 'empty'})"
            for row in changed
            if int(row["number"]) < FIRST_NUMBER
        ]
        found.append(f"Parameters that change: {', '.join(parameters) or 'none'}")
        found.append(f"Values that change: {len(changed) - len(parameters)}")
    for table in tables.sets:
        constant = table.at_reference * settings.half_unit_mm * table.scale / MM_PER_UM
        if table.absolute and constant:
            found.append(
                f"The value at the reference number #{table.reference} stays {table.at_reference}: a constant of "
                f"{constant:g} um in all values of {AXES[table.output]}({AXES[table.base].lower()}), which shifts the zero of "
                "the axis as before"
            )
        old = sample.entries.get(_old_reference(settings, table))
        if table.absolute and not table.at_reference and old is not None and not _same(old.value or "0", "0"):
            found.append(
                f"The value at the reference number #{old.number} was {old.value} and is now 0: "
                f"{AXES[table.output]} shifts by a constant, set the workpiece up anew"
            )
    cleared = [f"set {item.index + 1} ({item.output} over {item.base})" for item in _no_longer_used(settings, tables)]
    if cleared:
        found.append(f"Switched off, because this export has no such table: {', '.join(cleared)}")
    return found


def _old_reference(settings: MitsubishiSettings, table: SetTable) -> int:
    """Reference number of the control's own set for a table, 0 if it has none."""
    own = settings.own_set((table.output, table.base))
    return 0 if own is None else own.reference


def _no_longer_used(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[ControlSet]:
    """Sets of X, Y, Z in the control's file that hold none of the tables: they would go on acting beside them."""
    written = {table.index for table in tables.sets}
    others = settings.sample.others(settings.axis_names)
    return [item for item in settings.sample.sets if item.index not in written and item not in others]


def _same(old: str, new: str) -> bool:
    try:
        return Decimal(old) == Decimal(new)
    except InvalidOperation:
        return old == new


def _row(number: int, value: str, meaning: str) -> dict[str, str]:
    return {"number": str(number), "value": value, "meaning": meaning}


def _set_rows(settings: MitsubishiSettings, index: int, table: SetTable) -> list[dict[str, str]]:
    names = settings.axis_names
    numbers = (table.reference, table.first, table.last, table.scale)
    values = (names[table.base], names[table.output], *map(str, numbers), f"{table.interval_mm:.3f}")
    return [
        _row(BASE + k + SET_STEP * index, value, f"{name}: {meaning}; set {index + 1}")
        for k, (value, (name, meaning)) in enumerate(zip(values, MEANINGS, strict=True))
    ]


def _value_rows(machine: Machine, table: SetTable) -> list[dict[str, str]]:
    positions = machine.reference_point_mm[table.base] + table.along_mm
    pair = f"{AXES[table.output]}({AXES[table.base].lower()})"
    return [
        _row(table.first + k, str(value), f"{pair} at {AXES[table.base]} {positions[k]:.3f} mm")
        for k, value in enumerate(table.values)
    ]


def _summary(machine: Machine, table: SetTable) -> dict[str, Any]:
    ends = machine.reference_point_mm[table.base] + table.along_mm
    return {
        "pair": f"{AXES[table.output]}({AXES[table.base].lower()})",
        "first": table.first,
        "last": table.last,
        "reference": table.reference,
        "interval_mm": float(table.interval_mm),
        "first_mm": float(ends[0]),
        "last_mm": float(ends[-1]),
        "largest": max(map(abs, table.values)),
    }


def _sign_statement(settings: MitsubishiSettings, tables: MitsubishiTables) -> str:
    stored = "the correction" if settings.adds else "the error"
    scales = sorted({table.scale for table in tables.sets})
    count_um = settings.half_unit_mm * scales[0] / MM_PER_UM
    count = (
        f"one count is {count_um:g} um (half of the setting unit {settings.setting_unit_um:g} um, times the scale "
        f"{', '.join(map(str, scales))})"
    )
    if tables.sets[0].absolute:
        return (
            f"The numbers are {stored}, as sums up to their division point, zero at the reference point (#4000 = 0); {count}. An "
            f"axis that stands {20 * count_um:g} um too low at a point gets {20 * settings.sign:+d} there (scale {scales[0]})."
        )
    return (
        f"The numbers are {stored}, as steps from one division point to the next away from the reference point (#4000 = 1); "
        f"{count}. An axis that travels {20 * count_um:g} um too short over one interval, in either direction away from the "
        f"reference point, gets {20 * settings.sign:+d} there (scale {scales[0]})."
    )


def _warnings(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    return [
        "The parameter numbers are those that are remembered of the M series; no document was read. Compare them with "
        "the parameter manual of the control before anything is entered.",
        *_system_warning(settings, tables),
        "The direction of the values on the negative side follows from the formula of the manual, not from an example: "
        "check it at one division on each side (part 3).",
        *(shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts <= 1.0),
    ]


def _system_warning(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    if settings.sample.file is not None:
        return []
    return [
        f"#{SYSTEM} holds for the tables of ALL axes. Read it at the control first: if it is not "
        f"{int(not tables.sets[0].absolute)}, do not enter the sheet; set mode in the machine file and export again."
    ]


def _check(machine: Machine, settings: MitsubishiSettings, table: SetTable) -> dict[str, Any]:
    """A trial of one division next to the reference point: which number to set, what a laser must then read."""
    upper = table.last > table.reference
    number = table.reference + (1 if upper else -1)
    start_mm = machine.reference_point_mm[table.base]
    counts = min(20, HIGHEST_VALUE)
    step_mm = float(table.interval_mm) * (1 if upper else -1)
    outwards = 1 if upper or table.absolute else -1
    moved = settings.sign * counts * settings.half_unit_mm * table.scale / MM_PER_UM * outwards
    return {
        "axis": AXES[table.base],
        "number": number,
        "from_mm": start_mm,
        "to_mm": start_mm + step_mm,
        "counts": counts,
        "change_um": moved,
        "other_change_um": moved if table.absolute else -moved,
        "both_sides": table.first < table.reference < table.last,
        "other_number": table.reference - 1,
        "other_to_mm": start_mm - float(table.interval_mm),
        "interval_mm": float(table.interval_mm),
    }
