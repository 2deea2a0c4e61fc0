"""What the templates of HEIDENHAIN tables show: cells in their fields, parameters to set, worked numbers, warnings."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import numpy as np

from compgen.controllers.heidenhain.grid import GRADIENT_SHARE, spacing_mm
from compgen.controllers.heidenhain.settings import (
    ACTIVE,
    BACKLASH,
    LARGEST_EXPONENT,
    POSITION,
    SMALLEST_EXPONENT,
    HeidenhainSettings,
)
from compgen.controllers.heidenhain.tables import ComTable, ComTables
from compgen.controllers.heidenhain.text import NUMBER_COLUMN, Layout
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.reversal import WORTH_MM, ReversalCurves

#: Totals that are remembered of older controls, without a document.
USUAL_TOTAL, USUAL_TABLES = 640, 10
POSITION_DECIMALS = 4


def com_context(machine: Machine, settings: HeidenhainSettings, tables: ComTables) -> dict[str, Any]:
    """Return the context beyond the common one; ``com`` holds layout and rows by letter, ``cma`` those of the .CMA."""
    com = {}
    for axis in range(3):
        layout = settings.com_layout(axis)
        rows = _com_rows(settings, layout, axis, tables.tables.get(axis) or _no_table(machine, axis))
        com[AXES[axis]] = {"layout": layout, "rows": rows}
    cma = settings.cma_layout()
    names = {settings.axis_names[axis]: f"AXIS_{AXES[axis]}.COM" for axis in sorted(tables.tables)}
    line = [{NUMBER_COLUMN: "0", ACTIVE: "*", **names}.get(name, "") for name in cma.names]
    cma.check(line)
    return {
        "sign_statement": _sign_statement(settings, tables),
        "parameters": _parameters(settings, tables),
        "warnings": _warnings(settings, tables),
        "com": com,
        "cma": {"layout": cma, "rows": [line]},
        "older": settings.older,
        "subtracts": settings.subtracts,
        "template": settings.com.source.name if settings.com and settings.com.source else "",
        "backlash_column": settings.backlash,
        "tables": [_summary(settings, axis, table) for axis, table in sorted(tables.tables.items())],
    }


def _no_table(machine: Machine, axis: int) -> ComTable:
    """Zeros at both ends of the travel, for an axis over which nothing is corrected."""
    low, high = (Decimal(repr(end)).quantize(Decimal("0.0001")) for end in machine.axes[axis].range_mm)
    return ComTable((low, high), {axis: (Decimal(0), Decimal(0))})


def _com_rows(settings: HeidenhainSettings, layout: Layout, axis: int, table: ComTable) -> list[list[str]]:
    """Cells of every row in the order of the layout's columns."""
    zero = f"{0:.{settings.decimals}f}"
    columns: dict[str, list[str]] = {
        NUMBER_COLUMN: [str(k) for k in range(len(table.positions))],
        POSITION: [_fixed(position, POSITION_DECIMALS) for position in table.positions],
        BACKLASH: [zero] * len(table.positions)
        if table.backlash is None
        else [_fixed(value, settings.decimals) for value in table.backlash],
    }
    for output, values in table.columns.items():
        columns[settings.axis_names[output]] = [_fixed(value, settings.decimals) for value in values]
    blank = [""] * len(table.positions)
    rows = [list(row) for row in zip(*(columns.get(name, blank) for name in layout.names), strict=True)]
    for row in rows:
        layout.check(row)
    return rows


