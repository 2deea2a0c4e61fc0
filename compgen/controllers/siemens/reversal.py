"""Reversal as pairs of SINUMERIK CEC tables: one acts after positive travel of its base axis, one after negative.

Source: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 249 (DIRECTION), 264 (example of a pair).
With the reversal B (position reached in positive minus in negative direction) the tool stands at +B/2 after positive
travel, so the correction is -B/2 in the table with DIRECTION 1 and +B/2 in the one with DIRECTION -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from compgen.controllers.grids import equidistant_grid
from compgen.controllers.siemens.products import MM_DECIMALS, CecMap, CecTable
from compgen.controllers.siemens.syntax import LinearTable, exact_grid
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.core.reversal import WORTH_MM, ReversalCurves, reversal_name


def with_reversal_tables(
    machine: Machine,
    tables: CecMap,
    reversal: ReversalCurves,
    *,
    subtracts: bool,
    max_points: int,
    step_mm: tuple[float | None, ...],
) -> dict[int, CecTable]:
    """Return the tables with a pair behind them for each reversal that is worth one.

    Parameters
    ----------
    machine, tables : what is there already; its indices stay.
    reversal : values in mm.
    subtracts : whether the control subtracts the sum of the tables.
    max_points : nodes that the control takes per table.
    step_mm : node distances that the user asks for, or None.
    """
    found = dict(tables)
    for (axis, component), curve in sorted(reversal.curves.items()):
        if np.max(np.abs(curve.value)) < WORTH_MM:
            continue
        nodes_mm = _nodes_mm(machine, axis, curve, max_points, step_mm[axis])
        half = 0.5 * curve.at(nodes_mm) * (1.0 if subtracts else -1.0)
        for direction in (1, -1):
            words = "positive" if direction > 0 else "negative"
            label = f"{reversal_name(axis, component)}, after {words} travel of {AXES[axis]}"
            table = LinearTable(*exact_grid(nodes_mm), values=_decimals(direction * half))
            found[max(found, default=-1) + 1] = CecTable(axis, component, table, direction, label=label)
    return found


def _nodes_mm(machine: Machine, axis: int, curve: Curve, max_points: int, step_mm: float | None) -> FloatArray:
    if len(curve.position_mm) == 1:
        return np.array(machine.axes[axis].range_mm)
    inside = replace(curve, u=np.full(len(curve.value), np.nan))
    as_errors = ErrorTable({f"E{AXES[axis]}{AXES[axis]}": inside})
    return equidistant_grid(machine, as_errors, axis, most=max_points, step_mm=step_mm).nodes_mm


def _decimals(values_mm: FloatArray) -> tuple[Decimal, ...]:
    return tuple(Decimal(int(count)).scaleb(-MM_DECIMALS) for count in np.rint(values_mm * 10**MM_DECIMALS))


def reversal_statement(tables: CecMap, names: tuple[str, ...]) -> str:
    """Return what the tables of one direction do, with a number from the file; empty if there are none."""
    for index, entry in sorted(tables.items()):
        if entry.direction == 1:
            value = float(max(entry.table.values, key=abs))
            base, output = names[entry.input_axis], names[entry.output_axis]
            return (
                f" Direction: table {index} acts after positive travel of {base} only; it puts {value:+.6f} mm into the "
                f"sum of {output} there, its partner with DIRECTION -1 the opposite after negative travel."
            )
    return ""


def backlash_rows(tables: CecMap, names: tuple[str, ...]) -> list[dict[str, str]]:
    """Return the machine data that must be zero because tables of one direction hold the same effect."""
    axes = sorted({entry.input_axis for entry in tables.values() if entry.direction})
    return [
        {
            "name": f"MD32450 $MA_BACKLASH[{names[axis]}]",
            "value": "0",
            "meaning": "the tables with DIRECTION 1 and -1 hold the reversal; with both it would be corrected twice",
        }
        for axis in axes
    ]


def plain_backlash_rows(
    reversal: ReversalCurves, names: tuple[str, ...], encoders: Sequence[Sequence[int]]
) -> list[dict[str, str]]:
    """Return MD32450 for the mean reversal of each axis along itself: positive where the tool stops short.

    Source: MD32450 is positive if the encoder leads the machine part (SINUMERIK parameter manuals), the usual case;
    then the position reached in positive direction is the smaller one, and the reversal value B is negative.
    """
    return [
        {
            "name": f"MD32450 $MA_BACKLASH[{encoder},{names[axis]}]",
            "value": f"{-reversal.mean_mm(axis):.4f} mm",
            "meaning": f"minus the mean reversal value of {AXES[axis]}; these tables act in both directions alike. If a "
            "value was active while the machine was measured, add this one to it",
        }
        for axis in range(3)
        for encoder in encoders[axis]
        if abs(reversal.mean_mm(axis)) >= WORTH_MM
    ]
