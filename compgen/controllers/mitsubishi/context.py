"""What the templates of machine error compensation show: rows of the set sheet, plan, worked numbers, warnings."""

from __future__ import annotations

from typing import Any

from compgen.controllers.mitsubishi.settings import HIGHEST_VALUE, MitsubishiSettings
from compgen.controllers.mitsubishi.tables import (
    BASE,
    SET_STEP,
    SYSTEM,
    MitsubishiTables,
    SetTable,
    shortfall_text,
)
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
    parameters = [_row(SYSTEM, "1", "Pinc: 1 = increments")]
    values: list[dict[str, str]] = []
    for k, table in enumerate(tables.sets):
        parameters += _set_rows(settings, settings.first_set - 1 + k, table)
        values += _value_rows(machine, table)
    return {
        "sign_statement": _sign_statement(settings),
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
    }


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


def _sign_statement(settings: MitsubishiSettings) -> str:
    stored = "the correction" if settings.adds else "the error"
    count_um = settings.count_mm / MM_PER_UM
    return (
        f"The numbers are {stored}, as steps from one division point to the next away from the reference point; one count is "
        f"{count_um:g} um (half of the setting unit {settings.setting_unit_um:g} um, times the scale {settings.scale}). "
        f"An axis that travels {20 * count_um:g} um too short over one interval, in either direction away from the reference "
        f"point, gets {20 * settings.sign:+d} there."
    )


def _warnings(settings: MitsubishiSettings, tables: MitsubishiTables) -> list[str]:
    return [
        "The parameter numbers are those that are remembered of the M series; no document was read. Compare them with "
        "the parameter manual of the control before anything is entered.",
        "The direction of the values on the negative side follows from the formula of the manual, not from an example: "
        "check it at one division on each side (part 3).",
        *(shortfall_text(settings, item) for item in tables.shortfalls if item.missed_counts <= 1.0),
    ]


def _check(machine: Machine, settings: MitsubishiSettings, table: SetTable) -> dict[str, Any]:
    """A trial of one division next to the reference point: which number to set, what a laser must then read."""
    upper = table.last > table.reference
    number = table.reference + (1 if upper else -1)
    start_mm = machine.reference_point_mm[table.base]
    counts = min(20, HIGHEST_VALUE)
    step_mm = float(table.interval_mm) * (1 if upper else -1)
    moved = settings.sign * counts * settings.half_unit_mm * table.scale / MM_PER_UM * (1 if upper else -1)
    return {
        "axis": AXES[table.base],
        "number": number,
        "from_mm": start_mm,
        "to_mm": start_mm + step_mm,
        "counts": counts,
        "change_um": moved,
        "both_sides": table.first < table.reference < table.last,
        "other_number": table.reference - 1,
        "other_to_mm": start_mm - float(table.interval_mm),
        "interval_mm": float(table.interval_mm),
    }
