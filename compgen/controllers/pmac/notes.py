"""Words for the people at a PMAC: the sign, what must be set, warnings, and the tables as the template writes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compgen.controllers.pmac.settings import PmacSettings
from compgen.controllers.pmac.tables import Line, PmacTables, Sheet
from compgen.core.machine import Machine
from compgen.core.names import AXES

_ENTRIES_PER_LINE = 10


def pmac_notes(machine: Machine, settings: PmacSettings, tables: PmacTables) -> dict[str, Any]:
    """Return the texts of the context: sign_statement, parameters, warnings, motors."""
    return {
        "sign_statement": (
            "Entries are 1/16 count of the target motor, and the control ADDS them to its commanded position: 160 adds 10 "
            "counts. The first entry stands one spacing above the motor's zero, negative positions stand at the far end "
            "of the table, the last entry is the value at zero."
        ),
        "parameters": _parameters(settings, tables),
        "warnings": _warnings(machine, settings, tables),
        "motors": [
            {"letter": letter, "motor": motor, "counts": counts, "home": home}
            for letter, motor, counts, home in zip(
                AXES, settings.motors, settings.counts_per_mm, settings.home_mm, strict=True
            )
        ],
        "has_sheets": any(isinstance(table, Sheet) for table in tables.tables),
        "owners": sorted(table.motor for table in tables.tables),
        "overwrites": _overwrites(settings, tables),
    }


def _parameters(settings: PmacSettings, tables: PmacTables) -> list[dict[str, object]]:
    rows: list[tuple[str, object, str]] = [("I51", 1, "compensation tables enabled; set by the last line of the file")]
    for motor, value in sorted(tables.constants.items()):
        rows.append((f"I{motor}86", value, "backlash at the motor's zero, 1/16 count; set by the file"))
    for letter, motor, counts, home in zip(
        AXES, settings.motors, settings.counts_per_mm, settings.home_mm, strict=True
    ):
        meaning = f"the tables assume {counts:g} counts per mm of {letter}, and zero at {letter} = {home:g} mm"
        rows.append((f"#{motor} -> {letter}", f"{counts:g}", meaning))
    return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]


def _overwrites(settings: PmacSettings, tables: PmacTables) -> list[str]:
    """Say which tables and variables the file overwrites, those of motors without an axis first."""
    own = sorted(table.motor for table in tables.tables if table.motor in settings.motors)
    others = sorted(table.motor for table in tables.tables if table.motor not in settings.motors)
    names = {motor: letter for letter, motor in zip(AXES, settings.motors, strict=True)}
    first = "Of motors that are not X, Y or Z: nothing."
    if others:
        first = (
            f"Motors that are not X, Y or Z and get a table: {', '.join(map(str, others))}. NOT KNOWN whether they have one: "
            "list them first, a table that is there is lost."
        )
    found = [first, f"The tables of motors {', '.join(f'{motor} ({names[motor]})' for motor in own)}."]
    variables = ["I51 (it acts on the tables of all motors)", *(f"I{motor}86" for motor in sorted(tables.constants))]
    return [*found, f"The variables {', '.join(variables)}."]


def _warnings(machine: Machine, settings: PmacSettings, tables: PmacTables) -> list[str]:
    found: list[str] = []
    owners = [table.motor for table in tables.tables if table.motor not in settings.motors]
    if owners:
        found.append(
            f"the file keeps tables of X, Y and Z at the motors {', '.join(map(str, sorted(owners)))}, which the machine file "
            "does not have as axes: a table that one of them has on the control is lost"
        )
    if any(isinstance(table, Sheet) for table in tables.tables):
        found.append(
            "tables of two dimensions: the order of the arguments was put together from the remarks of the manuals "
            "(row motor, column motor, target, row span, column span); check it with section 3 of the preflight list"
        )
    if any(value < 0 for value in tables.constants.values()):
        found.append("a backlash Ixx86 is negative: the position reached in positive direction is the larger one")
    return found


def table_context(table: Line | Sheet, letters: Mapping[int, str]) -> dict[str, Any]:
    """Return one table as the template writes it: command, title, rows of entries."""
    if isinstance(table, Line):
        mark = "D" if table.desired else ""
        command = f"DEFINE COMP {len(table.entries)},#{table.source}{mark},#{table.target},{table.length}"
        title = f"{_letter(letters, table.target)} over {_letter(letters, table.source)}"
        rows = [
            table.entries[k : k + _ENTRIES_PER_LINE].tolist() for k in range(0, len(table.entries), _ENTRIES_PER_LINE)
        ]
        return {"motor": table.motor, "command": command, "title": title, "rows": rows}
    marks = ["D" if flag else "" for flag in (table.row_desired, table.column_desired)]
    size = f"{table.values.shape[0] - 1}.{table.values.shape[1] - 1}"
    sources = f"#{table.row}{marks[0]},#{table.column}{marks[1]},#{table.target}"
    names = [_letter(letters, motor) for motor in (table.target, table.row, table.column)]
    return {
        "motor": table.motor,
        "command": f"DEFINE COMP {size},{sources},{table.row_span},{table.column_span}",
        "title": f"{names[0]} over {names[1]} (row motor, along each line) and {names[2]} (column motor)",
        "rows": [table.values[0, 1:].tolist(), *table.values[1:].tolist()],
    }


def _letter(letters: Mapping[int, str], motor: int) -> str:
    return letters.get(motor, f"motor {motor}")
