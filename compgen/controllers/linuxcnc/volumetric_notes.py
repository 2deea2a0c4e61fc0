"""What is said to the user of a ``volkins`` table, and what its template needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from compgen.controllers.linuxcnc.text import MM_PER_UNIT
from compgen.controllers.linuxcnc.volcomp import VolTable, checksum
from compgen.controllers.linuxcnc.volumetric_text import (
    digits_of,
    grid_rows,
    in_file_units,
    length_digits,
    position_digits,
    words_of,
)
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine, Vector3
from compgen.core.names import AXES
from compgen.model.volumetric import tool_of

#: Decimals of travel limits in the INI file.
LIMIT_DIGITS = 6


def shown_table(table: VolTable) -> dict[str, Any]:
    """Return the table in plain numbers for its template, with the checksum."""
    inside = in_file_units(table)
    grid = inside.grid
    return {
        "unit": table.unit,
        "position_digits": position_digits(table),
        "curves": [
            {
                "name": curve.name,
                "axis": curve.axis,
                "first": curve.first_mm,
                "step": curve.step_mm,
                "digits": digits_of(table, curve),
                "values": curve.values.tolist(),
            }
            for curve in inside.curves
        ],
        "terms": [vars(term) for term in inside.terms],
        "grid": None
        if grid is None
        else {
            "count": list(grid.vertices_mm.shape[:3]),
            "corner": [*grid.first_mm, *grid.step_mm],
            "digits": length_digits(table),
            "rows": grid_rows(grid),
        },
        "crc32": checksum(words_of(table)),
    }


def notes(machine: Machine, gauge_mm: Vector3, coordinates: str, table: VolTable) -> dict[str, Any]:
    """Return sign statement, parameters, warnings, and travel, tool offset and joints for INI and HAL, in machine units."""
    tool = np.array(gauge_mm) - np.array(machine.tool_offset_mm)
    scale = MM_PER_UNIT[table.unit]
    margin_mm = float(np.ceil(2.0 * np.max(np.abs(_at_corners(machine, table)[1])))) or 1.0
    axes = [
        {
            "letter": letter,
            "joint": coordinates.index(letter),
            "joints": [joint for joint, other in enumerate(coordinates) if other == letter],
            "gauge": gauge / scale,
            "limits": _outward(axis.range_mm, 0.0, scale),
            "joint_limits": _outward(axis.range_mm, margin_mm, scale),
        }
        for letter, gauge, axis in zip(AXES, gauge_mm, machine.axes, strict=True)
    ]
    return {
        "sign_statement": _sign_statement(machine, table),
        "parameters": _parameters(gauge_mm, coordinates, table.unit),
        "warnings": _warnings(machine, table),
        "tables": [],
        "control_tool_mm": tool.tolist(),
        "coordinates": coordinates,
        "axes": axes,
        "gantry": len({coordinates.count(letter) for letter in AXES}) > 1,
        "other_axes": sorted(set(coordinates) - set(AXES)),
        "margin_mm": margin_mm,
        "form": "curves" if table.grid is None else "grid",
    }


def _outward(range_mm: tuple[float, float], margin_mm: float, scale: float) -> list[float]:
    """Limits of travel in machine units, rounded outward to the decimals of the INI file: the ends can be reached."""
    low, high = range_mm
    fine = 10.0**LIMIT_DIGITS
    # a rounding error of the division must not move a limit that has few decimals
    below, above = (round(value / scale * fine, 3) for value in (low - margin_mm, high + margin_mm))
    return [float(np.floor(below)) / fine, float(np.ceil(above)) / fine]


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


def _parameters(gauge_mm: Vector3, coordinates: str, unit: str) -> list[dict[str, str]]:
    joints = ", ".join(f"{joint} is {letter}" for joint, letter in enumerate(coordinates))
    rows = [
        {
            "name": "[KINS] KINEMATICS",
            "value": f"volkins file=volcomp.tab coordinates={coordinates}",
            "meaning": "the table, relative to the folder of the INI file, and the axis of each joint",
        },
        {"name": "[KINS] JOINTS", "value": str(len(coordinates)), "meaning": f"joint {joints}"},
        {
            "name": "[TRAJ] LINEAR_UNITS",
            "value": unit,
            "meaning": "unit of all numbers in the exported files; on a machine in another unit volkins.loaded stays false",
        },
        {
            "name": "volkins.loaded",
            "value": "true",
            "meaning": "belongs into the e-stop chain (volkins.hal): false means that nothing is compensated",
        },
    ]
    rows += [
        {
            "name": f"volkins.gauge-{letter.lower()}",
            "value": f"{value / MM_PER_UNIT[unit]:.9g} {unit}",
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