def _fixed(value: Decimal, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def _summary(settings: HeidenhainSettings, axis: int, table: ComTable) -> dict[str, Any]:
    step = table.positions[1] - table.positions[0]
    return {
        "axis": AXES[axis],
        "file": f"AXIS_{AXES[axis]}.COM",
        "column": settings.axis_names[axis],
        "outputs": ", ".join(settings.axis_names[output] for output in sorted(table.columns)),
        "entries": len(table.positions),
        "first_mm": float(table.positions[0]),
        "last_mm": float(table.positions[-1]),
        "step_mm": f"{step:f}" if settings.older else "",
        "exponent": _exponent(step) if settings.older else None,
    }


def _exponent(step: Decimal) -> int | None:
    return next((n for n in range(SMALLEST_EXPONENT, LARGEST_EXPONENT + 1) if spacing_mm(n) == step), None)


def _sign_statement(settings: HeidenhainSettings, tables: ComTables) -> str:
    axis, output, node = _largest(tables)
    table = tables.tables[axis]
    value = float(table.columns[output][node])
    if settings.subtracts:
        kind = "An entry is the measured error, actual minus nominal, in mm; the control SUBTRACTS it from the command"
    else:
        kind = "An entry is the correction in mm; the control ADDS it to the command"
    return (
        f"{kind} (sign). [Axis of the column] = F([axis of the file's column in the .CMA]); several tables into one axis "
        f"add up. Here: AXIS_{AXES[axis]}.COM, column {settings.axis_names[output]}, at {AXES[axis]} = "
        f"{float(table.positions[node]):.4f} mm: {value:+.4f} mm, so it moves {AXES[output]} by "
        f"{settings.sign * value:+.4f} mm."
    )


def _largest(tables: ComTables) -> tuple[int, int, int]:
    """Input axis, corrected axis and row of the largest entry."""
    sizes = {
        (axis, output): np.abs([float(value) for value in values])
        for axis, table in tables.tables.items()
        for output, values in table.columns.items()
    }
    axis, output = max(sizes, key=lambda key: float(np.max(sizes[key])))
    return axis, output, int(np.argmax(sizes[axis, output]))


def _parameters(settings: HeidenhainSettings, tables: ComTables) -> list[dict[str, str]]:
    if not settings.older:
        return _newer_parameters(settings)
    rows = [
        {
            "name": f"MP730 bit {axis}",
            "value": "1",
            "meaning": f"{AXES[axis]}: non-linear axis error compensation; switches the linear one (MP720) off",
        }
        for axis in range(3)
    ]
    for axis, table in sorted(tables.tables.items()):
        step = table.positions[1] - table.positions[0]
        rows.append(
            {
                "name": f"datum, spacing of AXIS_{AXES[axis]}.COM",
                "value": f"{table.positions[0]:f} mm, {step:f} mm",
                "meaning": f"spacing 2^{_exponent(step)} x 0.0001 mm; both count from the machine datum. Look at the head "
                "of the table on the control: they must stand there",
            }
        )
    return rows


def _newer_parameters(settings: HeidenhainSettings) -> list[dict[str, str]]:
    return [
        {
            "name": "CfgAxes/axisList",
            "value": ", ".join(settings.axis_names),
            "meaning": "keys of X, Y, Z; the columns of .COM and .CMA carry these names",
        },
        {
            "name": "MP_refPosition",
            "value": "as it is",
            "meaning": "AXISPOS counts from the machine datum; the positions of the machine file must do so too",
        },
        {"name": "column ACTIVE of CONFIG.CMA", "value": "* in line 0", "meaning": "exactly one line is active"},
        {
            "name": "linear axis error compensation",
            "value": "off",
            "meaning": "for X, Y, Z: linear and non-linear compensation of one axis exclude each other",
        },
    ]


def _warnings(settings: HeidenhainSettings, tables: ComTables) -> list[str]:
    found = ["The sign of the entries is probable, not proven by public documents: check it with one table (part 3)."]
    steepest = max(table.steepest for table in tables.tables.values())
    if steepest > GRADIENT_SHARE:
        found.append(
            f"An entry changes by {100 * steepest:.2f} % of the travel between neighbours; the oldest tables allow "
            f"1/64 = {100 * GRADIENT_SHARE:.2f} %, a limit of .COM files is not known."
        )
    if settings.older and settings.max_total_points is None and tables.total_points > USUAL_TOTAL:
        found.append(
            f"All tables have {tables.total_points} entries. How many the control takes in all is not documented "
            f"(error 4 of module 9095; {USUAL_TOTAL} is remembered): state max_total_points."
        )
    if settings.com is not None and settings.keep_name:
        found.append(
            f"The first line of the .COM files is that of the saved table ({settings.com.before[0].strip()}); if the "
            'control wants the file name there, set begin_name = "file".'
        )
    if settings.older and settings.has_positions:
        found.append(
            "How a file of an older control holds datum and spacing is not documented; these files have a column AXISPOS. "
            "Save an empty table on the control and export with --template-from."
        )
    return found


def reversal_parameters(settings: HeidenhainSettings, reversal: ReversalCurves) -> list[dict[str, str]]:
    """Return the backlash parameter for the mean reversal of each axis along itself; its sign is not documented.

    Names and ranges: TNC 426/430 technical manual p. 366, iTNC 530 HSCI p. 650, MANUALplus 620 p. 708.
    """
    name = "MP710 (iTNC 530: MP750)" if settings.older else "MP_backLash"
    return [
        {
            "name": f"{name} of {settings.axis_names[axis]}",
            "value": f"{abs(reversal.mean_mm(axis)):.4f} mm in size",
            "meaning": f"position reached in positive minus in negative direction is {reversal.mean_mm(axis):+.4f} mm; "
            "which sign takes it out is not documented: try it with a dial gauge. If a value was active while the machine "
            "was measured, this one comes on top",
        }
        for axis in range(3)
        if abs(reversal.mean_mm(axis)) >= WORTH_MM
    ]
