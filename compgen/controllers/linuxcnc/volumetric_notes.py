"""What is said to the user of a ``volkins`` table, and what its template needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from compgen.controllers.linuxcnc.volcomp import VolTable, checksum
from compgen.controllers.linuxcnc.volumetric_text import digits_of, grid_rows, words_of
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine, Vector3
from compgen.core.names import AXES
from compgen.model.volumetric import tool_of


def shown_table(table: VolTable) -> dict[str, Any]:
    """Return the table in plain numbers for its template, with the checksum."""
    grid = table.grid
    return {
        "curves": [
            {
                "name": curve.name,
                "axis": curve.axis,
                "first_mm": curve.first_mm,
                "step_mm": curve.step_mm,
                "digits": digits_of(curve),
                "values": curve.values.tolist(),
            }
            for curve in table.curves
        ],
        "terms": [vars(term) for term in table.terms],
        "grid": None
        if grid is None
        else {
            "count": list(grid.vertices_mm.shape[:3]),
            "first_mm": list(grid.first_mm),
            "step_mm": list(grid.step_mm),
            "rows": grid_rows(grid),
        },
        "crc32": checksum(words_of(table)),
    }


def notes(machine: Machine, gauge_mm: Vector3, table: VolTable) -> dict[str, Any]:
    """Return sign statement, parameters, warnings, and the travel and tool offset for INI and HAL."""
    tool = np.array(gauge_mm) - np.array(machine.tool_offset_mm)
    low, high = machine.lower_mm, machine.upper_mm
    return {
        "sign_statement": _sign_statement(machine, table),
        "parameters": _parameters(gauge_mm),
        "warnings": _warnings(machine, table),
        "tables": [],
        "gauge_mm": list(gauge_mm),
        "control_tool_mm": tool.tolist(),
        "axes": [{"letter": AXES[k], "joint": k, "low_mm": float(low[k]), "high_mm": float(high[k])} for k in range(3)],
        "margin_mm": float(np.ceil(2.0 * np.max(np.abs(_at_corners(machine, table)[1])))) or 1.0,
        "form": "curves" if table.grid is None else "grid",
    }


def _at_corners(machine: Machine, table: VolTable) -> tuple[FloatArray, FloatArray]:
    """Corners and middles of the volume (27, 3) and the errors there, mm."""
    lines = [np.array([low, 0.5 * (low + high), high]) for low, high in (axis.range_mm for axis in machine.axes)]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
    return points, table.error(points, tool_of(machine, None))


def _sign_statement(machine: Machine, table: VolTable) -> str:
    """Return the sign in words, with the axis and corner where the table has its largest error."""
    points, error = _at_corners(machine, table)
    place, axis = divmod(int(np.argmax(np.abs(error))), 3)
    x, y, z = points[place]
    return (
        "The table holds ERRORS (actual minus commanded, ISO 230-1); volkins sends the axes to q = P - E(q). With the axes "
        f"at X {x:g} Y {y:g} Z {z:g} the error of {AXES[axis]} is {error[place, axis]:+.6f} mm: there the joint stands "
        f"{-error[place, axis]:+.6f} mm beside what the display says."
    )


def _parameters(gauge_mm: Vector3) -> list[dict[str, str]]:
    rows = [
        {
            "name": "[KINS] KINEMATICS",
            "value": "volkins file=volcomp.tab",
            "meaning": "the table, relative to the folder of the INI file",
        },
        {"name": "[KINS] JOINTS", "value": "3", "meaning": "joint 0, 1, 2 is X, Y, Z"},
        {
            "name": "volkins.loaded",
            "value": "true",
            "meaning": "belongs into the e-stop chain (volkins.hal): false means that nothing is compensated",
        },
    ]
    rows += [
        {
            "name": f"volkins.gauge-{letter.lower()}",
            "value": f"{value:g} mm",
            "meaning": "tool offset of the error model where the control's tool offset is zero",
        }
        for letter, value in zip(AXES, gauge_mm, strict=True)
    ]
    return rows


def _warnings(machine: Machine, table: VolTable) -> list[str]:
    tool = tool_of(machine, None)
    at_home = table.error(np.zeros((1, 3)), tool)[0]
    found = []
    if np.max(np.abs(at_home)) > 1e-6:
        shown = ", ".join(f"{letter} {value:+.6f}" for letter, value in zip(AXES, at_home, strict=True))
        found.append(
            f"with the axes at 0 the tool stands at {shown} mm: after homing there the display shows these numbers, not 0"
        )
    if table.grid is not None:
        found.append("a grid is made for one tool offset: with another tool, use form = 'curves'")
    return found
